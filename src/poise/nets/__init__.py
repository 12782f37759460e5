"""Networks: perceptrons, diagonal Gaussian policies, progressive columns and their composer, running
normalisation, the discriminator of a motion prior."""

from poise.nets.discriminator import Discriminator, gradient_penalty
from poise.nets.gaussian import GaussianPolicy, gaussian_entropy, gaussian_kl, gaussian_log_prob
from poise.nets.mlp import ACTIVATIONS, MLP, bfloat16_is_fast
from poise.nets.multiplicative import Composer, product_of_gaussians
from poise.nets.norm import RunningNorm
from poise.nets.progressive import ProgressiveNet

__all__ = [
    "ACTIVATIONS",
    "MLP",
    "Composer",
    "Discriminator",
    "GaussianPolicy",
    "ProgressiveNet",
    "RunningNorm",
    "bfloat16_is_fast",
    "gaussian_entropy",
    "gaussian_kl",
    "gaussian_log_prob",
    "gradient_penalty",
    "product_of_gaussians",
]
