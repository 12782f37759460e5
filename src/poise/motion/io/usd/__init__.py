"""USD: an animated UsdSkel skeleton, and back with a figure to look at; needs `usd-core`."""
