"""Figures of Poise: one runner, fourteen suites, a row of `results/` for each figure (`python -m
benchmarks`).
"""
