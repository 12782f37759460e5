"""Ways to look at a result: the self-contained report and plain SVG plots."""

from poise.view.data import Mover, Report, Shape, Track
from poise.view.poses import PoseRow, pose_rows
from poise.view.report import write_report
from poise.view.svg import bar_plot, line_plot

__all__ = [
    "Mover",
    "PoseRow",
    "Report",
    "Shape",
    "Track",
    "bar_plot",
    "line_plot",
    "pose_rows",
    "write_report",
]
