"""Perpetual Humanoid Control (Luo et al., ICCV 2023): training by stages, and its ablations.

One network for a library, evaluation, recovery and everything by which a policy acts are the engine's.
"""
