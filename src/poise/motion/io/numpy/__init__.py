"""NumPy files: named arrays from `.npz`, `.npy` and `.pkl`, read with bounds and without code of theirs,
and what is stored so: the SMPL family (AMASS, AIST++) and poselib.
"""
