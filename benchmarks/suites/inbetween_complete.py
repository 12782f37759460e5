"""Motion between keyframes: the network that ships, networks trained on Bandai, and keyframes to a body.

L2P, L2Q and NPSS at 5, 15, 30 and 45 frames as the LAFAN1 benchmark has them, on clips that were kept
apart (`training/inbetween.py`); windows by difficulty; keyframes every 15 and 30 frames over whole
clips; from keyframes a second apart to a body. Interpolation stands beside every row, and standing still
is the null. Networks of Bandai are trained here (three core-hours each), for they tell how far the
method goes where other takes of the same are learned; how the adaptation is set is chosen on validation
alone.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.common.clips import RFC, WALK, Places
from benchmarks.common.rows import Figure, between, mean_of, of
from benchmarks.common.runner import Part, Raws
from benchmarks.suites.lookahead_search import SMALL
from poise.errors import PoiseError
from poise.formats import read_clip, write_clip
from poise.formats.own import unpack_clips
from poise.jobs.complete import complete
from poise.jobs.deliver import key_errors, stage_of
from poise.jobs.inbetween.fill import inbetween, shipped_model
from poise.jobs.inbetween.inbetween_settings import Inbetween, small
from poise.jobs.inbetween.inbetween_training import Task, begin, train
from poise.jobs.open import open_run
from poise.jobs.track import TrackConfig
from poise.kinematics import fit_humanoid, retarget
from poise.kinematics.forward import lowest_height, poses_of
from poise.learn.inbetween_model import MODEL, Adaptation, InbetweenModel, adapt, load_model
from poise.learn.transition import FilledGap, Known, SkeletonLayout
from poise.metrics import l2p
from poise.motion import Clip, Skeleton, shifted, trim
from poise.motion.rotations import forward_kinematics, normalize
from poise.plan import LookaheadConfig
from poise.score.gaps import BANDAI, BANDAI_TAKES, GapRow, TestSet, evaluate, predict, score, test_set
from poise.synthesis.filler import Gap, interpolated
from poise.synthesis.keyframes import fill_keyframes
from poise.synthesis.windows import FrameBank
from training.inbetween import config_of

LENGTHS = (5, 15, 30, 45)
#: L2P of interpolation at 30 frames on LAFAN1.
LAFAN1_L2P = 2.3


#: Under this distance of the dot product from 1 the published slerp is a plain weighted sum.
_LINEAR = 0.01


class Baseline:
    """`zero-velocity` repeats the last frame; `interpolation` draws lines and arcs to the target.

    Interpolation is Harvey et al.'s own: the root by LERP, LOCAL quaternions by SLERP in the start's
    hemisphere, weights in float32, and nearly equal quaternions by an unnormalised LERP.
    """

    def __init__(self, kind: str, layout: SkeletonLayout):
        if kind not in ("zero-velocity", "interpolation"):
            raise ValueError(f"there is no baseline '{kind}'")
        self.kind, self.layout = kind, layout

    def parameters(self) -> list[torch.nn.Parameter]:
        """None."""
        return []

    def fill(self, known: Known, length: int, noise: torch.Generator | None = None) -> FilledGap:
        """`length` frames after the last known one; see `learn.transition.TransitionNet`."""
        a, qa = known.past_root[:, -1:], known.past_rot[:, -1:]
        if self.kind == "zero-velocity":
            root = a.expand(-1, length, -1)
            rot = qa.expand(-1, length, -1, -1)
        else:
            t = torch.linspace(0, 1, length + 2, dtype=torch.float32)[1:-1].to(a.dtype)
            root = a + t[:, None] * (known.target_root.unsqueeze(1) - a)
            rot = protocol_slerp(qa, known.target_rot.unsqueeze(1), t[:, None])
        pos, _ = forward_kinematics(self.layout.parents, known.offsets[:, None], root, rot)
        contact = torch.zeros(*root.shape[:2], len(self.layout.feet), dtype=root.dtype)
        return FilledGap(root, rot, contact, pos)


def protocol_slerp(a: Tensor, b: Tensor, t: Tensor) -> Tensor:
    """Between `a` and `b (..., 4)` at `t (...)`, as the published benchmark does it."""
    dot = (a * b).sum(-1, keepdim=True)
    b = torch.where(dot < 0, -b, b)
    dot, t = dot.abs().clamp(max=1.0), t.unsqueeze(-1)
    near = 1 - dot < _LINEAR
    angle = torch.where(near, torch.ones_like(dot), torch.acos(dot))
    wa = torch.where(near, 1 - t, ((1 - t) * angle).sin() / angle.sin())
    wb = torch.where(near, t, (t * angle).sin() / angle.sin())
    return wa * a + wb * b


# --- adaptation ------------------------------------------------------------------------------------


#: What is tried on validation, at one length; the iterations (0 to 7) are chosen at each.
SETTINGS = (
    Adaptation(lr=3e-6, beta=0.01),
    Adaptation(lr=1e-5, beta=0.01),
    Adaptation(lr=3e-5, beta=0.01),
    Adaptation(lr=1e-4, beta=0.01),
    Adaptation(lr=1e-5, beta=0.0),
    Adaptation(lr=1e-5, beta=0.1),
)


#: Windows of the validation part that choices are made on.
_ENOUGH = 128


_LENGTH = 30


def known_of(test: TestSet, length: int) -> Known:
    """Inputs of a network, float32."""
    return Known(*(x.float() for x in test.known(length)))


def some_of(test: TestSet, most: int) -> TestSet:
    """No more than so many windows, evenly spread."""
    every = max(1, -(-len(test.root) // most))
    parts = {k: getattr(test, k)[::every] for k in ("root", "rot", "pos", "quat", "offsets")}
    return test._replace(**parts)


def chosen(
    model: InbetweenModel,
    held: TestSet,
    length: int,
    among: Sequence[Adaptation] = SETTINGS,
    most: int = 7,
) -> Adaptation:
    """The setting and the iterations with the lowest figures of transitions on validation.

    Foot skating is what TTA is for, but L2P must not rise, so settings that raise it are out; of the
    others the one counts that lowers the share and depth of penetration, the slide and L2P most.
    """
    held = some_of(held, _ENOUGH)
    known = known_of(held, length)
    base = score(held, predict(model.net, held, length)[0], length)

    def rated(filled) -> float:
        row = score(held, filled, length)
        worse = max(0.0, row.l2p / base.l2p - 1)
        feet = sum(_ratio(getattr(row, k), getattr(base, k)) for k in ("fq", "fp_mm", "slide_mm"))
        return row.l2p / base.l2p + 0.1 * feet + 100 * worse

    return best_setting(among, lambda s: choose_iterations(model.net, known, length, rated, s, most))


def choose_iterations(
    net: torch.nn.Module,
    known: Known,
    length: int,
    score: Callable[[FilledGap], float],
    config: Adaptation | None = None,
    most: int = 7,
) -> tuple[int, tuple[float, ...]]:
    """The number of iterations, 0 to `most`, after which transitions score lowest on validation
    sequences.

    The paper reports the best iteration on the test set itself, which is tuning on test data; this is
    for sequences held out for choices. Returns the number and the scores of 0, 1, ... iterations.
    """
    config = config or Adaptation()

    @torch.no_grad()
    def scored(own: torch.nn.Module) -> float:
        filled = [
            own.fill(Known(*(x[low : low + config.batch] for x in known)), length)  # type: ignore[operator]
            for low in range(0, len(known.target_root), config.batch)
        ]
        return score(FilledGap(*(torch.cat(x) for x in zip(*filled, strict=True))))

    scores = [scored(net)]
    steps = Adaptation(**{**config.__dict__, "iterations": most})
    adapt(net, known, length, steps, lambda i, own, loss: scores.append(scored(own)))
    best = min(range(len(scores)), key=scores.__getitem__)
    return best, tuple(scores)


def best_setting(
    choices: Sequence[Adaptation], tried: Callable[[Adaptation], tuple[int, tuple[float, ...]]]
) -> Adaptation:
    """The setting, with its iterations, that scored lowest; `tried` runs `choose_iterations` for one."""
    if not choices:
        raise PoiseError("there is no setting to choose from", code="argument-missing")
    results = [(config, *tried(config)) for config in choices]
    config, iterations, _ = min(results, key=lambda r: r[2][r[1]])
    return Adaptation(**{**config.__dict__, "iterations": iterations})


def _ratio(value: float, before: float) -> float:
    return value / before if abs(before) > 1e-9 else 1.0


def adapted_rows(model: InbetweenModel, held: TestSet, test: TestSet, most: int) -> list[GapRow]:
    """Rows after adaptation to the whole test set of each length: one setting, chosen at `_LENGTH`, and
    the iterations at each length."""
    rows, best = [], chosen(model, held, _LENGTH, SETTINGS if most > 1 else SETTINGS[:1], most)
    for n in LENGTHS:
        setting = best if n == _LENGTH else chosen(model, held, n, [best], most)
        rows += evaluate(adapt(model.net, known_of(test, n), n, setting), test, (n,))
    return rows


# --- windows and clips -----------------------------------------------------------------------------


def some(test: TestSet, rows: torch.Tensor) -> TestSet:
    """Some windows of a test set."""
    parts = {k: getattr(test, k)[rows] for k in ("root", "rot", "pos", "quat", "offsets")}
    return test._replace(**parts)


def by_window(net: Any, test: TestSet, length: int = 30) -> torch.Tensor:
    """L2P `(N)` of each window."""
    made, _ = predict(net, test, length)
    pos, _ = test.truth(length)
    own, _ = forward_kinematics(test.parents, test.offsets[:, None], made.root.to(pos), made.rot.to(pos))
    return torch.stack([l2p(a[None], b[None], test.std) for a, b in zip(own, pos, strict=True)])


def clips_of(bank: FrameBank) -> list[Clip]:
    """The clips of a bank, on their own bones."""
    out = []
    for k, name in enumerate(bank.clips):
        rows = slice(int(bank.first[k]), int(bank.first[k + 1]))
        skeleton = Skeleton(bank.names, bank.parents, bank.offsets[k].double().numpy(), bank.ends)
        rot = normalize(bank.rot[rows].double()).numpy()
        out.append(Clip(skeleton, bank.root[rows].double().numpy(), rot, bank.fps, name))
    return out


def whole_clip(model: InbetweenModel, clip: Clip, every: int) -> dict[str, Any]:
    """A clip with a keyframe every so many frames, interpolated and filled."""
    keys = list(range(0, clip.frames, every))
    gaps = [Gap(a, b) for a, b in pairwise(keys)]
    end, truth = keys[-1] + 1, clip.positions()

    def off(made: Clip) -> float:
        return round(1000 * float(np.linalg.norm(made.positions() - truth, axis=-1)[:end].mean()), 1)

    filled = fill_keyframes(clip, keys, model)
    return {
        "clip": clip.name,
        "every": every,
        "gaps": len(gaps),
        "filled_mm": off(filled.clips[0]),
        "interpolated_mm": off(interpolated(clip, clip.root_pos, clip.rot, gaps)),
        "faults": len(filled.faults),
        "over_limit": round(max(filled.over), 2),
    }


# --- sets -----------------------------------------------------------------------------------------


def toy_library(places: Places, names: Sequence[str]) -> Path:
    """The walk on the bones of the network that ships under other names, for a smoke test."""
    folder, example = places.work / "toys" / names[0], shipped().example
    assert example is not None
    clip, _ = retarget(read_clip(WALK), unpack_clips(*example)[0])
    for name in names:
        file = folder / f"{name}.bvh"
        if not file.exists():
            folder.mkdir(parents=True, exist_ok=True)
            write_clip(clip.replaced(name=name), file)
    return folder


@cache
def cmu(places: Places) -> Task:
    """The clips of the network that ships, of which some subjects are kept apart."""
    if places.smoke:
        folder = toy_library(places, ("01_01", "05_01", "08_01"))
        config = replace(config_of(folder / "01_01.bvh"), mirror=False)
        return begin(places.work / "cmu", folder, config, 0.0, 1)[0]
    rfc = places.data / RFC
    skeletons = (f"rfc.05={rfc}/01.asf", f"rfc.90={rfc}/08.asf")
    never = (r"-(other|lafan1_bvh|noisy|amass|cmu_hard|usc)-",)
    config = config_of(places.data / "cmu_amc/02/02_01.amc", skeletons, never)
    return begin(places.work / "cmu", places.data, config, 0.0, 1)[0]


def kept_apart(task: Task) -> TestSet:
    """Windows of the final part."""
    protocol, std = task.config.protocol, task.data.std.double()
    return test_set(protocol.split(task.bank, "final"), std, protocol)


def shipped() -> InbetweenModel:
    """The network that comes with Poise."""
    return load_model(shipped_model())


def as_figures(subject: str, rows: Sequence[Any], n: int, **more: Any) -> Iterator[Figure]:
    """L2P, L2Q and NPSS by length."""
    values = {f"{k}_{r['length']}": r[k] for r in rows for k in ("l2p", "l2q", "npss")}
    yield from of(subject, values, n, **more)


def plain(rows: Sequence[GapRow]) -> list[dict[str, Any]]:
    """As JSON has it."""
    return [asdict(r) for r in rows]


# --- the network that ships -----------------------------------------------------------------------

METHODS = {"nothing (standing still)": "zero-velocity", "interpolation": "interpolation", "network": ""}


def subjects(places: Places, unit: str) -> Any:
    """One method on the subjects that are kept apart."""
    task = cmu(places)
    test = kept_apart(task)
    net = Baseline(METHODS[unit], task.data.layout) if METHODS[unit] else shipped().net
    return {"windows": len(test.root), "rows": plain(evaluate(net, test, LENGTHS))}


def subject_rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """By method."""
    for unit, raw in raws.items():
        yield from as_figures(f"six CMU subjects, never learned; {unit}", raw["rows"], raw["windows"])


def strata(places: Places, unit: str) -> Any:
    """Interpolation and network in windows of one difficulty, by L2P of interpolation at 30 frames."""
    task = cmu(places)
    test, line = kept_apart(task), Baseline("interpolation", task.data.layout)
    hard = by_window(line, test)
    order, third = hard.argsort(), len(hard) // 3
    easy = hard[order].cumsum(0) / torch.arange(1, len(order) + 1)
    picked = {
        "easiest third of windows": order[: max(1, third)],
        "middle third of windows": order[third : max(1, 2 * third)],
        "hardest third of windows": order[2 * third :],
        "windows as hard as LAFAN1": order[: max(1, int((easy <= LAFAN1_L2P).sum()))],
    }[unit]
    own = some(test, picked)
    return {
        "windows": len(picked),
        "interpolation": plain(evaluate(line, own, LENGTHS)),
        "network": plain(evaluate(shipped().net, own, LENGTHS)),
    }


STRATA = (
    "easiest third of windows",
    "middle third of windows",
    "hardest third of windows",
    "windows as hard as LAFAN1",
)


def strata_rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """By difficulty and method."""
    for unit, raw in raws.items():
        for method in ("interpolation", "network"):
            yield from as_figures(f"{unit}; {method}", raw[method], raw["windows"])


@cache
def final_clips(places: Places) -> dict[str, Clip]:
    """Clips that are kept apart, of two seconds and more."""
    task = cmu(places)
    bank = task.config.protocol.split(task.bank, "final")
    return {c.name: c for c in clips_of(bank) if c.frames >= 61}


def whole(places: Places, unit: str) -> Any:
    """A clip with keyframes every 15 and every 30 frames, interpolated and filled."""
    return {str(every): whole_clip(shipped(), final_clips(places)[unit], every) for every in (15, 30)}


def whole_rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """Distances, faults and speeds."""
    for every in ("15", "30"):
        rows, subject = (
            [r[every] for r in raws.values()],
            f"held-out clips, a keyframe every {every} frames",
        )
        values = {
            "distance_mm": mean_of(r["filled_mm"] for r in rows),
            "faults_a_clip": mean_of(r["faults"] for r in rows),
            "fastest_over_limit": max(r["over_limit"] for r in rows),
        }
        yield from of(f"{subject}; network", values, len(rows))
        line = {"distance_mm": mean_of(r["interpolated_mm"] for r in rows)}
        yield from of(f"{subject}; interpolation", line, len(rows))


# --- networks of Bandai ---------------------------------------------------------------------------

PROTOCOLS = {
    "Bandai, styles never learned": BANDAI,
    "Bandai, other takes of what was learned": BANDAI_TAKES,
}
LINES = ("interpolation", "nothing (standing still)")


def net_units(places: Places) -> list[str]:
    """Baselines, and networks with their seeds."""
    if places.smoke:
        return [f"{next(iter(PROTOCOLS))}; {k}" for k in ("interpolation", "rtn, seed 0")]
    nets = [f"{net}, seed {seed}" for net in ("transformer", "rtn") for seed in (0, 1)]
    return [f"{name}; {k}" for name in PROTOCOLS for k in (*LINES, *nets)]


def bandai(places: Places, unit: str) -> Any:
    """A baseline, or a network trained and scored, with and without adaptation."""
    name, _, method = unit.partition("; ")
    net, _, seed = method.partition(", seed ")
    protocol = PROTOCOLS[name]
    config = Inbetween(
        net="rtn" if net == "rtn" else "transformer",
        name=protocol.name,
        final=protocol.final,
        validation=protocol.validation,
        seed=int(seed or 0),
        contacts="harvey",
    )
    folder = places.work / "bandai" / unit.replace(", ", "-").replace("; ", "-").replace(" ", "-")
    library, minutes, steps = places.data / "other/bandai_bvh", 180.0, None
    if places.smoke:
        names = [f"dataset-1_walk_{style}_001" for style in ("normal", "old", "sad")]
        library, config, steps = toy_library(places, names), small(config), 2
    task, steps = begin(folder, library, config, minutes, steps)
    test = kept_apart(task)
    if not seed:
        line = Baseline(METHODS[net], task.data.layout)
        return {"windows": len(test.root), "rows": plain(evaluate(line, test, LENGTHS))}
    model = load_model(folder) if (folder / MODEL).exists() else None
    if model is None or model.meta.get("step") != steps:
        model = train(task, folder, steps, tensorboard=False)[0]
    out = {"windows": len(test.root), "rows": plain(evaluate(model.net, test, LENGTHS))}
    if task.validation is not None:
        out["adapted"] = plain(adapted_rows(model, task.validation, test, 1 if places.smoke else 7))
    return out


def bandai_rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """Baselines, and means over seeds of each network with and without adaptation."""
    for name in PROTOCOLS:
        for net in (*LINES, "transformer", "rtn"):
            own = [r for u, r in raws.items() if u.startswith(f"{name}; {net}")]
            for kind, suffix in (("rows", ""), ("adapted", " and adapted")):
                tables = [r[kind] for r in own if kind in r]
                if tables:
                    rows = [
                        {k: mean_of(r[k] for r in same) for k in same[0]}
                        for same in zip(*tables, strict=True)
                    ]
                    rows = [{**r, "length": round(r["length"])} for r in rows]
                    title = net if net in LINES else f"{net} trained on it{suffix}"
                    more = {"policy": "" if net in LINES else f"{net} (trained for this table)"}
                    yield from as_figures(
                        f"{name}; {title}", rows, own[0]["windows"], seeds=len(tables), **more
                    )


# --- keyframes to a body --------------------------------------------------------------------------

#: Of subjects and sources that neither the network nor the policy has learned from, but for DeepMimic's;
#: whether the times may change, and the share of its time in which the jump is to be done.
JUMP = "deepmimic_txt/humanoid3d_jump.txt"
COMPLETED: dict[str, tuple[str, bool, float]] = {
    **{
        Path(f).stem: (f, False, 1.0)
        for f in (
            "other/mass_bvh/dance.bvh",
            "cmu_bvh/ad/dance001.bvh",
            "cmu_amc/11/11_01.amc",
            "cmu_amc/38/38_01.amc",
            "cmu_amc/39/39_02.amc",
            "lafan1_bvh/walk4_subject1.bvh",
            "cmu_amc/01/01_01.amc",
            JUMP,
        )
    },
    "dance, retimed": ("other/mass_bvh/dance.bvh", True, 1.0),
    **{
        f"humanoid3d_jump, retimed{f', in {share:g} of its time' if share < 1 else ''}": (
            JUMP,
            True,
            share,
        )
        for share in (1.0, 0.5, 0.35)
    },
    **{f"humanoid3d_jump, in {share:g} of its time": (JUMP, False, share) for share in (0.5, 0.35)},
}
SECONDS = 8.0


def completed(places: Places, unit: str) -> Any:
    """A clip with a keyframe each second: how near the body passes by them."""
    file, retime, share = COMPLETED[unit]
    clip = read_clip(places.file(file))
    clip = trim(clip, 0, min(clip.frames, round((1.5 if places.smoke else SECONDS) * clip.fps)) - 1)
    keys = [*range(0, clip.frames - round(0.5 * clip.fps), round(clip.fps)), clip.frames - 1]
    times = None if share == 1.0 else [share * k / clip.fps for k in keys]
    begun, how = time.process_time(), {"lookahead": SMALL, "adapt": 0} if places.smoke else {}
    done = complete(
        clip, keys, open_run(None).tracker, threads=1, supports="none", retime=retime, times=times, **how
    )
    made = done.filled.clips[0].positions()[list(done.at)]
    # The null: what the body is from its keyframes if it stays on the first one.
    still = np.linalg.norm(clip.positions()[keys] - clip.positions()[keys[:1]], axis=-1).mean()
    return {
        "keyframes": len(keys),
        "keyframes_met_mm": float(np.mean(done.met_mm)),
        "worst_keyframe_mm": max(done.met_mm),
        "whole": float(not done.failures),
        "kept_exactly": float(np.abs(made - clip.positions()[keys]).max() < 1e-6),
        "core_s": time.process_time() - begun,
        "standing_still_mm": 1000 * float(still),
    }


def completed_rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """Each clip."""
    for unit, raw in raws.items():
        values = {k: v for k, v in raw.items() if k not in ("keyframes", "standing_still_mm")}
        yield from of(f"poise complete, {unit}", values, raw["keyframes"])
    still = mean_of(r["standing_still_mm"] for r in raws.values())
    yield Figure("poise complete, standing on the first keyframe", "keyframes_met_mm", still, len(raws))


# --- adaptation, from keyframes to a body -----------------------------------------------------------

#: Clips of the styles that choices are made on, and iterations of each gap.
ADAPTED, ITERATIONS = 10, (0, 20)
#: Seconds of each clip; its budget is a quarter of what is usual, and what it loses is not searched.
ADAPTED_SECONDS, ADAPTED_BUDGET = 2.5, 192.0
#: m below the floor from which a sole counts as through it.
THROUGH = 0.005


def held_back(places: Places) -> list[Path]:
    """Bandai's clips for choices, evenly spread."""
    folder = places.data / "other" / "bandai_bvh"
    found = [f for f in sorted(folder.glob("*.bvh")) if BANDAI.part_of(f.name) == "validation"]
    return [found[round(i * (len(found) - 1) / (ADAPTED - 1))] for i in range(ADAPTED)]


