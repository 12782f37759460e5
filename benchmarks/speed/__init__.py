"""Benchmarks that anyone can run again: the engine against its limit, scaling, latency, fidelity."""

from speed.engine import bench_engine
from speed.gpu import bench_gpu
from speed.latency import bench_latency
from speed.machine import machine
from speed.physics import bench_physics
from speed.scaling import bench_scaling

__all__ = ["bench_engine", "bench_gpu", "bench_latency", "bench_physics", "bench_scaling", "machine"]
