"""Ways to look at a result: the self-contained report and plain SVG plots."""

from poise.score.report.data import Mover, Report, Shape, Track
from poise.score.report.page import write_report
from poise.score.report.svg import PoseRow, bar_plot, line_plot, pose_rows

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
