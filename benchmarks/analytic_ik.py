"""Skeleton2Humanoid's measure of inverse kinematics on LAFAN1 and Bandai: error, time, corrections.

    python benchmarks/analytic_ik.py --data FOLDER [--every N] [--out FILE.json]

FOLDER holds `lafan1_bvh/*.bvh` and `other/bandai_bvh/*.bvh`. Joint positions of every clip go through
`analytic_ik`; the error (MPJPE, mm) is the mean distance between the clip's joints and the humanoid's,
toes included. Three humanoids per clip: "own" by `generate_table`; "t_pose", the paper's kind (the same
bone lengths in a T-pose, 20 joints); "one_hinge", the same with one hinge in elbows and knees. Every Nth
clip also gets the humanoid of `fit_humanoid`, and each correction switched off and on by itself. With
`--extras` only the polish by mink and the trials with noise are measured anew.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
import torch
from paper_humanoid import body_points, count_jumps, paper_humanoid

from poise.body import generate_table, make_humanoid
from poise.formats import read_clip
from poise.kinematics import (
    CORRECTIONS,
    IkBody,
    IkConfig,
    Kinematics,
    analytic_ik,
    clip_to_qpos,
    fit_humanoid,
    ik_body,
    polish,
)
from poise.motion import Clip
from poise.motion.rotations import quat_to_matrix

#: Frames of one sequence of the paper: 10 of the past and 30 that were synthesised.
SEQUENCE = 40
PAPER = IkConfig(faithful="paper")
CONFIGS = {
    "corrected": IkConfig(),
    "paper": PAPER,
    **{f"corrected without {c}": IkConfig(**{c: False}) for c in CORRECTIONS},
    **{f"paper with {c}": IkConfig(faithful="paper", **{c: True}) for c in CORRECTIONS},
}


def bodies_of(clip: Clip, more: bool) -> dict[str, IkBody]:
    """The humanoids of a clip."""
    plain = generate_table(clip.skeleton, None, [clip])
    out = {"own": ik_body(plain, clip.skeleton)}
    if more:
        out["fitted"] = IkBody.of(fit_humanoid(clip)[0])
    for name, one_hinge in (("t_pose", False), ("one_hinge", True)):
        skeleton, table = paper_humanoid(plain, clip.skeleton, one_hinge)
        out[name] = ik_body(table, skeleton)
    return out


def points(body: IkBody, q: np.ndarray) -> np.ndarray:
    """World positions `(T, P, 3)` of a humanoid's joints and toes."""
    state = Kinematics(body.table)(torch.tensor(q))
    return body_points(body, state.pos, quat_to_matrix(state.quat)).numpy()


def file_jumps(path: Path) -> int:
    """How often a rotation channel of a BVH steps by more than 90 degrees between frames."""
    text = path.read_text()
    head, motion = text.split("MOTION", 1)
    channels: list[str] = []
    for line in head.splitlines():
        words = line.split()
        if words[:1] == ["CHANNELS"]:
            channels += words[2:]
    values = np.array([line.split() for line in motion.strip().splitlines()[2:] if line.strip()], float)
    turns = [i for i, c in enumerate(channels) if c.lower().endswith("rotation")]
    return int(count_jumps(np.radians(values[:, turns])).sum())


def measure(body: IkBody, wanted: np.ndarray, config: IkConfig) -> tuple[dict, np.ndarray]:
    """Error in mm, jumps and seconds of one clip on one humanoid."""
    start = time.process_time()
    q = analytic_ik(wanted, body, config)
    seconds = time.process_time() - start
    error = np.linalg.norm(points(body, q) - wanted, axis=-1) * 1000
    return {
        "mpjpe_mm": float(error.mean()),
        "max_mm": float(error.max()),
        "jumps": int(count_jumps(q[:, 7:]).sum()),
        "cpu_s": seconds,
    }, q


def extra_jumps(q: np.ndarray, source: np.ndarray) -> int:
    """Jumps of a hinge that its source, the clip's own rotations on the same humanoid, does not have."""
    ours, theirs = (np.abs(np.diff(x[:, 7:], axis=0)) > np.pi / 2 for x in (q, source))
    return int((ours & ~theirs).sum())


def timings(wanted: np.ndarray, body: IkBody) -> list[tuple[float, float]]:
    """(CPU, wall) seconds of up to three sequences of 40 frames, the best of five each."""
    out = []
    for start in range(0, min(len(wanted) - SEQUENCE + 1, 3 * SEQUENCE), SEQUENCE):
        part, best = wanted[start : start + SEQUENCE], []
        for _ in range(5):
            cpu, wall = time.process_time(), time.perf_counter()
            analytic_ik(part, body)
            best.append((time.process_time() - cpu, time.perf_counter() - wall))
        out.append((min(b[0] for b in best), min(b[1] for b in best)))
    return out


