"""The last millimetres: joints that must lie somewhere exactly, by the kept library mink."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from poise.body import Humanoid, make_spec
from poise.errors import PoiseError, did_you_mean
from poise.kin.ik.body import IkBody

if TYPE_CHECKING:
    import mujoco

#: Weights against 1 for a target's metre: of hinge angles (m/rad), and of the pelvis (per m and rad).
POSTURE, ROOT = 3e-3, 0.2
#: A frame is done when all its targets are this near (mm), or three steps brought them no nearer.
STOP_MM = 0.1
#: Damping of each step.
DAMPING = 1e-8


@dataclass(frozen=True, eq=False)
class Polished:
    """qpos: `(T, 7 + hinges)`. before_mm, after_mm: mean distance of the targets. seconds: wall time.
    moved_deg: the largest change of a hinge angle."""

    qpos: np.ndarray
    before_mm: float
    after_mm: float
    seconds: float
    moved_deg: float


def polish(
    qpos: np.ndarray,
    targets: Mapping[str, np.ndarray],
    humanoid: Humanoid,
    steps: int = 12,
) -> Polished:
    """The motion with joints on their targets, as near to `qpos (T, 7 + hinges)` as they allow.

    Per frame, quadratic programs min |J dq - e|^2 + |W dq|^2 by mink (FrameTask and PostureTask), from
    the analytic answer; about a millisecond a step, so use it where contacts or positions are missed.

    Args:
        targets: `(T, 3)` m world of bodies or toes by name (`IkBody.points`); NaN rows are free.
        steps: Gauss-Newton steps per frame at most.

    Raises:
        PoiseError: mink is not installed, an unknown target, a wrong shape.
    """
    mink = _mink()
    start = time.perf_counter()
    given = np.asarray(qpos, dtype=np.float64)
    qpos = given.copy()
    goals = _checked(targets, humanoid, len(qpos))
    model = _with_toes(humanoid)
    body = IkBody.of(humanoid)
    tasks = {
        name: mink.FrameTask(
            name, _kind(name, body), position_cost=1.0, orientation_cost=0.0, lm_damping=1.0
        )
        for name in goals
    }
    pelvis = body.points[0]
    keep = mink.FrameTask(pelvis, "body", position_cost=ROOT, orientation_cost=ROOT)
    posture = mink.PostureTask(model, cost=POSTURE)
    state = mink.Configuration(model)
    before, after = [], []
    for t, q in enumerate(qpos):
        state.update(q)
        here = {n: g[t] for n, g in goals.items() if np.isfinite(g[t]).all()}
        if not here:
            continue
        keep.set_target_from_configuration(state)
        posture.set_target(q)
        for name, goal in here.items():
            # The target takes the joint's own orientation, so that only the position is wanted.
            turn = state.get_transform_frame_to_world(name, _kind(name, body)).rotation()
            tasks[name].set_target(mink.SE3.from_rotation_and_translation(turn, goal))
        active = [tasks[n] for n in here]
        error = _errors(state, here, body)
        before.append(error.mean())
        best, best_q, worse = error.max(), state.q.copy(), 0
        for _ in range(steps):
            if best < STOP_MM or worse > 2:
                break
            velocity = mink.solve_ik(
                state, [*active, keep, posture], 1.0, "daqp", damping=DAMPING, limits=[]
            )
            state.integrate_inplace(velocity, 1.0)
            error = _errors(state, here, body)
            worse = worse + 1 if error.max() > 0.99 * best else 0
            if error.max() < best:
                best, best_q = error.max(), state.q.copy()
        state.update(best_q)
        after.append(_errors(state, here, body).mean())
        qpos[t] = best_q
    moved = np.degrees(np.abs(qpos[:, 7:] - given[:, 7:]).max(initial=0.0))
    was, now = (float(np.mean(x)) if x else 0.0 for x in (before, after))
    return Polished(qpos, was, now, time.perf_counter() - start, float(moved))


def _errors(state: Any, here: Mapping[str, np.ndarray], body: IkBody) -> np.ndarray:
    """Distance (mm) of every target."""
    at = [state.get_transform_frame_to_world(n, _kind(n, body)).translation() for n in here]
    return np.linalg.norm(np.array(at) - np.array([*here.values()]), axis=-1) * 1000


def _kind(name: str, body: IkBody) -> str:
    """What MuJoCo calls a point: toes are sites of the foot."""
    return "body" if name in body.points[: len(body.table.rows)] else "site"


def _with_toes(humanoid: Humanoid) -> mujoco.MjModel:
    """The humanoid's model with a site on each toe joint."""
    body, spec = IkBody.of(humanoid), make_spec(humanoid.table)
    for foot, toe in body.toes.items():
        local = body.rest_rot[foot].T @ (body.rest_pos[toe] - body.rest_pos[foot])
        spec.body(humanoid.table.rows[foot].name).add_site(name=body.points[toe], pos=local.tolist())
    return spec.compile()


def _checked(
    targets: Mapping[str, np.ndarray], humanoid: Humanoid, frames: int
) -> dict[str, np.ndarray]:
    """The targets as arrays `(T, 3)`."""
    known, out = IkBody.of(humanoid).points, {}
    for name, goal in targets.items():
        if name not in known:
            raise PoiseError(f"there is no body or toe '{name}'. {did_you_mean(name, known)}")
        out[name] = np.asarray(goal, dtype=np.float64)
        if out[name].shape != (frames, 3):
            raise PoiseError(f"the target of '{name}' must be ({frames}, 3), got {out[name].shape}")
    return out


def _mink() -> Any:
    """The optional package, imported late."""
    try:
        import mink
    except ImportError:
        raise PoiseError(
            "the polish step needs the package mink", hint="pip install 'poise-motion[ik]'"
        ) from None
    return mink
