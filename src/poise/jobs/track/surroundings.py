"""The world of a character that tracks: supports, and the others of a crowd."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import mujoco
import numpy as np

from poise.body import Humanoid
from poise.errors import PoiseError
from poise.formats.figure import SceneBox
from poise.formats.gltf_write import write_gltf
from poise.formats.text import write_whole
from poise.jobs.result import Result
from poise.jobs.track.placement import PlacedMotion
from poise.kinematics.find_supports import find_supports
from poise.kinematics.supports import Support
from poise.recipes.imitation import Imitation
from poise.sim import Character, CharacterRows, Scene, SceneSim, SimConfig
from poise.sim.props import Box, Prop

#: Which supports there are, see `TrackConfig.supports`.
Wanted = Literal["auto", "none"] | tuple[Support, ...]
#: How deep a part may begin in a support, m.
DEEP_M = 0.1


def with_supports(
    imitation: Imitation, wanted: Wanted, placed: PlacedMotion
) -> tuple[tuple[Support, ...], Imitation]:
    """Supports of a task's only motion, in its body's world, and the task with them.

    wanted: see `TrackConfig.supports`.
    """
    if wanted == "none":
        return (), imitation
    if wanted == "auto":
        r, table = imitation.reference, imitation.humanoid.table
        found = find_supports(table, r.pose.pos.numpy(), r.pose.quat.numpy(), r.rate_hz)
    else:
        found = on_body(wanted, placed)
    return found, supported(imitation, found) if found else imitation


def supported(imitation: Imitation, supports: Sequence[Support]) -> Imitation:
    """The task with supports in its world, as boxes that nothing moves.

    Raises:
        PoiseError: one in which the character would begin.
    """
    boxes = tuple(Box(f"{s.kind}{k}", s.size, s.pos, s.quat) for k, s in enumerate(supports, 1))
    made = replace(imitation, props=boxes)
    _check_start(made)
    return made


def on_body(supports: Sequence[Support], placed: PlacedMotion) -> tuple[Support, ...]:
    """Supports that were stated beside the motion that came in, in the world of the body, which is as
    much larger as the body, about where the motion begins, and has its floor at z = 0."""
    scaled = _scaled(supports, placed, placed.moved.scale if placed.moved else 1.0)
    return _raised(scaled, placed.report.clips[0].ground.lift_m)


def at_home(supports: Sequence[Support], placed: PlacedMotion) -> tuple[Support, ...]:
    """Supports beside the motion on the skeleton that came in."""
    lowered = _raised(supports, -placed.report.clips[0].ground.lift_m)
    return _scaled(lowered, placed, 1.0 / placed.moved.scale if placed.moved else 1.0)


def places_home(pos: np.ndarray, placed: PlacedMotion) -> np.ndarray:
    """Places `(..., 3)` m in the body's world beside the motion on the skeleton that came in."""
    scale = 1.0 / placed.moved.scale if placed.moved else 1.0
    about = np.array([*placed.source.root_pos[0, :2], 0.0])
    lowered = pos - np.array([0.0, 0.0, placed.report.clips[0].ground.lift_m])
    return about + (lowered - about) * scale


def write_supports(result: Result, out: Path, motion: Path, hold: bool) -> dict[str, Path]:
    """Writes what a motion rests on, beside the motion on the skeleton that came in: `supports.json`,
    which --support reads, and boxes in a GLB with the motion, its own file where that is one, else
    `scene.glb`."""
    if not result.supports:
        return {}
    supports, clip = at_home(result.supports, result.placed), result.delivered(0, hold)
    scene = motion if motion.suffix.lower() in (".glb", ".gltf") else out / "scene.glb"
    boxes = [SceneBox(f"{s.kind}{k}", s.size, s.pos, s.yaw) for k, s in enumerate(supports, 1)]
    write_gltf(clip, scene, boxes)
    stated = out / "supports.json"
    write_whole(stated, json.dumps([s.to_dict() for s in supports], indent=2) + "\n")
    return {"supports": stated} | ({} if scene == motion else {"scene": scene})


def _scaled(supports: Sequence[Support], placed: PlacedMotion, scale: float) -> tuple[Support, ...]:
    if scale == 1.0:
        return tuple(supports)
    x, y, _ = (float(v) for v in placed.source.root_pos[0])
    return tuple(
        replace(
            s,
            size=(s.size[0] * scale, s.size[1] * scale, s.size[2] * scale),
            pos=(x + (s.pos[0] - x) * scale, y + (s.pos[1] - y) * scale, s.pos[2] * scale),
        )
        for s in supports
    )


def _raised(supports: Sequence[Support], height: float) -> tuple[Support, ...]:
    return tuple(replace(s, pos=(s.pos[0], s.pos[1], s.pos[2] + height)) for s in supports)


def _check_start(imitation: Imitation) -> None:
    """Refuses a world in which the character begins deep inside a support."""
    env = imitation.bare().env(1, None, False, 1, help_scale=0.0, guard=False)
    try:
        model, data = env.backend.get_model(0), env.backend.get_data(0)
        first = imitation.reference.qpos[0].numpy()
        data.qpos[: len(first)] = first
        mujoco.mj_forward(model, data)
        for contact in data.contact[: data.ncon]:
            names = [model.body(int(model.geom_bodyid[g])).name for g in contact.geom]
            box = next((n for n in names if n in {b.name for b in imitation.props}), None)
            if box is not None and contact.dist < -DEEP_M:
                other = names[1 - names.index(box)]
                raise PoiseError(
                    f"the motion begins with {other} {-contact.dist:.2f} m inside {box}",
                    imitation.library.names[0],
                    "Move it, or make it smaller",
                    code="bodies-overlap",
                )
    finally:
        env.close()


#: Metres between characters that begin side by side.
APART_M = 2.0


def places(count: int) -> np.ndarray:
    """`(N, 2)` m, where each of N characters begins: rows and columns about the first one's place."""
    wide = math.ceil(math.sqrt(count))
    at = np.arange(count)
    return APART_M * np.stack((at // wide, at % wide), 1).astype(float)


def crowd(
    humanoid: Humanoid, sim: SimConfig, count: int, props: Sequence[Prop | Character] = ()
) -> CharacterRows:
    """N copies of a body on one floor, each a row, with what else stands there; names of all but the
    first begin with "2/", ..."""
    names = ("", *(str(k + 1) for k in range(1, count)))
    things = (*(Character(humanoid, name) for name in names), *props)
    return SceneSim(Scene(things, sim=sim), 1, threads=1).characters()
