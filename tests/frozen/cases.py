"""What the frozen twin compares; knows no name of Poise, all of which `steps_old` and `steps_new` know.

Each of the two scripts is an `api` of functions of the same names over its own version of Poise:

    python steps_old.py OUT.npz [CASE ...]
"""

from __future__ import annotations

import io
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

STEPS, FEW_STEPS, WORLDS, SEED = 300, 60, 16, 3
HERE = Path(__file__).resolve().parent
#: Tasks with environments that are stepped; `api.environment(name)` makes them.
TASKS = (
    "imitate",
    "imitate_schedule",
    "imitate_linear",
    "explicit",
    "local_phase_absolute",
    "deepmimic",
    "perpetual",
    "perpetual_recovery_primitive",
    "perpetual_recovery_composer",
    "perpetual_ways",
    "perpetual_shapes",
    "perpetual_keypoints",
    "perpetual_additive",
    "perpetual_style",
    "shipped",
)
#: Jobs that give arrays by name; `api.JOBS[name](folder)` does them.
JOBS = (
    "track",
    "track_search",
    "track_recover",
    "track_noise_crowd",
    "imitation_run",
    "expert_run",
    "perpetual_run",
    "perpetual_ways_run",
    "verbs",
)


def motions() -> dict[str, np.ndarray]:
    """Clips of a small human, `NAME/pos (T, 3)` and `NAME/rot (T, J, 4)`, and its skeleton."""
    with np.load(HERE / "motions.npz") as file:
        return dict(file)


def array(value: Any) -> np.ndarray:
    """A copy as an array."""
    if isinstance(value, torch.Tensor):
        return value.detach().cpu().clone().numpy()
    return np.array(value)


def stepped(api: Any, name: str) -> dict[str, np.ndarray]:
    """An environment of a task under small random actions."""
    env = api.environment(name)
    rng = torch.Generator().manual_seed(SEED)
    rows: dict[str, list[np.ndarray]] = {}
    rows["first"] = [array(api.reset(env))]
    for t in range(STEPS):
        # Now and then large enough that characters fall, are truncated or fail.
        size = 0.1 if t % 100 < 60 else 0.3
        action = size * torch.randn(api.worlds(env), api.actions(env), generator=rng)
        for key, value in api.step(env, action).items():
            rows.setdefault(key, []).append(array(value))
    out = {key: np.stack(values) for key, values in rows.items()}
    out |= {f"after/{k}": array(v) for k, v in api.state(env).items()}
    # Evaluations begin from stated frames.
    clip = torch.arange(api.worlds(env)) % api.clips(env)
    out["started"] = array(api.reset_to(env, clip, torch.full_like(clip, 5)))
    api.close(env)
    return out


def numbers(value: Any, name: str = "") -> dict[str, np.ndarray]:
    """Numbers, texts and arrays in nested dictionaries and lists, by path."""
    if isinstance(value, dict):
        return {p: x for k, v in value.items() for p, x in numbers(v, f"{name}/{k}").items()}
    if isinstance(value, list | tuple) and any(isinstance(v, dict | list | tuple) for v in value):
        return {p: x for k, v in enumerate(value) for p, x in numbers(v, f"{name}/{k}").items()}
    return {name.lstrip("/"): np.array("none") if value is None else array(value)}


def file_bytes(path: Path) -> np.ndarray:
    """What a file holds."""
    return np.frombuffer(path.read_bytes(), np.uint8)


def run(api: Any) -> None:
    """Does the cases of the command line, all by default, and writes them into its first argument."""
    torch.set_num_threads(1)
    out, chosen = Path(sys.argv[1]), sys.argv[2:]
    kept: dict[str, np.ndarray] = {"poise": np.array(str(api.WHERE))}
    done: list[tuple[str, Callable[[], dict[str, np.ndarray]]]] = []
    done += [(name, lambda n=name: stepped(api, n)) for name in TASKS]
    done += [(name, lambda n=name: _job(api, n)) for name in JOBS]
    for name, make in done:
        if chosen and name not in chosen:
            continue
        start = time.perf_counter()
        torch.manual_seed(0)
        kept |= {f"{name}:{k}": v for k, v in make().items()}
        print(f"{name} {time.perf_counter() - start:.1f} s", file=sys.stderr, flush=True)
    buffer = io.BytesIO()
    np.savez(buffer, **kept)
    out.write_bytes(buffer.getvalue())


def _job(api: Any, name: str) -> dict[str, np.ndarray]:
    with tempfile.TemporaryDirectory() as folder:
        return api.JOBS[name](Path(folder))
