"""Tables 1 and 2 of Residual Force Control in spirit: 2 s of future after held-out pasts, by method.

    python benchmarks/endless_tables.py --data FOLDER --work WORK -o benchmarks/endless_tables.json

FOLDER holds `cmu_amc`, `cmu_bvh` and `other/bandai_bvh`. Cross holds whole subjects out, Mix every fifth
clip of a class; one model learns all classes, or each class has one of its own. The kinematic policy
(ours), ERD and acLSTM learn for the same processor time; control policies make as many control steps,
a third of them where they go on from the policy that comes with Poise.

MAE is the mean over 2 s of the Euclidean distance between hinge angles, rad, FAE that of the last frame
(the paper's words; of all hinges, without the root); the mean of 10 samples, and the best beside it.
Written after each row; a command that goes on with the same file makes only the rows that it lacks.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from endless_data import FUTURE, LIBRARIES, Clips, Window, clips_of, kind_of, motions_of, windows_of
from endless_methods import (
    MADE,
    ON_TOP,
    Control,
    Trained,
    continued,
    control,
    imagined,
    network,
    servos,
    simulated,
    universal,
)
from torch import Tensor

from poise.body.humanoid import make_humanoid
from poise.jobs.open import open_run
from poise.jobs.tracker import Tracker
from poise.kinematics.fit import widen

#: Of methods that draw; others make one future.
SAMPLES = 10
#: Steps of a network, which take about as long as each other on one core.
STEPS = {"ours": 280, "ERD": 80, "acLSTM": 30, "next frame": 170}
#: Methods that draw nothing.
FIXED = ("zero velocity", "acLSTM", "EgoPose", "next frame")
#: m below the recorded root in the last frame, from which on a character counts as fallen.
FALLEN = 0.3
#: The dual policy, whose control policy does not see z, against which the others are compared.
OURS = "RFC-Implicit"
ALL = ("zero velocity", "ours", OURS, "RFC-Explicit", "EgoPose", "ERD", "acLSTM",
       "no residual force", "no additive action", "servos", "universal policy", *ON_TOP)  # fmt: skip
OF_A_CLASS = ("ours", "ERD", "acLSTM")


class Unit(NamedTuple):
    """What the rows of one model of one seed share."""

    library: str
    model: str
    seed: int

    def key(self, method: str) -> str:
        """Of a row."""
        return f"{self.library}/{self.model}/{self.seed}/{method}"


def off(windows: list[Window], qpos: Tensor, samples: int) -> np.ndarray:
    """Distances of hinge angles, rad `(W, S, f)`."""
    true = torch.stack([w.true[:, 7:] for w in windows]).repeat_interleave(samples, 0)
    return (qpos[..., 7:] - true).norm(dim=-1).unflatten(0, (len(windows), samples)).numpy()


def groups_of(windows: list[Window]) -> dict[str, list[int]]:
    """Rows of each split, and of each class."""
    groups: dict[str, list[int]] = {"all": list(range(len(windows)))}
    for k, w in enumerate(windows):
        groups.setdefault("cross" if w.cross else "mix", []).append(k)
        groups.setdefault(w.kind, []).append(k)
    return groups


def figures(windows: list[Window], far: np.ndarray) -> dict[str, dict[str, Any]]:
    """MAE and FAE of each group, of the mean and of the best sample."""
    out: dict[str, dict[str, Any]] = {}
    for name, rows in groups_of(windows).items():
        mean, last = far[rows].mean(-1), far[rows][..., -1]
        out[name] = {
            "windows": len(rows), "clips": len({windows[k].clip for k in rows}),
            "mae": round(float(mean.mean()), 3), "fae": round(float(last.mean()), 3),
            "best_mae": round(float(mean.min(-1).mean()), 3),
            "best_fae": round(float(last.min(-1).mean()), 3),
        }  # fmt: skip
    return out


def fallen(windows: list[Window], qpos: Tensor, samples: int) -> float:
    """Share of the characters that end far lower than what was recorded."""
    height = torch.stack([w.true[-1, 2] for w in windows]).repeat_interleave(samples)
    return round(float((qpos[:, -1, 2] < height - FALLEN).double().mean()), 3)


class Rows:
    """Makes the rows of one unit; networks are trained when a row first asks for them."""

    def __init__(self, unit: Unit, clips: Clips, tracker: Tracker, samples: int, steps: float):
        library = LIBRARIES[unit.library]
        windows, learned = windows_of(clips, library)
        if unit.model != "all":
            windows = [w for w in windows if w.kind == unit.model]
            learned = [k for k in learned if kind_of(clips.names[k], library) == unit.model]
        self.unit, self.windows, self.tracker, self.samples = unit, windows, tracker, samples
        self.motions = motions_of(clips, learned, tracker)
        self.recorded = [clips.qpos[k] for k in learned if len(clips.qpos[k]) >= FUTURE]
        self.network: Callable[[str], Trained] = cache(
            lambda name: network(self.motions, name, unit.seed, max(1, round(steps * STEPS[name])))
        )
        self.futures: Callable[[str], Tensor] = cache(self._futures)

    def _pasts(self, method: str) -> Tensor:
        count = 1 if method in FIXED else SAMPLES
        return torch.stack([w.past for w in self.windows]).repeat_interleave(count, 0)

    def _futures(self, method: str) -> Tensor:
        pasts = self._pasts(method)
        if method in ("zero velocity", "EgoPose"):
            # EgoPose's policy does not see it.
            return pasts[:, -1:].expand(-1, MADE, -1)
        return continued(self.network(method).made, pasts, MADE, self.unit.seed)

    def row(self, method: str) -> tuple[dict[str, Any], np.ndarray]:
        """A row, and its distances `(W, S, f)`."""
        about: dict[str, Any] = {"method": method, **self.unit._asdict()}
        networks = method == "ours" or method in STEPS
        if networks or method == "zero velocity":
            qpos = self.futures(method)[:, :FUTURE]
            about |= {"body": False}
            if networks:
                made = self.network(method)
                about |= {"steps": made.steps, "windows": made.windows, "seconds": made.seconds}
        else:
            by = self._control(method)
            source = "EgoPose" if method == "EgoPose" else "ours"
            pasts = self._pasts(source)
            done = simulated(self.tracker, by, pasts, self.futures(source))
            qpos = done.qpos
            about |= {
                "body": True, "help_limit": by.limit, "help_n": done.force, "help_nm": done.torque,
                "control_steps": by.samples, "seconds": by.seconds,
            }  # fmt: skip
        count = len(qpos) // len(self.windows)
        about |= {"samples": count, "fallen": fallen(self.windows, qpos, count)}
        far = off(self.windows, qpos, count)
        return about | {"groups": figures(self.windows, far)}, far

    def _control(self, method: str) -> Control:
        if method == "servos":
            return servos(self.tracker)
        if method == "universal policy":
            return universal(self.tracker)
        learned = self.recorded
        if method != "EgoPose":
            learned = imagined(self.network("ours").made, self.motions, self.unit.seed)
        samples = self.samples // 3 if method in ON_TOP else self.samples
        return control(method, self.unit.seed, self.tracker, learned, samples)


def file_of(work: Path, key: str) -> Path:
    """Where the distances of a row are kept."""
    return work / f"{key.replace('/', '_')}.npy"


def differences(rows: dict[str, Any], work: Path, windows: dict[str, list[Window]]) -> dict[str, Any]:
    """How much farther off than the dual policy each other method is, by means of clips over all seeds
    that both have, with the standard error over clips."""
    out: dict[str, Any] = {}
    for method in ALL:
        for library, some in windows.items():
            for measure in ("mae", "fae"):
                by_clip: dict[str, list[float]] = {}
                for key, row in rows.items():
                    ours = f"{library}/all/{row['seed']}/{OURS}"
                    if key != f"{library}/all/{row['seed']}/{method}" or ours not in rows:
                        continue
                    files = [file_of(work, k) for k in (key, ours)]
                    if not all(f.exists() for f in files):
                        continue
                    a, b = (np.load(f) for f in files)
                    a, b = (x[..., -1] if measure == "fae" else x.mean(-1) for x in (a, b))
                    for w, d in zip(some, a.mean(-1) - b.mean(-1), strict=True):
                        by_clip.setdefault(w.clip, []).append(float(d))
                if by_clip and method != OURS:
                    means = np.array([np.mean(v) for v in by_clip.values()])
                    error = float(means.std(ddof=1) / math.sqrt(len(means)))
                    out.setdefault(f"{library}/{method}", {"clips": len(means)})[measure] = [
                        round(float(means.mean()), 3), round(error, 3)
                    ]  # fmt: skip
    return out


def main() -> None:
    """Trains and predicts, row after row."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("-o", type=Path, required=True)
    parser.add_argument("--libraries", nargs="+", choices=tuple(LIBRARIES), default=list(LIBRARIES))
    parser.add_argument("--models", nargs="+", choices=("all", "classes"), default=["all", "classes"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--methods", nargs="+", choices=(*ALL, "next frame"), default=list(ALL))
    parser.add_argument("--samples", type=int, default=49_152, help="control steps of a control policy")
    parser.add_argument("--steps", type=float, default=1.0, help="times as many steps of networks")
    a = parser.parse_args()
    torch.set_num_threads(1)
    a.work.mkdir(parents=True, exist_ok=True)
    plain = open_run(None).tracker
    out: dict[str, Any] = json.loads(a.o.read_text()) if a.o.exists() else {"rows": {}}
    out |= {
        "command": "python benchmarks/endless_tables.py --data FOLDER --work WORK -o FILE",
        "hinges": len(plain.humanoid.hinges), "samples": SAMPLES,
    }  # fmt: skip
    windows: dict[str, list[Window]] = {}
    for model in a.models:
        for library in a.libraries:
            clips = clips_of(library, a.data, a.work, plain)
            windows[library], learned = windows_of(clips, LIBRARIES[library])
            out.setdefault("libraries", {})[library] = {
                "clips": len(clips.names), "learned": len(learned),
                "learned_frames": sum(len(clips.qpos[k]) for k in learned),
                "windows": len(windows[library]),
            }  # fmt: skip
            table, _ = widen(plain.humanoid.table, [q.numpy() for q in clips.qpos], 0.0)
            body = make_humanoid(plain.humanoid.skeleton, table)
            tracker = Tracker(**(vars(plain) | {"humanoid": body}))
            kinds = ["all"] if model == "all" else [k for k, _ in LIBRARIES[library].classes]
            methods = [m for m in a.methods if model == "all" or m in OF_A_CLASS]
            for unit in [Unit(library, k, s) for k in kinds for s in a.seeds]:
                missing = [m for m in methods if unit.key(m) not in out["rows"]]
                if not missing:
                    continue
                rows = Rows(unit, clips, tracker, a.samples, a.steps)
                for method in missing:
                    row, far = rows.row(method)
                    np.save(file_of(a.work, unit.key(method)), far)
                    out["rows"][unit.key(method)] = row
                    more = differences(out["rows"], a.work, windows)
                    out["differences"] = out.get("differences", {}) | more
                    a.o.write_text(json.dumps(out, indent=1) + "\n")
                    print(unit.key(method), row["groups"]["all"], row.get("help_n"), flush=True)


if __name__ == "__main__":
    main()
