"""Where the roughness of a policy comes from: its servos, its answers, or its training.

    python benchmarks/roughness.py --clips FOLDER --json benchmarks/roughness.json
    python benchmarks/roughness.py --clips FOLDER --policy smoother=FILE --json benchmarks/roughness.json

The policy does every `--every`-th clip of the folder by itself, from frame 0, once as it is and then
without any training with servos of more damping, with its answers averaged over noise on what it
observes (in deviations of the observation), on all of it or on the goal's velocities less the
character's alone, and with both. Jerk and acceleration are means over the
frames of the clips that it does whole; `spectrum` is the power of the jerk by frequency, 0 to 15 Hz,
beside the source's. Rows of policies that are not asked for stay as they are in the JSON.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import torch
from speed import machine
from torch import Tensor

from poise.env import ImitationEnv
from poise.errors import PoiseError
from poise.formats import read_clip
from poise.jobs.open import open_run
from poise.jobs.track import imitation_of
from poise.jobs.track.placement import PlacedMotion, place
from poise.jobs.tracker import Tracker
from poise.learn import PolicyBundle
from poise.learn.checkpoint import write_atomic
from poise.metrics import acceleration_error, jerk
from poise.score import ClipJudge, simulate

#: Damping of the servos in s (None: the body's own), deviation of the noise that is averaged over, and
#: whether it is on velocities alone.
WAYS: tuple[tuple[float | None, float, bool], ...] = (
    (None, 0.0, False), (0.03, 0.0, False), (0.04, 0.0, False), (0.06, 0.0, False),
    (None, 0.2, False), (None, 0.4, False), (None, 0.8, False), (0.03, 0.4, False),
    (None, 0.8, True),
)  # fmt: skip
EVERYTHING = slice(None)
#: Pairs of opposite displacements over which answers are averaged.
PAIRS = 6
#: Frames of a spectrum's window.
WINDOW = 30


class Averaged:
    """A policy whose answers are means over normal noise on what it observes."""

    def __init__(self, policy: PolicyBundle, noise: float, seed: int, over: slice = EVERYTHING):
        self.policy, self.noise = policy, torch.zeros_like(policy.norm.std)
        columns = over
        self.noise[columns] = noise * policy.norm.std[columns]
        self.rng = torch.Generator().manual_seed(seed)

    def act(self, obs: Tensor) -> Tensor:
        moves = torch.randn(PAIRS, 1, obs.shape[1], generator=self.rng) * self.noise
        near = (obs + torch.cat((moves, -moves))).flatten(0, 1)
        return self.policy.act(near).view(2 * PAIRS, len(obs), -1).mean(0)


class Places:
    """Observes where the bodies are and should be."""

    def __init__(self) -> None:
        self.sim: list[Tensor] = []
        self.ref: list[Tensor] = []

    def see(self, env: ImitationEnv, step: int) -> bool:
        self.sim.append(env.pose().pos.double())
        self.ref.append(env.goal_pose().pos.double())
        return True


def spectrum(pos: Tensor) -> Tensor:
    """`(16,)`, power of the third difference of `pos (T, B, 3)` by frequency at 30 Hz."""
    windows = pos.diff(n=3, dim=0).flatten(1).unfold(0, WINDOW, WINDOW // 2)
    tapered = windows * torch.hann_window(WINDOW, dtype=pos.dtype)
    return torch.fft.rfft(tapered, dim=-1).abs().square().mean((0, 1))


@torch.no_grad()
def measure(
    tracker: Tracker, placed: list[PlacedMotion], noise: float, seed: int, velocities: bool = False
) -> dict[str, Any]:
    """One way of doing all clips."""
    imitation = imitation_of(tracker, placed)
    length, fps = imitation.reference.length, imitation.reference.rate_hz
    every, first = torch.arange(len(length)), torch.zeros(len(length), dtype=torch.long)
    env = imitation.bare().env(len(length), None, False, 1, None, 0.0, guard=False)
    names, over = imitation.task.velocities, EVERYTHING
    if velocities and names:
        over = slice(env.columns[names[0]].start, env.columns[names[-1]].stop)
    policy = Averaged(tracker.policy, noise, seed, over) if noise else tracker.policy
    judge, path = ClipJudge(length - 1), Places()
    try:
        simulate(env, policy, env.reset_to(every, first), int(length.max()) - 1, judge, path)
    finally:
        env.close()
    done, _, _, error = judge.results()
    sim, ref = torch.stack(path.sim, 1), torch.stack(path.ref, 1)
    rows = [k for k in range(len(length)) if done[k]]
    pairs = [(sim[k, : length[k]], ref[k, : length[k]]) for k in rows]
    long = [p for p in pairs if len(p[0]) >= WINDOW + 3]
    own, source = (torch.cat([jerk(p[i], fps) for p in pairs]).mean().item() for i in range(2))
    acc = torch.cat([acceleration_error(*p, fps) for p in pairs]).mean().item()
    bands = [torch.stack([spectrum(p[i]) for p in long]).mean(0) for i in range(2)]
    return {
        "clips": len(length), "done": len(rows), "error_mm": round(error[done].mean().item(), 1),
        "jerk": round(own, 1), "source_jerk": round(source, 1), "jerk_ratio": round(own / source, 3),
        "acc": round(acc, 2),
        "spectrum": [round(x, 3) for x in (1e3 * bands[0]).tolist()],
        "source_spectrum": [round(x, 3) for x in (1e3 * bands[1]).tolist()],
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--clips", type=Path, required=True)
    parser.add_argument("--policy", nargs="*", default=[], metavar="NAME=FILE")
    parser.add_argument("--every", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, required=True)
    a = parser.parse_args()
    torch.set_num_threads(1)
    trackers = {"tracker": open_run(None).tracker} if not a.policy else {}
    for given in a.policy:
        name, _, path = given.partition("=")
        trackers[name] = open_run(Path(path)).tracker
    said: dict[str, Any] = json.loads(a.json.read_text()) if a.json.exists() else {}
    rows: dict[str, Any] = said.setdefault("rows", {})
    for name, tracker in trackers.items():
        placed: list[PlacedMotion] = []
        for file in sorted(a.clips.glob("*.bvh"))[:: a.every]:
            try:
                placed.append(place(read_clip(file), tracker))
            except PoiseError as problem:
                print(file.name, problem)
        rows[name] = []
        # A policy that was given is shown as it is.
        for damping, noise, velocities in WAYS if not a.policy else WAYS[:1]:
            one = tracker if damping is None else tracker.with_damping(damping)
            own = round(one.config.body.damping, 4)
            way = {"damping_s": own, "noise": noise, "velocities": velocities}
            found = way | measure(one, placed, noise, a.seed, velocities)
            rows[name].append(found)
            print(name, *(f"{k} {v}" for k, v in found.items() if "spectrum" not in k), flush=True)
    said |= {"command": "benchmarks/roughness.py", "machine": machine(), "seed": a.seed}
    write_atomic(a.json, (json.dumps(said, indent=1) + "\n").encode())


if __name__ == "__main__":
    main()
