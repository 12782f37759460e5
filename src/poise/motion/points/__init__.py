"""From labelled points to a clip: labels, joint centres, gaps, a measured skeleton, its rotations."""

from poise.motion.points.fit import FitConfig, fit_clip, fit_distances

__all__ = ["FitConfig", "fit_clip", "fit_distances"]
