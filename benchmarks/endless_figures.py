"""What motion without end visits: diversity, repeats, and the share of a library's motion."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from poise.body import Humanoid
from poise.kinematics.forward import Kinematics
from poise.motion.rotations import heading_quat, quat_conj, quat_rotate
from poise.synthesis.generator import Kinematic

#: s between the moments that are compared, and length of what is compared, s.
EVERY_S, LONG_S = 0.5, 2.0
#: Mean distance (m) of bodies below which two stretches are the same motion; s that lie between them.
SAME, APART_S = 0.08, 10.0


def local_places(humanoid: Humanoid, qpos: Tensor) -> Tensor:
    """Places of the bodies about the root, in its heading, `(T, B, 3)` m."""
    pos = Kinematics(humanoid.table)(qpos.double()).pos
    turn = quat_conj(heading_quat(qpos[:, 3:7].double()))[:, None].expand(-1, pos.shape[1], -1)
    return quat_rotate(turn, pos - pos[:, :1])


def repeats(humanoid: Humanoid, qpos: np.ndarray, fps: float) -> dict[str, Any]:
    """How much of a motion was there before: of its stretches of `LONG_S` the share that an earlier one,
    `APART_S` before, is like, and when that happens first."""
    local, step, long = local_places(humanoid, torch.tensor(qpos)), int(EVERY_S * fps), int(LONG_S * fps)
    starts = torch.arange(0, max(0, len(local) - long), step)
    if len(starts) < 2:
        return {"repeated_share": None, "first_repeat_s": None}
    bodies = local.shape[1]
    flat = torch.stack([local[s : s + long : 3].flatten() for s in starts])
    # Mean of distances by their root mean square, which is never smaller.
    apart = torch.cdist(flat, flat) / (flat.shape[1] / 3) ** 0.5
    assert flat.shape[1] % (3 * bodies) == 0
    early = starts[:, None] - starts[None] >= APART_S * fps
    least = torch.where(early, apart, torch.inf).amin(1)
    can = early.any(1)
    same = (least < SAME) & can
    first = same.nonzero()
    return {
        "repeated_share": round(float(same.sum() / can.sum().clamp_min(1)), 3),
        "first_repeat_s": round(float(starts[int(first[0])] / fps), 1) if len(first) else None,
    }


def visited(humanoid: Humanoid, seeds: Tensor, qpos: np.ndarray, fps: float) -> set[int]:
    """Which of `seeds (S, p, 7 + n)`, a second of the library each, evenly spread, are the nearest to
    some second of a motion."""
    p = seeds.shape[1]
    places = local_places(humanoid, seeds.flatten(0, 1)).unflatten(0, seeds.shape[:2])
    some = places[:, :: p // 5].flatten(1)
    local = local_places(humanoid, torch.tensor(qpos))
    own = [local[k : k + p : p // 5].flatten() for k in range(0, len(local) - p + 1, p // 2)]
    return set(torch.cdist(torch.stack(own), some).argmin(1).tolist()) if own else set()


def diversity(made: Kinematic, humanoid: Humanoid, samples: int = 10, seed: int = 0) -> dict[str, Any]:
    """APD: mean distance of futures of one past, of all bodies' places about the root over the whole
    segment, m; over every sixth of the pasts from which motions begin."""
    kin, rng = Kinematics(humanoid.table), torch.Generator().manual_seed(seed)
    apart, pasts = list[float](), made.seeds[::6]
    for past in pasts:
        out = made.propose(past[None].expand(samples, -1, -1), rng, 1)[:, 0]
        pos = kin(out).pos
        apart.append(float(torch.pdist((pos - pos[:, :, :1]).flatten(1)).mean()))
    return {"pasts": len(pasts), "samples": samples, "apd_m": round(float(np.mean(apart)), 3)}