def adapted_units(places: Places) -> list[str]:
    """Clips with and without adaptation."""
    files = [WALK] if places.smoke else held_back(places)
    return [f"{f.stem}; adapt {n}" for f in files for n in ITERATIONS]


def adapted(places: Places, unit: str, body: bool = False) -> Any:
    """A clip with a keyframe each second: how far the filled motion is from the recorded one in between,
    and how soles sink and slide; and a body that does it. The recorded one is set on the floor first."""
    stem, _, iterations = unit.partition("; adapt ")
    files = [WALK] if places.smoke else held_back(places)
    clip = read_clip(next(f for f in files if f.stem == stem))
    seconds = 1.2 if places.smoke else ADAPTED_SECONDS
    clip = trim(clip, 0, min(clip.frames, round(seconds * clip.fps)) - 1)
    humanoid, _, report = fit_humanoid(clip)
    clip = shifted(clip, (0.0, 0.0, report.clips[0].ground.lift_m))
    keys = [*range(0, clip.frames - round(0.5 * clip.fps), round(clip.fps)), clip.frames - 1]
    count = min(int(iterations), 1) if places.smoke else int(iterations)
    if body:
        ahead = SMALL if places.smoke else LookaheadConfig().with_budget(ADAPTED_BUDGET)
        config = TrackConfig(controller="lookahead", lookahead=ahead, threads=1, supports="none")
        done = complete(clip, keys, open_run(None).tracker, config, adapt=count)
        motions = {"filled": done.came, "simulated": done.delivered(hold=False)}
    else:
        done = inbetween(clip, keys, adapt=count)
        motions = {"filled": done.clip}
    inside = np.setdiff1d(np.arange(clip.frames), keys)
    out: dict[str, Any] = {"whole": float(not done.failures)} if body else {}
    for name, made in motions.items():
        stage = stage_of(name, made, key_errors(made, clip, keys, keys))
        off = np.linalg.norm(made.positions() - clip.positions(), axis=-1)[inside]
        soles = lowest_height(humanoid.table, *poses_of(made, humanoid.table))[:, list(humanoid.feet)]
        out |= {
            f"{name}_error_mm": 1000 * float(off.mean()),
            f"{name}_fp_mm": 1000 * float(np.minimum(soles, 0.0)[inside].mean()),
            f"{name}_fq_percent": 100 * float((soles < -THROUGH)[inside].mean()),
            f"{name}_slide_mm_per_s": stage.sole_slide_mm_per_s,
            f"{name}_keyframes_mm": stage.key_mm,
        }
    return out


