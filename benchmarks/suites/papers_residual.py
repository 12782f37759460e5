"""Figure 2 of Residual Force Control: learning with residual forces and without, clip by clip.

Seven of the paper's eight clips and, for the eighth, DeepMimic's backflip. Everything but the residual
force is the same for all methods: body, terms, PPO, seeds; the imitation reward leaves out the
regularizer (paper Sec. 6.1). "nothing" is the null: action 0, no training and no help. Four clips also
have servos half and twice as stiff (App. C). A training that was stopped goes on.
"""

from __future__ import annotations

import csv
import math
import re
import statistics
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common.clips import Places, moment
from benchmarks.common.rows import Figure, between
from benchmarks.common.runner import Part, Raws
from benchmarks.common.starts import Nothing
from benchmarks.suites.engine import bench_latency
from poise.formats import read_clip
from poise.jobs.runs import begin, evaluate, train
from poise.learn import LATEST, Until, load_policy
from poise.motion import Clip, ClipLibrary
from poise.recipes.imitation import Imitation
from poise.recipes.residual_force import build
from poise.recipes.residual_force_settings import ResidualForce
from poise.score import start_frames
from poise.score.episodes import frames_from

SAMPLES, SEEDS = 500_000, (0, 1, 2)


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
#: One who sits on a chair that is not there, as in the paper's supplement: hand-keyed.
SITTING = "other/keyed_cc0/human-base-animations.glb", "Sitting_Talking_Loop"


SKELETON = "cmu_amc/rfc/08.asf"


METHODS: dict[str, dict[str, Any]] = {
    "nothing": {"method": "deepmimic"},
    "deepmimic": {"method": "deepmimic"},
    "rfc-implicit": {"method": "rfc-implicit"},
    "rfc-explicit": {"method": "rfc-explicit"},
}
#: Clips and factors of kp and kd for App. C's words on gains, of RFC-Implicit with the first seed.
GAINS = ("90_02", "05_13", "90_08", "90_05"), (0.5, 2.0)
#: Iterations of which a point of a curve is the mean.
SMOOTH = 5


def clip_of(data: Path, name: str) -> Clip:
    """One of `CLIPS`, or "sitting"."""
    if name == "sitting":
        return read_clip(data / SITTING[0], take=SITTING[1])
    file, fps = CLIPS[name]
    return read_clip(data / file, skeleton=data / SKELETON if file.endswith(".amc") else None, fps=fps)


def settings(clip: Clip, method: str, seed: int, gains: float = 1.0) -> ResidualForce:
    """Of one run: the default recipe from nothing, with 100 N kept.

    gains: factor of kp and kd of all servos.
    """
    config = ResidualForce(help_limit=100.0, help_start=None, expert=False, seed=seed, **METHODS[method])
    if gains == 1.0:
        return config
    rows = build(clip, config).humanoid.table.rows
    changed = tuple((f"{r.name}.{k}", gains * getattr(r, k)) for r in rows[1:] for k in ("kp", "kd"))
    return replace(config, body=replace(config.body, overrides=changed))


