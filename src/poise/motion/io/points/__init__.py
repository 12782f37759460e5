"""Points in space, markers or keypoints: TRC, C3D, CSV and arrays; 2D ones are refused by name."""

from poise.motion.io.points.arrays import is_mdm, is_points, read_mdm, read_points_arrays
from poise.motion.io.points.c3d import looks_like_c3d, read_c3d
from poise.motion.io.points.csv import looks_like_points_csv, read_points_csv
from poise.motion.io.points.refused import looks_like_openpose, refuse_folder, refuse_openpose
from poise.motion.io.points.trc import looks_like_trc, read_trc

__all__ = [
    "is_mdm",
    "is_points",
    "looks_like_c3d",
    "looks_like_openpose",
    "looks_like_points_csv",
    "looks_like_trc",
    "read_c3d",
    "read_mdm",
    "read_points_arrays",
    "read_points_csv",
    "read_trc",
    "refuse_folder",
    "refuse_openpose",
]
