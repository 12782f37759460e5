"""Figure 2 of Residual Force Control: learning curves with residual forces and without, clip by clip.

    python benchmarks/rfc_order.py --data FOLDER [--samples 700000] [--seeds 0 1] [--methods NAME ...]
    python benchmarks/rfc_order.py --data FOLDER --setting paper --clips 90_02 --samples 10000000

Seven of the paper's eight clips and, for the eighth, DeepMimic's backflip. Everything but the residual
force is the same for all methods: body, terms, PPO, seeds; the imitation reward leaves out the
regularizer (paper Sec. 6.1). "nothing" is the null: action 0, no training and no help. With --gains the
body's gains are scaled in training; with --times the seconds of one control step are measured.

Each run has a folder under `--work`: one that was stopped goes on from its checkpoint, one that is done
is not trained again, and one of fewer samples goes on to more. `--collect` trains nothing. The JSON, the
tables and the plot are made of all runs that have `--samples` behind them.
"""

from __future__ import annotations

import argparse
import csv
import json
import time
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import rfc_order_tables
import torch

from poise.body import BodyConfig
from poise.formats import read_clip
from poise.jobs.runs import begin, evaluate, train
from poise.learn import LATEST, Until, load_policy
from poise.motion import Clip, ClipLibrary
from poise.recipes.imitation import Imitation
from poise.recipes.residual_force import ResidualForce, build
from poise.score import start_frames
from poise.score.episodes import frames_from

#: File and frames per second of each clip. All of CMU's are said to have 120, but in 90_08 and 90_11
#: bodies fall as they do at 60.
CLIPS = {
    "90_02": ("cmu_amc/rfc/90_02.amc", None),
    "05_06": ("cmu_amc/rfc/05_06.amc", None),
    "90_08": ("cmu_amc/rfc/90_08.amc", 60.0),
    "backflip": ("deepmimic_txt/humanoid3d_backflip.txt", None),
    "05_13": ("cmu_amc/rfc/05_13.amc", None),
    "90_05": ("cmu_amc/rfc/90_05.amc", None),
    "90_11": ("cmu_amc/rfc/90_11.amc", 60.0),
    "05_07": ("cmu_amc/rfc/05_07.amc", None),
}
SKELETON = "cmu_amc/rfc/08.asf"

METHODS: dict[str, dict[str, Any]] = {
    "nothing": {"method": "deepmimic"},
    "deepmimic": {"method": "deepmimic"},
    "rfc-implicit": {"method": "rfc-implicit"},
    "rfc-explicit": {"method": "rfc-explicit"},
    "rfc-explicit-all": {"method": "rfc-explicit", "help_bodies": "all"},
    "rfc-implicit-uncapped": {"method": "rfc-implicit", "help_capped": False},
    "rfc-explicit-uncapped": {"method": "rfc-explicit", "help_capped": False},
}
MAIN = ("nothing", "deepmimic", "rfc-implicit", "rfc-explicit")


class Nothing:
    """Action 0, which aims at the motion's own joint angles."""

    def __init__(self, num_obs: int, num_actions: int):
        self.num_obs, self.num_actions = num_obs, num_actions

    def act(self, obs: torch.Tensor) -> torch.Tensor:
        return torch.zeros(len(obs), self.num_actions)


def clip_of(data: Path, name: str) -> Clip:
    """One of `CLIPS`."""
    file, fps = CLIPS[name]
    return read_clip(data / file, skeleton=data / SKELETON if file.endswith(".amc") else None, fps=fps)


def settings(setting: str, clip: Clip, method: str, seed: int, gains: float = 1.0) -> ResidualForce:
    """Of one run: "poise" is the default recipe with 100 N kept, "paper" all that the paper states."""
    same = {"seed": seed, **METHODS[method]}
    if setting == "paper":
        return ResidualForce.paper(clip, **same)
    body = BodyConfig()
    if gains != 1.0:
        rows = build(clip, ResidualForce()).humanoid.table.rows
        scaled = [(f"{r.name}.{k}", gains * getattr(r, k)) for r in rows for k in ("kp", "kd")]
        body = BodyConfig(overrides=tuple(scaled))
    return ResidualForce(help_limit=100.0, help_start=None, expert=False, body=body, **same)


def run_name(clip: str, method: str, seed: int, gains: float) -> str:
    return f"{clip}/{method}/{seed}" + (f"/gains x {gains:g}" if gains != 1.0 else "")


def folder_of(work: Path, setting: str, name: str) -> Path:
    return work / setting / name.replace("/", "_").replace(" ", "")


