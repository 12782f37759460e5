"""Benchmarks that anyone can run again: the engine against its limit, scaling, latency, fidelity."""

from poise.bench.engine import bench_engine
from poise.bench.gpu import bench_gpu
from poise.bench.latency import bench_latency
from poise.bench.machine import machine
from poise.bench.physics import bench_physics
from poise.bench.scaling import bench_scaling

__all__ = ["bench_engine", "bench_gpu", "bench_latency", "bench_physics", "bench_scaling", "machine"]