def polished(clip: Clip, frames: int = 100) -> dict[str, float]:
    """What mink adds on the humanoid with the fewest hinges, hands, feet and toes as targets."""
    plain = generate_table(clip.skeleton, None, [clip])
    skeleton, table = paper_humanoid(plain, clip.skeleton, one_hinge=True)
    humanoid = make_humanoid(skeleton, table)
    body = IkBody.of(humanoid)
    names = clip.skeleton.names
    wanted = clip.positions()[:frames, [names.index(n) for n in body.points]]
    ends = [i for i, r in enumerate(table.rows) if r.kind in ("hand", "foot")] + [*body.toes.values()]
    out: dict[str, float] = {"frames": len(wanted)}
    for name, config in (("corrected", IkConfig()), ("paper", PAPER)):
        q = analytic_ik(wanted, body, config)
        got = polish(q, {body.points[i]: wanted[:, i] for i in ends}, humanoid)
        out |= {
            f"{name}_before_mm": got.before_mm,
            f"{name}_after_mm": got.after_mm,
            f"{name}_ms_per_frame": got.seconds * 1000 / len(wanted),
            f"{name}_moved_deg": got.moved_deg,
        }
    return out


def noisy(clip: Clip, body: IkBody, sigma: float, frames: int = 600) -> dict[str, dict[str, float]]:
    """Error against the clean clip (mm) and jumps when every coordinate has noise of `sigma` m."""
    clean = clip.positions()[:frames, [clip.skeleton.names.index(n) for n in body.points]]
    rough = clean + np.random.default_rng(0).normal(size=clean.shape) * sigma
    out = {}
    for label, config in CONFIGS.items():
        if not label.startswith("paper with"):
            q = analytic_ik(rough, body, config)
            error = np.linalg.norm(points(body, q) - clean, axis=-1).mean() * 1000
            out[label] = {"mpjpe_mm": float(error), "jumps": int(count_jumps(q[:, 7:]).sum())}
    return out


def extras(data: Path) -> dict[str, dict]:
    """Polish and noise on the LAFAN1 clip and two of Bandai."""
    bandai = data / "other/bandai_bvh"
    paths = sorted((data / "lafan1_bvh").glob("*.bvh"))[:1]
    paths += [bandai / f"dataset-1_{name}_normal_001.bvh" for name in ("kick", "walk")]
    out: dict[str, dict] = {"polish": {}, "noise": {}}
    for path in paths:
        clip = read_clip(path)
        body = ik_body(generate_table(clip.skeleton, None, [clip]), clip.skeleton)
        out["polish"][path.stem] = polished(clip)
        for sigma in (0.002, 0.01):
            out["noise"][f"{path.stem}, {sigma * 1000:g} mm"] = noisy(clip, body, sigma)
    return out


def summary(rows: list[dict]) -> dict[str, float]:
    """Over clips: means weighted by frames, the worst, and sums."""
    weight = np.array([r["frames"] for r in rows], dtype=float)
    mean = np.array([r["mpjpe_mm"] for r in rows])
    return {
        "clips": len(rows),
        "frames": int(weight.sum()),
        "mpjpe_mm": float((mean * weight).sum() / weight.sum()),
        "worst_clip_mm": float(mean.max()),
        "max_mm": max(r["max_mm"] for r in rows),
        "jumps": sum(r["jumps"] for r in rows),
    }


class SamplingResult:
    """What was measured so far."""

    def __init__(self) -> None:
        self.rows: dict[tuple[str, str, str], list[dict]] = defaultdict(list)
        self.times: list[tuple[float, float]] = []
        self.jumps: dict[str, int] = defaultdict(int)
        self.extra: dict[str, int] = defaultdict(int)

    def add(self, data: str, path: Path, more: bool) -> float:
        """Measures a clip, with all switches where `more` is set; its error on its own humanoid, mm."""
        clip = read_clip(path)
        positions = clip.positions()
        self.jumps[f"{data} file"] += file_jumps(path)
        for name, body in bodies_of(clip, more).items():
            wanted = positions[:, [clip.skeleton.names.index(n) for n in body.points]]
            for label, config in CONFIGS.items():
                if label not in ("corrected", "paper") and not more:
                    continue
                row, q = measure(body, wanted, config)
                row |= {"clip": path.stem, "frames": clip.frames, "more": more}
                self.rows[data, name, label].append(row)
                if name == "own" and label == "corrected":
                    source = clip_to_qpos(clip, body.table)
                    key = f"{data} rotations on their own humanoid"
                    self.jumps[key] += int(count_jumps(source[:, 7:]).sum())
                    self.extra[data] += extra_jumps(q, source)
                    self.times += timings(wanted, body)
        return self.rows[data, "own", "corrected"][-1]["mpjpe_mm"]

    def result(self) -> dict:
        """Everything as plain numbers."""
        cpu, wall = np.array(self.times).T * 1000
        whole: dict = defaultdict(lambda: defaultdict(dict))
        part: dict = defaultdict(lambda: defaultdict(dict))
        for (data, body, label), rows in self.rows.items():
            if label in ("corrected", "paper"):
                whole[data][body][label] = summary(rows)
            part[data][body][label] = summary([r for r in rows if r["more"]])
        notes = [
            f"A sequence of {SEQUENCE} frames takes {np.median(cpu):.1f} ms of one thread (median of "
            f"{len(cpu)} sequences, worst {cpu.max():.1f} ms; by the clock of a busy machine "
            f"{np.median(wall):.1f} ms). The paper: 11.29 mm and 122 ms, on its own network's LAFAN1.",
            "",
            "Jumps above 90 degrees between frames: "
            + ", ".join(f"{n} in {k}" for k, n in self.jumps.items())
            + "; of ours, "
            + ", ".join(f"{n} on {k}" for k, n in self.extra.items())
            + " that the clip's rotations on the same humanoid do not have.",
        ]
        return {
            "command": "python benchmarks/analytic_ik.py --data FOLDER",
            "notes": notes,
            "cpu_ms": {"median": float(np.median(cpu)), "max": float(cpu.max())},
            "wall_ms": {"median": float(np.median(wall))},
            "source_jumps": self.jumps,
            "jumps_not_in_source": self.extra,
            "summary": whole,
            "corrections": part,
            "clips": {f"{d}/{b}": r for (d, b, c), r in self.rows.items() if c == "corrected"},
        }


