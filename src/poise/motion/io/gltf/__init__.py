"""glTF 2.0: the animated node tree of a .glb or .gltf, and back with a figure to look at."""