def one(folder: Path, clip: Clip, config: ResidualForce, method: str, samples: int) -> dict[str, Any]:
    """Trains one policy to `samples` control steps; the end of the curve and the final evaluation."""
    if method == "nothing":
        return final(build(clip, config), None, 0)
    imitation = begin(folder, ClipLibrary.of(clip), config)
    train(imitation, folder, Until(samples=samples), threads=1, tensorboard=False)
    with (folder / "log.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    # Return per episode as in the paper's figure 2: reward per step times steps survived.
    curve = [float(r["env/imitation"]) * float(r["episode_length"]) for r in rows]
    smooth = [float(np.mean(curve[max(0, k - SMOOTH + 1) : k + 1])) for k in range(len(curve))]
    return {
        "return_last": smooth[-1],
        "curve": [[int(float(r["samples"])), round(v, 3)] for r, v in zip(rows, smooth, strict=True)],
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
    """Clips, methods and seeds, seed by seed; then other gains."""
    if places.smoke:
        return [
            "90_02; nothing, seed 0",
            "90_02; rfc-implicit, seed 0",
            "90_02; rfc-implicit, gains by 2, seed 0",
        ]
    own = [
        f"{c}; {m}, seed {s}"
        for s in SEEDS
        for c, m in product(CLIPS, METHODS)
        if s == 0 or m != "nothing"
    ]
    clips, factors = GAINS
    return own + [f"{c}; rfc-implicit, gains by {f:g}, seed 0" for f in factors for c in clips]


def sitting_units(places: Places) -> list[str]:
    """Methods and seeds of one who sits without a chair."""
    seeds = SEEDS[:1] if places.smoke else SEEDS
    methods = ("deepmimic", "rfc-explicit", "rfc-implicit")
    return ["sitting; nothing, seed 0", *(f"sitting; {m}, seed {s}" for s in seeds for m in methods)]


def trained(places: Places, unit: str) -> Any:
    """One training."""
    name, _, rest = unit.partition("; ")
    kind, _, seed = rest.partition(", seed ")
    method, _, gains = kind.partition(", gains by ")
    clip = moment(seconds=2.5) if places.smoke else clip_of(places.data, name)
    config, samples = settings(clip, method, int(seed), float(gains or 1)), SAMPLES
    if places.smoke:
        ppo = replace(config.ppo, horizon=4, minibatch=16, norm_warmup=2)
        config, samples = replace(config, num_envs=8, ppo=ppo), 32
    return one(places.work / "rfc" / re.sub("[^a-z0-9_.-]+", "-", unit), clip, config, method, samples)


def rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """Means and ranges over seeds, and the samples after which a curve first is as high as DeepMimic's
    end in the mean of seeds; a curve that never is counts with all that it had."""
    groups: dict[str, list[dict[str, Any]]] = {}
    for unit, raw in raws.items():
        groups.setdefault(unit.partition(", seed ")[0], []).append(raw)
    for unit, own in groups.items():
        clip, kind = unit.split("; ")
        against = groups.get(f"{clip}; deepmimic")
        if kind != "nothing" and against is not None:
            end = statistics.fmean(r["return_last"] for r in against)
            for raw in own:
                first = [s for s, value in raw["curve"] if value >= end]
                raw["thousand_to_deepmimic"] = (first or [raw["curve"][-1][0]])[0] / 1000
        policy = "" if kind == "nothing" else f"{kind} (trained for this table)"
        for key in own[0].keys() - {"starts", "curve"}:
            values = [float(r[key]) for r in own if math.isfinite(r[key])]
            if not values:
                continue
            yield Figure(
                f"Residual Force Control, Figure 2, {unit}",
                key,
                statistics.fmean(values),
                own[0]["starts"],
                between(values),
                len(values),
                policy,
            )
        if policy:
            subject = f"Residual Force Control, Figure 2, {unit}"
            yield Figure(subject, "samples", SAMPLES, own[0]["starts"], seeds=len(own), policy=policy)


def timed_units(places: Places) -> list[str]:
    """Draws in turns, so that a busy machine is busy for all methods."""
    methods = [m for m in METHODS if m != "nothing"]
    return [f"{m}, draw {k}" for k in range(1 if places.smoke else len(TIMES)) for m in methods]


#: Draws whose range is the interval of a time.
TIMES = range(5)


def timed(places: Places, unit: str) -> Any:
    """One character's control step on one thread, with the force."""
    clip = moment(seconds=2.5) if places.smoke else clip_of(places.data, "90_02")
    method = unit.partition(", draw ")[0]
    task = build(clip, settings(clip, method, 0))
    return bench_latency(task, steps=10 if places.smoke else 600, helped=method != "deepmimic")


def timed_rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """Medians of 600 steps: their mean and range over draws."""
    for method in dict.fromkeys(u.partition(", draw ")[0] for u in raws):
        own = [r["ms"] for u, r in raws.items() if u.startswith(f"{method}, draw")]
        subject = f"Residual Force Control, App. C, one character; {method}"
        yield Figure(
            subject, "ms_a_step", statistics.fmean(own), 600, between(own), len(own), "untrained"
        )


PARTS = {
    "residual forces": Part("Figure 2 of Residual Force Control", units, trained, rows, hours=3.0),
    "residual sitting": Part("sitting without a chair", sitting_units, trained, rows, hours=0.3),
    "residual times": Part("a control step's time", timed_units, timed, timed_rows, hours=0.02),
}
