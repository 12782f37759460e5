"""Planning over an environment: experts, trajectory optimisation, sampling-based control."""

from poise.plan.expert import Expert, ExpertConfig, Plan, make_plan
from poise.plan.guide import Guide
from poise.plan.lookahead import Lookahead, LookaheadConfig
from poise.plan.sampling import SamplingConfig, SamplingControl, SamplingResult
from poise.plan.teacher import LookaheadTeacher, TeacherConfig
from poise.plan.trajopt import LqrTeacher, Trajectories, TrajectoryOptimizer, TrajOptConfig, TrajOptStats

__all__ = [
    "Expert",
    "ExpertConfig",
    "Guide",
    "Lookahead",
    "LookaheadConfig",
    "LookaheadTeacher",
    "LqrTeacher",
    "Plan",
    "SamplingConfig",
    "SamplingControl",
    "SamplingResult",
    "TeacherConfig",
    "TrajOptConfig",
    "TrajOptStats",
    "Trajectories",
    "TrajectoryOptimizer",
    "make_plan",
]
