"""Whether a generated body stands under its servos alone, and replays its clip without sinking in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np
import torch

from poise.body import BodyConfig, Humanoid
from poise.kinematics import Kinematics, fit_ground, fit_humanoid, lowest_height
from poise.motion import Clip, Skeleton
from poise.sim import SimConfig, alone
from speed.stance import Stance, polygon_margin, relaxed_stance

#: A fall: the centre of mass below this share of its height, or anything but the feet on the floor.
FALLEN = 0.75
#: Depth (m) to which a kinematic replay may sink into the floor.
REPLAY_SINK_M = 0.004
RATE_HZ = 30.0


@dataclass(frozen=True)
class Standing:
    """How a body stood.

    seconds: until it fell, or the whole time. drop_m: how far the pelvis sank. sway_m: the farthest that
    the centre of mass went from where it began, horizontally. margin_m: the least distance of its
    projection inside the support polygon, negative outside. speed: the fastest coordinate, rad/s or m/s.
    warnings: of MuJoCo.
    """

    seconds: float
    drop_m: float
    sway_m: float
    margin_m: float
    speed: float
    warnings: int

    def to_dict(self) -> dict[str, float]:
        """The figures in s, mm, rad/s."""
        lengths = {"drop_mm": self.drop_m, "sway_mm": self.sway_m, "margin_mm": self.margin_m}
        return {
            "stood_s": round(self.seconds, 2),
            **{k: round(v * 1000, 1) for k, v in lengths.items()},
            "speed": round(self.speed, 2),
            "warnings": self.warnings,
        }


def stand(
    humanoid: Humanoid, stance: Stance, seconds: float = 10.0, config: SimConfig | None = None
) -> Standing:
    """Holds a stance by servos with its angles as targets: no feedback on the root, no other force."""
    spec = config or SimConfig()
    model = alone(humanoid, spec)
    data = mujoco.MjData(model)
    data.qpos[:], data.ctrl[:] = stance.qpos, stance.qpos[7:]
    mujoco.mj_forward(model, data)
    start, com = data.qpos[2], np.array(data.subtree_com[1])
    feet = {0, *(i + 1 for i in humanoid.feet)}
    drop = sway = speed = 0.0
    margin, fell = stance.margin_m, seconds
    for k in range(round(seconds * spec.rate_hz)):
        mujoco.mj_step(model, data)
        here = data.subtree_com[1]
        drop, speed = max(drop, start - data.qpos[2]), max(speed, float(np.abs(data.qvel).max()))
        sway = max(sway, float(np.linalg.norm((here - com)[:2])))
        margin = min(margin, polygon_margin(here[:2], stance.support))
        if here[2] < FALLEN * com[2] or not _floor_touchers(model, data) <= feet:
            fell = (k + 1) / spec.rate_hz
            break
    return Standing(fell, float(drop), sway, margin, speed, int(data.warning.number.sum()))


def _floor_touchers(model: mujoco.MjModel, data: mujoco.MjData) -> set[int]:
    """Bodies that touch the world."""
    pairs = model.geom_bodyid[data.contact.geom.reshape(-1, 2)]
    return {int(b) for pair in pairs if 0 in pair for b in pair}


def scaled(clip: Clip, factor: float) -> Clip:
    """The same motion of a person `factor` times as tall, at the same pace."""
    skeleton = clip.skeleton
    ends = tuple((j, (x * factor, y * factor, z * factor)) for j, (x, y, z) in skeleton.ends)
    larger: Skeleton = replace(skeleton, offsets=skeleton.offsets * factor, ends=ends)
    return clip.replaced(skeleton=larger, root_pos=clip.root_pos * factor)


def measure(clip: Clip, seconds: float = 10.0, config: BodyConfig | None = None) -> dict[str, Any]:
    """One skeleton: its body, how it stands, and how its own clip replays on it.

    `fitted_sink_mm` is the deepest point of the training reference, `sink_mm` of a replay that was asked
    for `REPLAY_SINK_M`, `lifted_mm` by how much more that was lifted (mean), `joints_mm` how far
    the body's joints are from the clip's on average.
    """
    humanoid, motions, report = fit_humanoid(clip, config, RATE_HZ)
    table = humanoid.table
    stance = relaxed_stance(humanoid)
    replay, _ = fit_ground(motions[0], table, RATE_HZ, report.cyclic[0], REPLAY_SINK_M)
    return {
        "joints": len(clip.skeleton),
        "bodies": len(table.rows),
        "hinges": len(humanoid.hinges),
        "mass_kg": round(humanoid.mass, 1),
        "height_m": round(table.height_m, 3),
        **stand(humanoid, stance, seconds).to_dict(),
        "stance_margin_mm": round(stance.margin_m * 1000, 1),
        "frames": len(replay),
        "fitted_sink_mm": _sink_mm(humanoid, motions[0]),
        "sink_mm": _sink_mm(humanoid, replay),
        "lifted_mm": round(float((replay - motions[0])[:, 2].mean()) * 1000, 1),
        "joints_mm": round(report.clips[0].joint_error_mm, 2),
    }


def _sink_mm(humanoid: Humanoid, qpos: np.ndarray) -> float:
    """The deepest point of any shape under the floor over all frames, mm."""
    state = Kinematics(humanoid.table)(torch.tensor(qpos))
    low = float(lowest_height(humanoid.table, state.pos, state.quat).min())
    return round(max(-low, 0.0) * 1000, 2)


def table_lines(rows: dict[str, dict[str, Any]], columns: Sequence[tuple[str, str]]) -> list[str]:
    """A Markdown table of named rows; columns are (key, heading)."""
    out = ["| | " + " | ".join(head for _, head in columns) + " |", "|---" * (len(columns) + 1) + "|"]
    for name, row in rows.items():
        out.append(f"| {name} | " + " | ".join(f"{row[key]:g}" for key, _ in columns) + " |")
    return out