def adapted_body(places: Places, unit: str) -> Any:
    """The same, done by a body."""
    return adapted(places, unit, True)


def adapted_unit_rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """Means of the clips, and the mean of what adaptation changes with its interval."""
    by: dict[int, list[Any]] = {
        n: [raw for unit, raw in raws.items() if unit.endswith(f"; adapt {n}")] for n in ITERATIONS
    }
    verb = "complete" if "whole" in next(iter(raws.values())) else "inbetween"
    title = f"poise {verb}, clips for choices, a keyframe a second; adapt {{}}"
    for n, found in by.items():
        values = {k: mean_of(r[k] for r in found) for k in found[0]}
        yield from of(title.format(n), values, len(found))
    none, some_ = (by[n] for n in ITERATIONS)
    for key in none[0]:
        pairs = [(a[key], b[key]) for a, b in zip(none, some_, strict=True)]
        change = [b - a for a, b in pairs if a is not None and b is not None]
        yield Figure(
            title.format(f"{ITERATIONS[1]}, change"),
            key,
            mean_of(change),
            len(change),
            between(change),
        )


#: Dances, jumps and walks that are filled alone.
KINEMATIC = (
    "cmu_amc/0[1-9]/*.amc",
    "cmu_amc/3[589]/*.amc",
    "cmu_bvh/ad/*.bvh",
    "deepmimic_txt/*.txt",
    "other/mass_bvh/*.bvh",
    "other/bandai_bvh/*dance*.bvh",
)


