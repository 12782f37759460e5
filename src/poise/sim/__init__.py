"""Simulation: many worlds of one model, one protocol, one backend per kind of machine."""

from poise.sim.backend import (
    CONES,
    INTEGRATORS,
    SOLVERS,
    STANDARD_FIELDS,
    Backend,
    SimConfig,
    SimState,
    body_angular_velocity_w,
    body_com_velocity_w,
    body_linear_velocity_w,
)
from poise.sim.cpu import CpuBackend
from poise.sim.drive import Drive
from poise.sim.floor import Floor, HeightField, Plane, Steps
from poise.sim.guard import Cause, Failure, NanGuard, Replay, UnstableError, diagnose, replay_dump
from poise.sim.links import Link, ModelSlices
from poise.sim.make import check_device, make_backend
from poise.sim.mechanics import Mechanics, difference, displaced
from poise.sim.scene import Character, Scene, SceneModel, Touch, alone
from poise.sim.scene_sim import CharacterRows, Contact, LinkForce, SceneSim
from poise.sim.warp import WarpBackend
from poise.sim.worlds import add_contact_sensors, contact_columns

__all__ = [
    "CONES",
    "INTEGRATORS",
    "SOLVERS",
    "STANDARD_FIELDS",
    "Backend",
    "Cause",
    "Character",
    "CharacterRows",
    "Contact",
    "CpuBackend",
    "Drive",
    "Failure",
    "Floor",
    "HeightField",
    "Link",
    "LinkForce",
    "Mechanics",
    "ModelSlices",
    "NanGuard",
    "Plane",
    "Replay",
    "Scene",
    "SceneModel",
    "SceneSim",
    "SimConfig",
    "SimState",
    "Steps",
    "Touch",
    "UnstableError",
    "WarpBackend",
    "add_contact_sensors",
    "alone",
    "body_angular_velocity_w",
    "body_com_velocity_w",
    "body_linear_velocity_w",
    "check_device",
    "contact_columns",
    "diagnose",
    "difference",
    "displaced",
    "make_backend",
    "replay_dump",
]
