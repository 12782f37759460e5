"""Analytic inverse kinematics: from joint positions to hinge angles, and the last millimetres."""

# pyright: reportUnknownArgumentType=false, reportUnknownMemberType=false, reportUnknownVariableType=false
from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from poise.body import Humanoid, make_spec
from poise.errors import PoiseError, did_you_mean
from poise.kinematics.ik_bodies import IkBody, arc, rotate
from poise.kinematics.ik_frames import (
    BodyFrames,
    IkConfig,
    continuous_euler,
    pointing_angles,
    rest_frames,
    unwrapped,
    zyx_angles,
    zyx_matrix,
)
from poise.motion import Clip
from poise.motion.rotations import euler_to_quat, matrix_to_quat, normalize, quat_to_matrix, unwrap_quats

if TYPE_CHECKING:
    import mujoco


def analytic_ik(
    positions: np.ndarray,
    body: Humanoid | IkBody,
    config: IkConfig | None = None,
    names: Sequence[str] | None = None,
    rotations: np.ndarray | None = None,
) -> np.ndarray:
    """Generalized coordinates `(T, 7 + hinges)` of a humanoid with joints where they are asked to lie.

    Skeleton2Humanoid, section 3.3 and appendix A, Eqs. 5 to 24, for every humanoid that is generated:
    each body part gets a frame from positions (`ik_frames.BodyFrames`), the frames' relative rotations
    become hinge angles (Eq. 6), and angles are made continuous (Eq. 7).

    Args:
        positions: `(T, N, 3)` m, world, of the joints in `names`.
        body: the humanoid; an `IkBody` made beforehand saves milliseconds.
        config: which errors of the paper are corrected; all by default.
        names: `N` joint names; all of the humanoid's bodies must be among them. Toes are used where
            they are given. By default `IkBody.points`, with or without the toes.
        rotations: `(T, N, 4)` wxyz, world, of the same joints on the humanoid's own skeleton. Turns that
            positions do not show (about a bone) follow them; by default they follow the neighbours.

    Raises:
        PoiseError: a joint that is missing, positions that are not finite or of the wrong shape.
    """
    body = IkBody.of(body) if isinstance(body, Humanoid) else body
    config = config or IkConfig()
    points, turns = _gather(np.asarray(positions, dtype=np.float64), body, names, rotations)
    wanted = _rotations(points, body, config, turns)
    return _coordinates(points, wanted, body, config)


def clip_ik(clip: Clip, body: Humanoid | IkBody, config: IkConfig | None = None) -> np.ndarray:
    """`analytic_ik` of a clip's joint positions on the humanoid of its own skeleton."""
    return analytic_ik(clip.positions(), body, config, clip.skeleton.names)


def _gather(
    positions: np.ndarray, body: IkBody, names: Sequence[str] | None, rotations: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray | None]:
    """Positions `(T, P, 3)` in the body's order (NaN for toes that are not given), rotations alike."""
    rows = len(body.table.rows)
    if positions.ndim != 3 or positions.shape[-1] != 3 or not len(positions):
        raise PoiseError(f"positions must be (T, joints, 3), got {positions.shape}", code="wrong-shape")
    names = tuple(names) if names is not None else body.points[: positions.shape[1]]
    if len(names) != positions.shape[1] or (
        rotations is not None and rotations.shape != (*positions.shape[:2], 4)
    ):
        raise PoiseError(
            f"there are {len(names)} joint names for positions of shape {positions.shape}"
            + ("" if rotations is None else f" and rotations of shape {rotations.shape}"),
            code="count-differs",
        )
    for name in body.points[:rows]:
        if name not in names:
            raise PoiseError(
                f"the position of '{name}' is missing. {did_you_mean(name, names)}", code="joint-missing"
            )
    at = [names.index(n) if n in names else -1 for n in body.points]
    points = positions[:, at]
    points[:, [i for i, a in enumerate(at) if a < 0]] = np.nan
    bad = ~np.isfinite(points[:, [i for i, a in enumerate(at) if a >= 0]])
    if bad.any():
        frame = int(np.argwhere(bad)[0][0])
        raise PoiseError(f"a joint position is not finite at frame {frame}", code="not-finite")
    if rotations is None:
        return points, None
    turns = np.asarray(rotations, dtype=np.float64)[:, at[:rows]]
    return points, quat_to_matrix(turns)


def _rotations(
    points: np.ndarray, body: IkBody, config: IkConfig, turns: np.ndarray | None
) -> dict[int, np.ndarray]:
    """World rotations `(T, 3, 3)` of the rows that positions tell something about."""
    frames, rest = BodyFrames(points, body, config), rest_frames(body, config)
    if not config.square:
        return _paper_rotations(frames, rest, body)
    out: dict[int, np.ndarray] = {}
    for row, frame in frames.frames.items():
        # F = B A with A fixed in the body: B = F F_rest^T B_rest
        fixed = rest.frames[row][0].T @ body.rest_rot[row]
        out[row] = frame @ fixed
        if turns is not None and row not in body.clusters:
            tip = _tip(body, row)
            bone = body.rest_rot[row].T @ normalize(body.rest_pos[tip] - body.rest_pos[row])
            along = normalize(points[:, tip] - points[:, row])
            out[row] = arc(rotate(turns[:, row], bone), along) @ turns[:, row]
    return out


