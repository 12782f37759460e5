"""Figure 2 of Residual Force Control: learning with residual forces and without, clip by clip.

Seven of the paper's eight clips and, for the eighth, DeepMimic's backflip. Everything but the residual
force is the same for all methods: body, terms, PPO, seeds; the imitation reward leaves out the
regularizer (paper Sec. 6.1). "nothing" is the null: action 0, no training and no help. A training that
was stopped goes on.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common.clips import Places, moment
from benchmarks.common.rows import Figure, of
from benchmarks.common.runner import Part, Raws
from benchmarks.common.starts import Nothing
from poise.formats import read_clip
from poise.jobs.runs import begin, evaluate, train
from poise.learn import LATEST, Until, load_policy
from poise.motion import Clip, ClipLibrary
from poise.recipes.imitation import Imitation
from poise.recipes.residual_force import build
from poise.recipes.residual_force_settings import ResidualForce
from poise.score import start_frames
from poise.score.episodes import frames_from

SAMPLES, SEEDS = 700_000, (0, 1)
#: Pairs whose order the paper states: the first above the second.
CLAIMS = (
    ("rfc-implicit", "deepmimic"),
    ("rfc-explicit", "deepmimic"),
    ("rfc-implicit", "rfc-explicit"),
    ("rfc-explicit-all", "rfc-explicit"),
    ("rfc-implicit-uncapped", "rfc-implicit"),
    ("rfc-explicit-uncapped", "rfc-explicit"),
)


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


def clip_of(data: Path, name: str) -> Clip:
    """One of `CLIPS`."""
    file, fps = CLIPS[name]
    return read_clip(data / file, skeleton=data / SKELETON if file.endswith(".amc") else None, fps=fps)


def settings(setting: str, clip: Clip, method: str, seed: int) -> ResidualForce:
    """Of one run: "poise" is the default recipe with 100 N kept, "paper" all that the paper states."""
    same = {"seed": seed, **METHODS[method]}
    if setting == "paper":
        return ResidualForce.paper(clip, **same)
    return ResidualForce(help_limit=100.0, help_start=None, expert=False, **same)


def one(folder: Path, clip: Clip, config: ResidualForce, method: str, samples: int) -> dict[str, Any]:
    """Trains one policy to `samples` control steps; the end of the curve and the final evaluation."""
    if method == "nothing":
        return final(build(clip, config), None, 0)
    imitation = begin(folder, ClipLibrary.of(clip), config)
    train(imitation, folder, Until(samples=samples), threads=1, tensorboard=False)
    with (folder / "log.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    # Return per episode as in the paper's figure 2: reward per step times steps survived.
    curve = [[float(r[k]) for k in ("env/imitation", "episode_length")] for r in rows]
    last = curve[-max(1, len(curve) // 20) :]
    return {
        "return_last": float(np.mean([a * b for a, b in last])),
        **final(imitation, folder / LATEST, samples),
    }


def final(imitation: Imitation, policy: Path | None, samples: int) -> dict[str, float]:
    """The deterministic policy from every start frame that is more than a second from its clip's end."""
    if policy is None:
        env = imitation.env(1, threads=1)
        acts: Any = Nothing(env.num_actions)
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
        "torque_mean_nm": card.help.torque_mean_nm,
    }


def units(places: Places) -> list[str]:
    """Clips, methods and seeds."""
    if places.smoke:
        return ["90_02; nothing, seed 0", "90_02; rfc-implicit, seed 0"]
    seeds = {m: SEEDS[: 1 if m == "nothing" else None] for m in METHODS}
    return [f"{c}; {m}, seed {s}" for c, m in product(CLIPS, METHODS) for s in seeds[m]]


def trained(places: Places, unit: str) -> Any:
    """One training."""
    name, _, rest = unit.partition("; ")
    method, _, seed = rest.partition(", seed ")
    clip = moment(seconds=2.5) if places.smoke else clip_of(places.data, name)
    config, samples = settings("poise", clip, method, int(seed)), SAMPLES
    if places.smoke:
        ppo = replace(config.ppo, horizon=4, minibatch=16, norm_warmup=2)
        config, samples = replace(config, num_envs=8, ppo=ppo), 32
    return one(
        places.work / "rfc" / unit.replace("; ", "_").replace(", ", "_"), clip, config, method, samples
    )


def rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """Means over seeds; a difference between two methods over the clips that both have, with its
    standard error over these."""
    table: dict[str, dict[str, dict[str, float]]] = {}
    for unit in dict.fromkeys(u.partition(", ")[0] for u in raws):
        own = [r for u, r in raws.items() if u.startswith(f"{unit},")]
        values = {k: float(np.mean([r[k] for r in own])) for k in own[0] if k != "starts"}
        name, method = unit.split("; ")
        table.setdefault(method, {})[name] = values
        policy = "" if method == "nothing" else f"{method} (trained for this table)"
        subject = f"Residual Force Control, Figure 2, {unit}"
        yield from of(subject, values, own[0]["starts"], seeds=len(own), policy=policy)
    for above, below in CLAIMS:
        both = sorted(set(table.get(above, {})) & set(table.get(below, {})))
        for measure in ("eval_imitation", "succ") if len(both) > 1 else ():
            gap = np.array([table[above][c][measure] - table[below][c][measure] for c in both])
            error = float(gap.std(ddof=1)) / math.sqrt(len(gap))
            yield Figure(
                f"Residual Force Control, Figure 2, {above} above {below}",
                measure,
                float(gap.mean()),
                len(gap),
                f"+- {error:.3f}",
                len(SEEDS),
                f"{above} (trained for this table)",
            )


PARTS = {"residual forces": Part("Figure 2 of Residual Force Control", units, trained, rows, hours=9.0)}
