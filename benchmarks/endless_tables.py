"""Tables 1 and 2 of Residual Force Control in spirit: 2 s of future after held-out pasts, by method.

    python benchmarks/endless_tables.py --library FOLDER ... -o FILE [--seconds 60] [--seeds 0 1]

Every network learns for the same CPU time of one thread. Cross holds whole subjects out, Mix every fifth
of the other clips. A method is kinematic, or has a body: then the tracker that comes with Poise does its
motion, without help and without training of its own. MAE is the mean over the frames of the Euclidean
distance of all hinges, rad, FAE that of the last frame; the mean of 10 samples, and the best beside it.
Written after each method; with --run RUN, the folder of a training (`endless_train.py`), its motions are
learned from, only the held-out clips are read, so that there is Cross alone, and its generator, which
learned for longer, is one more method (--shipped: the one that comes with Poise, too). A command that
goes on with the same file makes only what it lacks.
"""

from __future__ import annotations

import argparse
import json
import re
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from tracker import HELD_OUT, SIXTY, TWINS

from poise.body import BodyConfig
from poise.env.goals import EndlessGoal
from poise.env.goals.generator import MotionGenerator
from poise.jobs.endless.model import SHIPPED, load_generator
from poise.jobs.endless.run import RUN_FILE, opened
from poise.jobs.endless.training import Endless, Motions, codes_of, learner_of, motions_of
from poise.jobs.library.clips import LibraryConfig
from poise.jobs.library.folder import library_of, split
from poise.jobs.open import open_run
from poise.jobs.track.placement import place
from poise.jobs.track.tracking import imitation_of
from poise.jobs.tracker import Tracker
from poise.learn.inbetween import InbetweenTrainer
from poise.learn.next_frame import NextFrameObjective
from poise.motion import ClipLibrary
from poise.nets.next_frame import NextFrame, NextFrameConfig
from poise.synth.generator import Kinematic
from poise.synth.next_frames import NextFrames
from poise.synth.place_free import ROOT

#: Samples after each window, the most windows of a split.
SAMPLES, WINDOWS = 10, 24
#: What a clip's name says that is done in it, the first that fits.
CLASSES = (
    ("run", r"02_03|run|jog"), ("walk", r"07_|35_|02_0[12]|walk|zombie|crawl"),
    ("dance", r"05_|dance"), ("acrobatics", r"90_|flip|cartwheel|roll|spin|jump|02_04"),
    ("fight", r"02_0[5-9]|135_|14_|punch|kick|11_"),
)  # fmt: skip
NETS = {
    "ERD": NextFrameConfig.erd, "acLSTM": NextFrameConfig.aclstm, "next frame": NextFrameConfig.egopose
}  # fmt: skip


class Window(NamedTuple):
    """A past `(p, 7 + n)`, what followed `(f, 7 + n)`, the class, whether its subject is held out."""

    past: np.ndarray
    true: np.ndarray
    kind: str
    cross: bool


def kind_of(name: str) -> str:
    """The class of a clip."""
    return next((k for k, pattern in CLASSES if re.search(pattern, name)), "other")


def windows_of(clips: Sequence[Any], tracker: Tracker, cross: bool, p: int, f: int) -> list[Window]:
    """Windows of clips, evenly spread over all there are."""
    every = list[Window]()
    for clip in clips:
        q = place(clip, tracker).qpos
        for i in range(0, len(q) - p - f + 1, p):
            every.append(Window(q[i : i + p], q[i + p : i + p + f], kind_of(clip.name), cross))
    picks = np.linspace(0, len(every) - 1, min(WINDOWS, len(every))).round().astype(int)
    return [every[k] for k in picks]


