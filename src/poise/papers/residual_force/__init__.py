"""Residual Force Control (Yuan and Kitani, NeurIPS 2020), beyond what stands in the engine."""
