"""Ways to look at a result: the self-contained report and plain SVG plots."""

from poise.view.data import Report, Shape, Track
from poise.view.report import write_report
from poise.view.svg import bar_plot, line_plot

__all__ = ["Report", "Shape", "Track", "bar_plot", "line_plot", "write_report"]