def filled_files(places: Places) -> list[str]:
    """Sixty of them."""
    if places.smoke:
        return ["walk.bvh"]
    found = sorted(p for glob in KINEMATIC for p in places.data.glob(glob))[:60]
    return [p.relative_to(places.data).as_posix() for p in found]


def fastest(places: Places, unit: str) -> Any:
    """The fastest joint of filled motion, by what people reach and by the recorded clip."""
    clip = read_clip(places.file(unit))
    clip = trim(clip, 0, min(clip.frames, round(SECONDS * clip.fps)) - 1)
    keys = [*range(0, clip.frames - round(0.5 * clip.fps), round(clip.fps)), clip.frames - 1]
    if len(keys) < 2:
        return None
    made = inbetween(clip, keys, adapt=0)
    fast = [
        np.linalg.norm(np.diff(c.positions(), axis=0), axis=-1).max() * c.fps for c in (clip, made.clip)
    ]
    return [max(made.filled.over), float(fast[1] / fast[0])]


def fastest_rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """How many are within what people reach."""
    rows = [r for r in raws.values() if r is not None]
    values = {
        "within_limits": sum(r[0] <= 1.0 for r in rows) / len(rows),
        "within_1.5_of_recorded": sum(r[1] <= 1.5 for r in rows) / len(rows),
    }
    yield from of("sixty clips, a keyframe a second, filled alone", values, len(rows))


