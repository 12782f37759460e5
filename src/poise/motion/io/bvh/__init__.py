"""BVH: hierarchy and rows of channels, read with any channel order and written as it came."""