def one(folder: Path, clip: Clip, config: ResidualForce, method: str, samples: int) -> dict[str, Any]:
    """Trains one policy to `samples` control steps; the curve and the final evaluation."""
    if method == "nothing":
        imitation = build(clip, config)
        card = final(imitation, None, 0)
        return {**card, "samples": 0, "seconds": 0.0, "curve": []}
    imitation = begin(folder, ClipLibrary.of(clip), config)
    train(imitation, folder, Until(samples=samples), threads=1, tensorboard=False)
    with (folder / "log.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    # Return per episode as in the paper's figure 2: reward per step times steps survived.
    curve = [[float(r[k]) for k in ("samples", "env/imitation", "episode_length")] for r in rows]
    last = curve[-max(1, len(curve) // 20) :]
    return {
        "imitation_last": float(np.mean([c[1] for c in last])),
        "return_last": float(np.mean([c[1] * c[2] for c in last])),
        **final(imitation, folder / LATEST, samples),
        "samples": int(curve[-1][0]),
        "seconds": round(float(rows[-1]["time/seconds"]), 1),
        "curve": [[int(s), round(r, 4), round(n, 2)] for s, r, n in curve[:: max(1, len(curve) // 60)]],
    }


def final(imitation: Imitation, policy: Path | None, samples: int) -> dict[str, float]:
    """The deterministic policy from every start frame that is more than a second from its clip's end."""
    if policy is None:
        env = imitation.env(1, threads=1)
        acts: Any = Nothing(env.num_obs, env.num_actions)
        env.close()
    else:
        acts = load_policy(policy, character=imitation.humanoid.identity)
    clip, start = start_frames(imitation.reference)
    far = frames_from(imitation.reference, clip, start) > imitation.reference.rate_hz
    card = evaluate(imitation, acts, {"samples": samples}, starts=(clip[far], start[far])).card
    return {
        "starts": int(far.sum()),
        "eval_imitation": card.reward["total"],
        "succ": card.succ,
        "mpjpe_mm": card.mpjpe_mm,
        "force_mean_n": card.help.force_mean_n,
        "force_p95_n": card.help.force_p95_n,
        "torque_mean_nm": card.help.torque_mean_nm,
        "body_n": 9.81 * imitation.humanoid.mass,
    }


def control_step_ms(clip: Clip, setting: str, steps: int = 300, rounds: int = 5) -> dict[str, float]:
    """Processor time of one control step of one character, ms: policy, forces, physics, rewards and
    observation; the methods in turn, the median of the rounds."""
    made = [build(clip, settings(setting, clip, m, 0)) for m in MAIN[1:]]
    envs = [x.env(1, threads=1) for x in made]
    policies = [x.trainer(threads=1, env=e).policy() for x, e in zip(made, envs, strict=True)]
    seen, took = [e.reset() for e in envs], np.zeros((rounds + 1, len(envs)))
    for r, (k, env) in product(range(rounds + 1), enumerate(envs)):
        begun = time.process_time()
        for _ in range(steps):
            seen[k] = env.step(policies[k].act(seen[k])).obs
        took[r, k] = 1000 * (time.process_time() - begun) / steps
    for env in envs:
        env.close()
    # The first round warms up.
    medians = np.median(took[1:], 0)
    return {f"{setting}/{m}": round(float(v), 3) for m, v in zip(MAIN[1:], medians, strict=True)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--samples", type=int, default=700_000)
    parser.add_argument("--setting", choices=("poise", "paper"), default="poise")
    parser.add_argument("--clips", nargs="+", choices=tuple(CLIPS), default=list(CLIPS))
    parser.add_argument("--methods", nargs="+", choices=tuple(METHODS), default=list(MAIN))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument(
        "--gains", type=float, nargs="+", default=[1.0], help="factors of the body's gains"
    )
    parser.add_argument("--times", action="store_true", help="measure a control step, train nothing")
    parser.add_argument("--collect", action="store_true", help="train nothing")
    parser.add_argument("--work", type=Path, default=Path("runs/rfc_order"))
    a = parser.parse_args()
    torch.set_num_threads(1)
    done, times = f"result_{a.samples}.json", a.work / "times.json"
    if a.times:
        clip = clip_of(a.data, a.clips[0])
        ms = {k: v for s in ("poise", "paper") for k, v in control_step_ms(clip, s).items()}
        a.work.mkdir(parents=True, exist_ok=True)
        times.write_text(json.dumps({"clip": a.clips[0], "ms": ms}))
    elif not a.collect:
        for seed, clip_name, gains, method in product(a.seeds, a.clips, a.gains, a.methods):
            if method == "nothing" and seed != a.seeds[0]:
                continue
            name = run_name(clip_name, method, seed, gains)
            folder, clip = folder_of(a.work, a.setting, name), clip_of(a.data, clip_name)
            if not (folder / done).exists():
                config = settings(a.setting, clip, method, seed, gains)
                result = one(folder, clip, config, method, a.samples)
                folder.mkdir(parents=True, exist_ok=True)
                (folder / done).write_text(json.dumps({"name": name, **result}))
                print(time.strftime("%H:%M"), name, *(f"{k} {result[k]:.3g}" for k in SHOWN), flush=True)
    found = [json.loads(p.read_text()) for p in sorted((a.work / a.setting).glob(f"*/{done}"))]
    runs = {r.pop("name"): r for r in found}
    out = Path(__file__).with_name(f"rfc_order_{a.setting}.json")
    command = f"python benchmarks/rfc_order.py --data FOLDER --samples {a.samples} --setting {a.setting}"
    ms = json.loads(times.read_text()) if times.exists() else None
    rfc_order_tables.write(out, command, runs, ms)


#: Of a finished run, what is printed.
SHOWN = ("eval_imitation", "succ", "mpjpe_mm", "force_mean_n", "seconds")


if __name__ == "__main__":
    main()