_SHIPS = ("inbetween",)
PARTS = {
    "subjects": Part(
        "the network that ships, on subjects kept apart",
        lambda _: list(METHODS),
        subjects,
        subject_rows,
        _SHIPS,
        hours=0.05,
    ),
    "strata": Part(
        "windows by difficulty",
        lambda p: list(STRATA[-1:] if p.smoke else STRATA),
        strata,
        strata_rows,
        _SHIPS,
        hours=0.05,
    ),
    "clips": Part(
        "keyframes over whole clips",
        lambda p: list(final_clips(p)),
        whole,
        whole_rows,
        _SHIPS,
        hours=0.05,
    ),
    "bandai": Part("networks trained on Bandai", net_units, bandai, bandai_rows, hours=24.0),
    "complete": Part(
        "keyframes a second apart to a body",
        lambda p: list(COMPLETED)[: 1 if p.smoke else None],
        completed,
        completed_rows,
        ("tracker", "inbetween"),
        hours=0.3,
    ),
    "adapt": Part(
        "test-time adaptation, frames alone",
        adapted_units,
        adapted,
        adapted_unit_rows,
        _SHIPS,
        hours=0.03,
    ),
    "adapt-body": Part(
        "test-time adaptation, from keyframes to a body",
        adapted_units,
        adapted_body,
        adapted_unit_rows,
        ("tracker", "inbetween"),
        hours=0.1,
    ),
    "speeds": Part(
        "the fastest joints of filled motion", filled_files, fastest, fastest_rows, _SHIPS, hours=0.05
    ),
}
