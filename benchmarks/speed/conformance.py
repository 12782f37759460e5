"""The same worlds on both backends, step beside step, and what the tests of the Warp backend say."""

from __future__ import annotations

import copy
import os
import re
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import torch
from torch import Tensor

from poise.recipes.imitation import Imitation
from poise.sim import WarpBackend
from speed.engine import exploring

ROOT = Path(__file__).resolve().parents[2]
TESTS = ("tests/sim/test_conformance.py", "tests/sim/test_warp.py", "tests/env/test_warp_env.py")
#: By so much a field may differ after one control step, relative and absolute, as in the tests.
TOLERANCE = 3e-4
_SHOWN = (1, 2, 4, 8, 16, 32)
_FIELDS = ("qpos", "qvel", "xpos", "cvel")


def bench_conformance(
    imitation: Imitation, num_envs: int, device: str, steps: int, until: float, cone: str
) -> dict[str, Any]:
    """One environment on MuJoCo and one on MuJoCo Warp, begun alike and given the same random actions.

    Differences of the state, of observations and of rewards grow from step to step as contacts amplify
    them; `within` is the share of worlds that differ by less than `TOLERANCE` in every field.

    Args:
        steps: control steps.
        until: `time.monotonic()` after which no step begins.
        cone: "pyramidal" or "elliptic"; the edges of MuJoCo Warp's pyramids differ, see docs/install.md.
    """
    model = copy.copy(imitation.model)
    model.opt.cone = int(getattr(mujoco.mjtCone, f"mjCONE_{cone.upper()}"))
    imitation = replace(imitation, physics=model)
    cpu = imitation.env(num_envs, 0, False, guard=False)
    warp = imitation.env(
        seed=0, auto_reset=False, guard=False, backend=WarpBackend(model, num_envs, device)
    )
    clip = torch.arange(num_envs) % len(imitation.reference.length)
    frame = torch.arange(num_envs) % (imitation.reference.length.cpu()[clip] - 1)
    for env in (cpu, warp):
        env.reset_to(clip.to(env.device), frame.to(env.device))
    rows: list[dict[str, Any]] = []
    for k, action in enumerate(exploring(imitation, cpu, steps), start=1):
        if time.monotonic() > until:
            break
        one, two = cpu.step(action), warp.step(action.to(warp.device))
        if k in _SHOWN:
            rows.append({"control_steps": k, **_apart(cpu.backend.state, warp.backend.state)})
            for name in ("final_obs", "reward"):
                rows[-1][name] = _spread(getattr(one, name), getattr(two, name))
    cpu.close()
    warp.close()
    return {"worlds": num_envs, "tolerance": TOLERANCE, "rows": rows}


def _apart(one: Any, two: Any) -> dict[str, Any]:
    """Of each field how far apart two states are, and the share of worlds that are as one."""
    out: dict[str, Any] = {name: _spread(one[name], two[name]) for name in _FIELDS}
    same = torch.ones(len(one.qpos), dtype=torch.bool)
    for name in _FIELDS:
        a, b = one[name].cpu().double(), two[name].cpu().double()
        same &= ((a - b).abs() <= TOLERANCE * (1 + a.abs())).flatten(1).all(1)
    return out | {"within": round(float(same.double().mean()), 4)}


def _spread(one: Tensor, two: Tensor) -> dict[str, float]:
    """Median and largest difference over the worlds, of each world's largest."""
    apart = (one.cpu().double() - two.cpu().double()).abs().flatten(1 if one.dim() > 1 else 0)
    each = apart.amax(1) if apart.dim() > 1 else apart
    return {"median": _short(each.median()), "max": _short(each.max())}


def _short(value: Tensor) -> float:
    return float(f"{float(value):.3g}")


def run_tests(until: float, chosen: str = "warp") -> dict[str, Any]:
    """What the tests of the Warp backend say here, on the GPU if there is one.

    Args:
        until: `time.monotonic()` when they are stopped.
        chosen: as in pytest's -k.
    """
    how = ("-m", "pytest", "-q", "-rf", "-p", "no:cacheprovider", "-k", chosen)
    command = [sys.executable, *how, *TESTS]
    try:
        ran = subprocess.run(
            command, cwd=ROOT, env={**os.environ, "POISE_WARP": "1"}, capture_output=True, text=True,
            timeout=max(1.0, until - time.monotonic()), check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return {"finished": False, "note": "stopped by the clock; the kernels that it compiled are kept"}
    lines = ran.stdout.splitlines()
    counts = re.findall(r"(\d+) (passed|failed|errors?|skipped)", lines[-1] if lines else "")
    failed = [line.removeprefix("FAILED ") for line in lines if line.startswith("FAILED ")]
    return {"exit_code": ran.returncode, **{name: int(n) for n, name in counts}, "which_failed": failed}
