"""A motion moved between skeletons, bodies that stand, and repair beside filters.

Retargeting is of every pair among nine skeletons; onto itself (the null) a motion must not change.
Bodies of eleven makers and five sizes stand under their servos alone, 60 Hz physics as in training.
Repair is measured by `benchmarks/repair.py`, whose rows stand in `results/repair*.csv`; nothing repaired
is its null.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import permutations
from typing import Any

import mujoco
import numpy as np
import torch

from benchmarks.common.clips import Places, moment
from benchmarks.common.rows import Figure, mean_of, median_of, of
from benchmarks.common.runner import ROOT, Part, Raws, script
from benchmarks.common.stance import Stance, polygon_margin, relaxed_stance
from poise.body import BodyConfig, Humanoid, generate_table
from poise.formats import read_clip
from poise.kinematics import (
    Kinematics,
    RetargetReport,
    fit_ground,
    fit_humanoid,
    lowest_height,
    retarget,
)
from poise.motion import Clip, Skeleton, trim
from poise.motion.rotations import quat_distance
from poise.sim import SimConfig, alone

CLIPS = {
    "Bandai walk": "other/bandai_bvh/dataset-2_walk_active_005.bvh",
    "LAFAN1 walk": "lafan1_bvh/walk4_subject1.bvh",
    "CMU ASF walk": "cmu_amc/02/02_01.amc",
    "CMU Poser salsa": "cmu_bvh/acrnn_salsa/01.bvh",
    "DeepMimic walk": "deepmimic_txt/humanoid3d_walk.txt",
    "MASS walk": "other/mass_bvh/walk.bvh",
    "Xsens boxing": "other/xsens_bvh/251021_04_boxing_120Hz_cm_3DsMax.bvh",
    "Rokoko dance": "noisy/rokoko_video/jesse_dance.bvh",
    "CMU 3ds Max jacks": "cmu_bvh/ad/jumping_jacks.bvh",
}


def difference(a: Clip, b: Clip, joints: list[int]) -> dict[str, float]:
    """Distances (mm) and angles between local rotations (degrees) of some joints of two clips."""
    apart = np.linalg.norm(a.positions() - b.positions(), axis=-1)[:, joints] * 1000
    angle = torch.rad2deg(quat_distance(torch.tensor(a.rot), torch.tensor(b.rot)))[:, joints]
    return {
        "mean_mm": float(apart.mean()),
        "max_mm": float(apart.max()),
        "mean_deg": float(angle.mean()),
        "max_deg": float(angle.max()),
    }


def moved(report: RetargetReport) -> list[int]:
    """The target's joints that something moves."""
    return [row.target for row in report.joints.rows if row.source]


def compare(source: Clip, target: Clip) -> dict:
    """The figures of one pair."""
    began = time.process_time()
    made, report = retarget(source, target)
    seconds = time.process_time() - began
    back, again = retarget(made, source, example=target)
    return {
        "scale": report.scale,
        "direction_deg": report.direction_deg,
        "direction_max_deg": report.direction_max_deg,
        "trunk_deg": report.trunk_deg,
        "end_percent": report.end_percent,
        "contact_s": report.contact_s,
        "slide_mm_s": report.slide_mm_s,
        "depth_mm": report.depth_mm,
        "depth_max_mm": report.depth_max_mm,
        "frames": source.frames,
        "seconds": seconds,
        "there_and_back": difference(source, back, moved(again)),
    }


# --- standing --------------------------------------------------------------------------------------


#: Skeletons of as many makers: name, clip, its skeleton file.
MAKERS = {
    "CMU ASF": ("cmu_amc/rfc/90_02.amc", "cmu_amc/rfc/08.asf"),
    "LAFAN1": ("lafan1_bvh/walk4_subject1.bvh", ""),
    "Bandai Namco": ("other/bandai_bvh/dataset-1_walk_normal_001.bvh", ""),
    "acRNN salsa": ("cmu_bvh/acrnn_salsa/01.bvh", ""),
    "dance001": ("cmu_bvh/ad/dance001.bvh", ""),
    "CMU BVH, jumping jacks": ("cmu_bvh/ad/jumping_jacks.bvh", ""),
    "back handspring": ("cmu_bvh/ad/back_handspring1_autolabel.bvh", ""),
    "Rokoko video": ("noisy/rokoko_video/jesse_dance.bvh", ""),
    "MASS": ("other/mass_bvh/walk.bvh", ""),
    "Xsens": ("other/xsens_bvh/251021_04_boxing_120Hz_cm_3DsMax.bvh", ""),
    "DeepMimic": ("deepmimic_txt/humanoid3d_walk.txt", ""),
}


#: One skeleton at these heights, m.
SIZED, HEIGHTS = "LAFAN1", (0.9, 1.2, 1.8, 2.5, 3.5)


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
    humanoid: Humanoid,
    stance: Stance,
    seconds: float = 10.0,
    config: SimConfig | None = None,
    limp: bool = False,
) -> Standing:
    """Holds a stance by servos with its angles as targets: no feedback on the root, no other force.

    limp: the servos give nothing.
    """
    spec = config or SimConfig()
    model = alone(humanoid, spec)
    if limp:
        model.actuator_gainprm[:] = model.actuator_biasprm[:] = 0.0
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
        "limp_s": stand(humanoid, stance, seconds, limp=True).seconds,
        "stance_margin_mm": round(stance.margin_m * 1000, 1),
        "frames": len(replay),
        "fitted_sink_mm": _sink_mm(humanoid, motions[0]),
        "sink_mm": _sink_mm(humanoid, replay),
        "lifted_mm": round(float((replay - motions[0])[:, 2].mean()) * 1000, 1),
        "joints_mm": round(report.clips[0].joint_error_mm, 2),
    }