def trained(motions: Motions, name: str, seed: int, seconds: float) -> tuple[MotionGenerator, int]:
    """A network after so many s of CPU time, as a generator, and its steps."""
    many = 10_000_000
    if name == "ours":
        # Step sizes fall along a line to 0; how many steps fit is measured first.
        trial = learner_of(motions, Endless(seed=seed))
        rng, begun = torch.Generator().manual_seed(0), time.process_time()
        for _ in range(20):
            trial.step(motions.frames, 0, rng)
        many = max(20, int(20 * seconds / (time.process_time() - begun)))
        config = Endless(seed=seed, steps=many)
        objective: Any = learner_of(motions, config)
    else:
        net = NextFrame(ROOT + len(motions.hinges), NETS[name](), torch.Generator().manual_seed(seed))
        net.calibrate(motions.frames.frames)
        objective = NextFrameObjective(net)
    trainer = InbetweenTrainer(objective, motions.frames, seed, many, block=10, ema=0.99)
    begun = time.process_time()
    while not trainer.done and time.process_time() - begun < seconds:
        trainer.iterate()
    net = trainer.averaged.eval()
    if name != "ours":
        return NextFrames(net, motions.seeds, motions.fps, motions.bounds), trainer.step  # type: ignore[arg-type]
    codes = codes_of(net, motions, 4096)  # type: ignore[arg-type]
    made = Kinematic(net, motions.seeds, motions.fps, bounds=motions.bounds, codes=codes)  # type: ignore[arg-type]
    return made, trainer.step


class Proposed:
    """A generator that goes on for a whole future."""

    def __init__(self, made: Any):
        self.made, self.past, self.future = made, made.past, made.future

    def __call__(self, pasts: Tensor, frames: int, seed: int) -> Tensor:
        """`(N, frames, 7 + n)`."""
        rng, parts, have = torch.Generator().manual_seed(seed), [pasts], 0
        while have < frames:
            parts.append(self.made.propose(torch.cat(parts, 1)[:, -self.past :], rng, 1)[:, 0])
            have += self.future
        return torch.cat(parts[1:], 1)[:, :frames]


def simulated(tracker: Tracker, made: Any, pasts: Tensor, frames: int, seed: int) -> Tensor:
    """The same, done by the tracker in as many worlds `(N, frames, 7 + n)`."""
    task = imitation_of(tracker, [place(tracker.example, tracker)])
    task = replace(task, task=replace(task.task, help_by="all", auto_reset=False))
    count = len(pasts)
    env = task.env(count, None, False, 1, help_scale=0.0)
    lead = max(*tracker.config.window, 1) + 1
    rate = tracker.config.sim.control_hz
    goal = EndlessGoal(
        made, tracker.humanoid, rate, None, count, seed=seed, lead=lead, pasts=pasts.double()
    )
    goal.draw(torch.arange(count))
    env.backend.write(None, *goal.start(None))
    env.age[:] = 0
    obs, out = env.set_goal(goal), list[Tensor]()
    for _ in range(frames):
        obs = env.step(tracker.policy.act(obs)).final_obs
        out.append(env.backend.state.qpos.clone().double())
    env.close()
    return torch.stack(out, 1)


def errors(windows: list[Window], make: Callable[[Tensor], Tensor]) -> dict[str, dict[str, Any]]:
    """MAE and FAE over all windows, of each split, and of each class."""
    pasts = torch.tensor(np.stack([w.past for w in windows])).repeat_interleave(SAMPLES, 0)
    made = make(pasts)[..., 7:].numpy()
    true = np.stack([w.true[:, 7:] for w in windows]).repeat(SAMPLES, 0)
    off = np.linalg.norm(made - true, axis=-1).reshape(len(windows), SAMPLES, -1)

    def of(rows: list[int]) -> dict[str, Any]:
        some = off[rows]
        return {
            "windows": len(rows),
            "mae": round(float(some.mean()), 3), "fae": round(float(some[..., -1].mean()), 3),
            "best_mae": round(float(some.mean(-1).min(-1).mean()), 3),
            "best_fae": round(float(some[..., -1].min(-1).mean()), 3),
        }  # fmt: skip

    groups = {"all": list(range(len(windows)))}
    for k, w in enumerate(windows):
        groups.setdefault("cross" if w.cross else "mix", []).append(k)
        groups.setdefault(w.kind, []).append(k)
    return {name: of(rows) for name, rows in groups.items()}


