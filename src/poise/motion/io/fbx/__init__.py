"""FBX files."""
