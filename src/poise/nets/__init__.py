"""Networks: perceptrons, diagonal Gaussian policies, running normalisation."""

from poise.nets.gaussian import GaussianPolicy, gaussian_entropy, gaussian_kl, gaussian_log_prob
from poise.nets.half import bfloat16_is_fast, half_forward
from poise.nets.mlp import ACTIVATIONS, MLP
from poise.nets.norm import RunningNorm

__all__ = [
    "ACTIVATIONS",
    "MLP",
    "GaussianPolicy",
    "RunningNorm",
    "bfloat16_is_fast",
    "gaussian_entropy",
    "gaussian_kl",
    "gaussian_log_prob",
    "half_forward",
]