def read(folders: list[Path], hold_out: list[str], tracker: Tracker) -> tuple[Motions, list[Window]]:
    """What is learned from, and the windows that are predicted."""
    how = LibraryConfig(rates=SIXTY, leave_out=TWINS)
    library, _ = library_of(folders, tracker.target, config=how, body=BodyConfig(), tell=print)
    parts = split(library, hold_out)
    own = sorted(parts.train, key=lambda c: c.name)
    test, train = own[::5], [c for k, c in enumerate(own) if k % 5]
    net = Endless().net
    motions = motions_of(ClipLibrary.of(train), tracker, net)
    windows = windows_of(test, tracker, False, net.past, net.future)
    return motions, windows + windows_of(list(parts.test), tracker, True, net.past, net.future)


def held_out(run: Path, folder: Path, only: str, tracker: Tracker) -> tuple[Motions, list[Window]]:
    """The motions of a run, and windows of clips that it has not learned from."""
    motions, config, _ = opened(run / RUN_FILE)
    how = LibraryConfig(rates=SIXTY, leave_out=(f"^{folder.resolve().name}-(?!.*({only})$)",))
    library, _ = library_of(folder, tracker.target, config=how, body=BodyConfig(), tell=print)
    known = set(motions.clips) & set(library.names)
    if known:
        raise SystemExit(f"the run has learned from {', '.join(sorted(known))}")
    return motions, windows_of(list(library), tracker, True, config.net.past, config.net.future)


def main() -> None:
    """Trains and predicts with each method and seed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--library", type=Path, nargs="+", required=True)
    parser.add_argument("--hold-out", nargs="+", default=list(HELD_OUT))
    parser.add_argument("-o", type=Path, required=True)
    parser.add_argument("--run", type=Path)
    parser.add_argument("--only", default=r"(05|11|14)_\d+")
    parser.add_argument("--shipped", action="store_true")
    parser.add_argument("--kinematic", action="store_true", help="leaves the body out")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    a = parser.parse_args()
    torch.set_num_threads(1)
    tracker = open_run(None).tracker
    if a.run is None:
        motions, windows = read(a.library, a.hold_out, tracker)
    else:
        motions, windows = held_out(a.run, a.library[0], a.only, tracker)
    out: dict[str, Any] = json.loads(a.o.read_text()) if a.o.exists() else {"methods": {}}
    out |= {
        "command": "python benchmarks/endless_tables.py", "seconds_of_training": a.seconds,
        "help_n": 0.0,
        "samples": SAMPLES, "clips": len(motions.clips), "frames": len(motions.frames.frames),
    }  # fmt: skip
    frames = windows[0].true.shape[0]

    def keep(name: str, value: Any) -> None:
        out["methods"][name] = value
        a.o.write_text(json.dumps(out, indent=1) + "\n")
        print(name, value["all"], flush=True)

    keep("zero velocity", errors(windows, lambda p: p[:, -1:].expand(-1, frames, -1)))
    whole = {"the run's generator": a.run, "the shipped one": SHIPPED if a.shipped else None}
    for name, file in whole.items():
        if file is not None and name not in out["methods"]:
            model = load_generator(file)
            made = model.generator(tracker.humanoid)
            about = {"steps": model.about.get("steps")}
            at = errors(windows, lambda p, m=made: Proposed(m)(p, frames, 0))
            keep(name, {**about, **at})
            if not a.kinematic:
                body = errors(windows, lambda p, m=made: simulated(tracker, m, p, frames, 0))
                keep(f"{name} with a body", {**about, **body})
    for seed in a.seeds:
        for name in ("ours", *NETS):
            last = f"{name}, seed {seed}" if a.kinematic else f"{name} with a body, seed {seed}"
            if last in out["methods"]:
                continue
            made, steps = trained(motions, name, seed, a.seconds)
            about = {"steps": steps, "seed": seed}
            kinematic = errors(windows, lambda p, m=made, s=seed: Proposed(m)(p, frames, s))
            keep(f"{name}, seed {seed}", {**about, **kinematic})
            if a.kinematic:
                continue
            body = errors(windows, lambda p, m=made, s=seed: simulated(tracker, m, p, frames, s))
            keep(f"{name} with a body, seed {seed}", {**about, **body})


if __name__ == "__main__":
    main()