def table_of(result: dict) -> str:
    """The figures as markdown."""
    lines = ["# Analytic inverse kinematics", "", *result["notes"], ""]
    head = ("data", "humanoid", "equations", "clips", "frames", "MPJPE mm", "worst clip mm", "max mm")
    lines += _row(*head, "jumps > 90 deg", rule=True)
    for data, per_body in result["summary"].items():
        for body, per_config in per_body.items():
            for config in ("corrected", "paper"):
                s = per_config[config]
                numbers = (s["clips"], s["frames"], f"{s['mpjpe_mm']:.3f}", f"{s['worst_clip_mm']:.2f}")
                lines += _row(data, body, config, *numbers, f"{s['max_mm']:.1f}", s["jumps"])
    lines += ["", "MPJPE in mm / jumps above 90 degrees, one correction off or on at a time:", ""]
    columns = [(d, b) for d, per in result["corrections"].items() for b in per]
    lines += _row("equations", *(f"{d}, {b}" for d, b in columns), rule=True)
    for config in CONFIGS:
        cells = [result["corrections"][d][b][config] for d, b in columns]
        lines += _row(config, *(f"{c['mpjpe_mm']:.3f} / {c['jumps']}" for c in cells))
    lines += ["", *(f"- `{name}`: {why}." for name, why in CORRECTIONS.items()), ""]
    head = ("polish by mink (one_hinge)", "before mm", "after mm", "ms per frame", "largest change deg")
    lines += _row(*head, rule=True)
    for name, p in result["polish"].items():
        for c in ("corrected", "paper"):
            keys = ("before_mm", "after_mm", "ms_per_frame", "moved_deg")
            lines += _row(f"{name}, {c}", *(f"{p[f'{c}_{k}']:.2f}" for k in keys))
    if "noise" in result:
        lines += ["", "Noise on every coordinate of 600 frames: mm from the clean clip / jumps", ""]
        lines += _row("equations", *result["noise"], rule=True)
        for label in next(iter(result["noise"].values())):
            cells = [n[label] for n in result["noise"].values()]
            lines += _row(label, *(f"{c['mpjpe_mm']:.1f} / {c['jumps']}" for c in cells))
    return "\n".join([*lines, ""])


def _row(*cells: object, rule: bool = False) -> list[str]:
    """One line of a table, with the line below the heads where `rule` is set."""
    line = "| " + " | ".join(str(c) for c in cells) + " |"
    return [line, "|" + "---|" * len(cells)] if rule else [line]


def measure_all(data: Path, every: int) -> dict:
    """The figures of every clip."""
    found = SamplingResult()
    for name, folder in (("LAFAN1", "lafan1_bvh"), ("Bandai", "other/bandai_bvh")):
        for i, path in enumerate(sorted((data / folder).glob("*.bvh"))):
            error = found.add(name, path, more=i % every == 0)
            print(f"{path.stem}: {error:.4f} mm", flush=True)
    return found.result()


def main() -> None:
    """Measures, prints and writes."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--every", type=int, default=6, help="measure corrections on every Nth clip")
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".json"))
    parser.add_argument(
        "--extras", action="store_true", help="renew polish and noise in FILE.json alone"
    )
    options = parser.parse_args()
    torch.set_num_threads(1)
    if options.extras:
        result = json.loads(options.out.read_text())
    else:
        result = measure_all(options.data, options.every)
    result |= extras(options.data)
    options.out.write_text(json.dumps(result, indent=1) + "\n")
    text = table_of(result)
    options.out.with_suffix(".md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