def _paper_rotations(frames: BodyFrames, rest: BodyFrames, body: IkBody) -> dict[int, np.ndarray]:
    """The same through Eq. 6 from parent to child, whatever it makes of frames that are not square."""
    rows = body.table.rows
    out = {0: frames.frames[0] @ rest.frames[0][0].T @ body.rest_rot[0]}
    fixed = {0: body.rest_rot[0].T @ rest.frames[0][0]}
    for row in sorted(frames.frames):
        if row == 0:
            continue
        p = rows[row].parent
        while p not in out:
            p = rows[p].parent
        both = [(f.knee_parent.get(row, f.frames[p]), f.frames[row]) for f in (frames, rest)]
        turn, still = (zyx_matrix(zyx_angles(a, b)) for a, b in both)
        # B_c = B_p A_p M A_c^T, with A_c such that the rest pose comes out at rest.
        fixed[row] = body.rest_rot[row].T @ body.rest_rot[p] @ fixed[p] @ still[0]
        out[row] = out[p] @ fixed[p] @ turn @ fixed[row].T
    return out


def _tip(body: IkBody, row: int) -> int:
    """The point at the far end of a row's bone, -1 where there is none."""
    for arm in body.arms:
        if row in (arm.upper, arm.lower):
            return arm.lower if row == arm.upper else arm.end
    if row in body.toes:
        return body.toes[row]
    return next((i for i, r in enumerate(body.table.rows) if r.parent == row), -1)


def _coordinates(
    points: np.ndarray, wanted: dict[int, np.ndarray], body: IkBody, config: IkConfig
) -> np.ndarray:
    """qpos from world rotations: three hinges make any rotation, fewer point their bone."""
    rows = body.table.rows
    angles: dict[int, np.ndarray] = {}
    world: list[np.ndarray] = [wanted[0]]
    free: list[int] = []
    for i, row in enumerate(rows[1:], 1):
        if len(row.order) == 3 and i in wanted:
            free.append(i)
            world.append(wanted[i])
            continue
        zero = world[row.parent] @ body.links[i]
        tip = _tip(body, i)
        if not row.order or tip < 0 or bool(np.isnan(points[0, tip, 0])):
            angles[i] = np.zeros((len(points), len(row.order)))
            world.append(zero)
            continue
        bone = body.rest_rot[i].T @ normalize(body.rest_pos[tip] - body.rest_pos[i])
        along = normalize(points[:, tip] - points[:, i])
        if len(row.order) == 3:
            # The bone is seen and its twist is not (necks): the smallest turn from the parent.
            free.append(i)
            world.append(arc(rotate(zero, bone), along) @ zero)
        else:
            seen, axes = rotate(zero.mT, along), body.axes[i]
            angles[i] = pointing_angles(bone, seen, row.order, axes)
            turn = quat_to_matrix(euler_to_quat(angles[i], row.order))
            world.append(zero @ axes @ turn @ axes.T)
    angles.update(_free_angles(free, np.stack(world, 1), body, config))
    hinges = np.concatenate([angles[i] for i in sorted(angles)], -1)
    hinges = unwrapped(hinges) if config.on("branches") else hinges
    root = unwrap_quats(matrix_to_quat(world[0]))
    return np.concatenate((points[:, 0], root, hinges), -1)


def _free_angles(
    free: list[int], world: np.ndarray, body: IkBody, config: IkConfig
) -> dict[int, np.ndarray]:
    """Angles `(T, 3)` of rows with three hinges from all world rotations `(T, R, 3, 3)`."""
    parents = [body.table.rows[i].parent for i in free]
    zero = world[:, parents] @ body.links[free]
    axes = body.axes[free]
    # The chain's rotation (B_parent link)^T B, stated in the hinges' own frame.
    local = axes.mT @ (zero.mT @ world[:, free]) @ axes
    out: dict[int, np.ndarray] = {}
    orders = [body.table.rows[i].order for i in free]
    for order in dict.fromkeys(orders):
        group = [k for k, o in enumerate(orders) if o == order]
        found = continuous_euler(local[:, group], order, config.on("branches"))
        out.update({free[g]: found[:, k] for k, g in enumerate(group)})
    return out


#: Weights against 1 for a target's metre: of hinge angles (m/rad), and of the pelvis (per m and rad).
POSTURE, ROOT = 3e-3, 0.2
#: A frame is done when all its targets are this near (mm), or three steps brought them no nearer.
STOP_MM = 0.1
#: Damping of each step.
DAMPING = 1e-8


@dataclass(frozen=True, eq=False)
class PolishResult:
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
) -> PolishResult:
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
    return PolishResult(qpos, was, now, time.perf_counter() - start, float(moved))


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
            raise PoiseError(
                f"there is no body or toe '{name}'. {did_you_mean(name, known)}", code="unknown-body"
            )
        out[name] = np.asarray(goal, dtype=np.float64)
        if out[name].shape != (frames, 3):
            raise PoiseError(
                f"the target of '{name}' must be ({frames}, 3), got {out[name].shape}",
                code="wrong-shape",
            )
    return out


def _mink() -> Any:
    """The optional package, imported late."""
    try:
        import mink
    except ImportError:
        raise PoiseError(
            "the polish step needs the package mink",
            hint="pip install 'poise-motion[ik]'",
            code="extra-missing",
        ) from None
    return mink