def _sink_mm(humanoid: Humanoid, qpos: np.ndarray) -> float:
    """The deepest point of any shape under the floor over all frames, mm."""
    state = Kinematics(humanoid.table)(qpos)
    low = float(lowest_height(humanoid.table, state.pos, state.quat).min())
    return round(max(-low, 0.0) * 1000, 2)


# --- parts ----------------------------------------------------------------------------------------


def pairs(places: Places) -> list[str]:
    """Every pair, and each skeleton with itself."""
    names = list(CLIPS)[: 2 if places.smoke else None]
    return [*(f"{a} -> {b}" for a, b in permutations(names, 2)), *(f"{a} -> {a}" for a in names)]


def moved_pair(places: Places, unit: str) -> Any:
    """One pair, up to 300 frames of the clip."""
    a, b = unit.split(" -> ")
    clips = [
        moment(n) if places.smoke else trim(read_clip(places.data / CLIPS[n]), 0, 300) for n in (a, b)
    ]
    if a == b:
        made, _ = retarget(clips[0], clips[0])
        return difference(made, clips[0], list(range(len(made.skeleton))))
    return compare(*clips)


def pair_rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """Means over pairs; what changes onto itself."""
    same = [r for u, r in raws.items() if len(set(u.split(" -> "))) == 1]
    rows = [r for u, r in raws.items() if len(set(u.split(" -> "))) == 2]
    values = {
        "median_direction_deg": median_of(r["direction_deg"] for r in rows),
        "mean_direction_deg": mean_of(r["direction_deg"] for r in rows),
        "most_direction_deg": max(r["direction_deg"] for r in rows),
        "slide_mm_per_s": mean_of(r["slide_mm_s"][1] for r in rows),
        "source_slide_mm_per_s": mean_of(r["slide_mm_s"][0] for r in rows),
        "ends_percent": mean_of(r["end_percent"] for r in rows),
        "there_and_back_mm": mean_of(r["there_and_back"]["mean_mm"] for r in rows),
        "ms_a_frame": mean_of(1000 * r["seconds"] / r["frames"] for r in rows),
    }
    yield from of("pairs of nine skeletons", values, len(rows))
    null = {
        "farthest_mm": max(r["max_mm"] for r in same),
        "most_turn_deg": max(r["max_deg"] for r in same),
    }
    yield from of("a skeleton onto itself", null, len(same))


def bodies(places: Places) -> list[str]:
    """Makers and sizes."""
    return ["walk"] if places.smoke else [*MAKERS, *(f"{SIZED} at {h:g} m" for h in HEIGHTS)]


def stands(places: Places, unit: str) -> Any:
    """A body for ten seconds, and with servos that give nothing."""
    name, _, metres = unit.partition(" at ")
    if places.smoke:
        clip = moment()
    else:
        path, asf = MAKERS[name]
        clip = read_clip(places.data / path, skeleton=places.data / asf if asf else None)
    if metres:
        height = generate_table(clip.skeleton, None, [clip]).height_m
        clip = scaled(clip, float(metres.removesuffix(" m")) / height)
    return measure(clip, 1.0 if places.smoke else 10.0)


def stand_rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """The least that any stood, and how their clips replay; a body without servos."""
    rows = list(raws.values())
    values = {
        "stood_s_least": min(r["stood_s"] for r in rows),
        "sway_mm_most": max(r["sway_mm"] for r in rows),
        "replay_sinks_mm_most": max(r["sink_mm"] for r in rows),
        "joints_off_mm": mean_of(r["joints_mm"] for r in rows),
    }
    yield from of("bodies of eleven makers and five sizes", values, len(rows))
    limp = {"stood_s_most": max(r["limp_s"] for r in rows)}
    yield from of("the same bodies without servos", limp, len(rows))


#: What `repair.py` is asked for, by part: options, table, core-hours, policies.
REPAIR: dict[str, tuple[tuple[str, ...], str, float, tuple[str, ...]]] = {
    "repair": (("--as", "rotations"), "repair.csv", 1.5, ()),
    "repair keypoints": (("--as", "keypoints"), "repair.csv", 1.0, ()),
    "repair live": (("--live",), "repair_live.csv", 0.5, ()),
    "repair clean": (("--clean",), "repair_clean.csv", 0.5, ()),
    "repair track": (
        ("--track", "--clips", "6", "--only", "white", "all", "--sizes", "25", "100"),
        "repair_track.csv",
        0.5,
        ("tracker",),
    ),
    "repair files": (("--files",), "repair_files.csv", 0.3, ()),
}


def repaired(places: Places, unit: str) -> Any:
    """The script, which writes its own table; in a smoke test one kind of dirt on what there is."""
    options, table, _, _ = REPAIR[unit]
    out = places.work / table if places.smoke else ROOT / "results" / table
    if places.smoke:
        if unit != "repair" or not (places.data / "INDEX.tsv").exists():
            return 0.0
        options = (*options, "--smoke", "--only", "white")
    return script(ROOT / "benchmarks/repair.py", "--data", places.data, *options, "-o", out)


def no_rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """None here; see the script's table."""
    yield from ()


PARTS = {
    "pairs": Part("every pair among nine skeletons", pairs, moved_pair, pair_rows, hours=0.05),
    "standing": Part("bodies under their servos alone", bodies, stands, stand_rows, hours=0.05),
    **{
        name: Part(
            f"benchmarks/repair.py {' '.join(options)}",
            partial(lambda _, n: [n], n=name),
            repaired,
            no_rows,
            policies,
            hours=hours,
        )
        for name, (options, _, hours, policies) in REPAIR.items()
    },
}
