"""A folder of motion files as one library on one humanoid: read, cleaned, cut, retargeted."""
