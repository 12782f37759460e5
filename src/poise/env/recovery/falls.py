"""Characters that lie on the floor, from which episodes can begin (PHC Sec. 3.3, after ASE)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from poise.body import Humanoid
from poise.control import PDTargets
from poise.errors import PoiseError
from poise.kinematics import Kinematics, lowest_height
from poise.motion.rotations import normalize
from poise.settings import Checked, Count, Positive
from poise.sim import Backend

#: Physics steps over which a random torque is held.
HELD = 2
#: Lowest point of a state that lies, m: above it flies, below it is stuck in the floor.
HIGHEST, DEEPEST = 0.0, -0.03
#: Height above the floor, m, from which characters fall, so that none begins in contact.
CLEAR = 0.03
#: Of the standing height of the root, above which a character has not fallen.
FALLEN = 0.6
#: So often those that did not fall well are dropped again.
ROUNDS = 5


@dataclass(frozen=True)
class Drop(Checked):
    """How characters are let fall: in a random orientation from standing height, then driven a while.

    Attributes:
        by: "torques", random ones of every hinge, drawn anew every other physics step (the paper), or
            "action", one random action held by the servos (the code).
        size: of the torques as a share of each servo's limit, or of the actions.
        steps: physics steps.
        count: K, how many states are kept.
    """

    by: Literal["torques", "action"] = "torques"
    size: Positive = 0.2
    steps: Count = 150
    count: Count = 512


def fall_states(
    backend: Backend, humanoid: Humanoid, pd: PDTargets, drop: Drop, seed: int = 0
) -> Tensor:
    """`(K, nq)` float64 on the CPU: characters at rest on the floor, roots above the origin.

    All worlds of `backend` are used together and come back as they were, bit for bit. The same seed
    gives the same states whatever their number.

    Raises:
        PoiseError: characters of this body do not come to lie.
    """
    rng = torch.Generator().manual_seed(seed)
    kept = torch.zeros(0, backend.model.nq, dtype=torch.float64)
    before = backend.snapshot()
    stand = standing_height(humanoid)
    for _ in range(ROUNDS):
        fallen = _dropped(backend, humanoid, pd, drop, drop.count - len(kept), stand, rng)
        kept = torch.cat((kept, fallen[lies(humanoid, fallen)]))
        if len(kept) == drop.count:
            break
    backend.restore(before)
    backend.unstable()  # What went bad in the air is none of the worlds' own.
    if len(kept) < drop.count:
        raise PoiseError(
            f"of {ROUNDS} drops each, {drop.count - len(kept)} of {drop.count} characters did not come "
            "to lie on the floor",
            hint="Drop them for more steps, or drive them less",
            code="fall-unsettled",
        )
    kept[:, :2] = 0.0
    return kept


def standing_height(humanoid: Humanoid) -> float:
    """Height of the root, m, of a character that stands on the floor with its hinges at zero."""
    upright = torch.zeros(1, humanoid.model.nq, dtype=torch.float64)
    upright[:, 3] = 1.0
    upright[:, 7:] = rest_angles(humanoid)
    return -float(_lowest(humanoid, upright))


def lies(humanoid: Humanoid, qpos: Tensor) -> Tensor:
    """`(N,)` bool of `qpos (N, nq)`: finite, on the floor, not deep in it, and down."""
    finite = qpos.isfinite().all(-1)
    low = _lowest(humanoid, torch.where(finite.unsqueeze(-1), qpos, _upright(qpos)))
    down = qpos[:, 2] < FALLEN * standing_height(humanoid)
    return finite & (low < HIGHEST) & (low > DEEPEST) & down


def _dropped(
    backend: Backend,
    humanoid: Humanoid,
    pd: PDTargets,
    drop: Drop,
    count: int,
    height: float,
    rng: torch.Generator,
) -> Tensor:
    """`(count, nq)` of characters some time after they were let go at `height` m."""
    hinges, rounds = len(humanoid.hinges), -(-drop.steps // HELD)
    start = torch.zeros(count, backend.model.nq, dtype=torch.float64)
    start[:, 3:7] = normalize(torch.randn(count, 4, dtype=torch.float64, generator=rng))
    start[:, 7:] = rest_angles(humanoid)
    # Arms and head may reach below the feet of a body that stands, so none begins in the floor.
    start[:, 2] = torch.maximum(torch.tensor(height), -_lowest(humanoid, start)) + CLEAR
    times = rounds if drop.by == "torques" else 1
    push = drop.size * (2.0 * torch.rand(times, count, hinges, generator=rng) - 1.0)
    end = torch.empty_like(start)
    for rows in torch.arange(count).split(backend.num_envs):
        # Worlds beyond the number that is asked for repeat the first ones.
        world = rows[torch.arange(backend.num_envs) % len(rows)]
        backend.write(None, start[world].to(backend.device), _still(backend))
        if drop.by == "action":
            _hold(backend, pd, push[0, world])
            backend.step(drop.steps)
        else:
            _drive(backend, push[:, world], drop.steps)
        end[rows] = backend.state.qpos[: len(rows)].double().cpu()
    return end


def _hold(backend: Backend, pd: PDTargets, action: Tensor) -> None:
    """One action held; additive ones are added to hinges at zero."""
    backend.drive.clear()
    action = action.to(backend.device)
    pd.apply(action, torch.zeros_like(action), backend.drive)


def _drive(backend: Backend, shares: Tensor, steps: int) -> None:
    """Torques `(T, N, n)` of each servo's limit, by targets as far from the hinges as they ask for."""
    model, device = backend.model, backend.device
    gain = torch.tensor(model.actuator_gainprm[:, 0]).to(device)
    limit = torch.tensor(model.actuator_forcerange[:, 1]).to(device)
    for share in shares.to(device):
        backend.drive.clear()
        # tau = kp (u - q)
        target = backend.state.qpos[:, 7:] + share * limit / gain
        backend.drive.ctrl.add_(target.to(backend.drive.ctrl.dtype))
        backend.step(min(HELD, steps))
        steps -= HELD


def _still(backend: Backend) -> Tensor:
    return torch.zeros(backend.num_envs, backend.model.nv, dtype=torch.float64, device=backend.device)


def rest_angles(humanoid: Humanoid) -> Tensor:
    """Hinges at zero, or at the nearest angle that they can take, rad `(n,)`."""
    model = humanoid.model
    low, high = torch.tensor(model.jnt_range[1:]).unbind(-1)
    limited = torch.tensor(model.jnt_limited[1:]).bool()
    return torch.where(limited, torch.zeros_like(low).clamp(low, high), 0.0)


def _upright(like: Tensor) -> Tensor:
    pose = torch.zeros_like(like)
    pose[:, 3] = 1.0
    return pose


def _lowest(humanoid: Humanoid, qpos: Tensor) -> Tensor:
    """Height of the lowest point of the body, m `(N,)`."""
    still = torch.zeros(len(qpos), humanoid.model.nv, dtype=torch.float64)
    body = Kinematics(humanoid.table)(qpos, still)
    return lowest_height(humanoid.table, body.pos, body.quat).amin(-1)
