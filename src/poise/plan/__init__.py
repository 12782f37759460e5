"""Planning over an environment: experts, lookahead, sampling-based control."""

from poise.plan.expert import Expert, ExpertConfig, Plan, make_plan
from poise.plan.guide import Guide
from poise.plan.lookahead import Lookahead, LookaheadConfig
from poise.plan.sampling import SamplingConfig, SamplingControl, SamplingResult
from poise.plan.teacher import LookaheadTeacher, TeacherConfig

__all__ = [
    "Expert",
    "ExpertConfig",
    "Guide",
    "Lookahead",
    "LookaheadConfig",
    "LookaheadTeacher",
    "Plan",
    "SamplingConfig",
    "SamplingControl",
    "SamplingResult",
    "TeacherConfig",
    "make_plan",
]
