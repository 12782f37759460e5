"""A stream that drops out for a moment: the network of transitions adapted to the second before.

Skeleton2Humanoid adapts its network at test time to what it says of gaps itself. The last second of a
stream has more: recorded frames, from which gaps of the same length are cut that the network learns to
fill, by places of joints and the paper's loss. The size of its steps is chosen on windows of their own.
Beside it the network as it ships, and adapted to each gap alone. Clips are of Bandai, of which it has
learned nothing; feet are not held.
"""

from __future__ import annotations

import copy
import re
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import torch
from torch.optim import Adam

from benchmarks.common.clips import WALK, Places, clip_of, names_of
from benchmarks.common.rows import Figure, mean_of, median_of, of
from benchmarks.common.runner import Part, Raws
from poise.formats import read_clip
from poise.formats.own import unpack_clips
from poise.jobs.inbetween.fill import inbetween, shipped_model
from poise.learn.inbetween_model import Adaptation, InbetweenModel, load_model, test_loss
from poise.learn.transition import Known, joint_positions
from poise.motion import Clip, resample, trim
from poise.synthesis.filler import OtherRig
from poise.synthesis.windows import step_contacts

#: Windows that figures are of, and that the step is chosen on; frames of a stream's last second and of
#: what comes back after the gap; frames of gaps; s between frames is 1 / FPS.
COUNT, CHOSEN_ON, SECOND, AFTER, FPS = 32, 16, 30, 5, 30.0
LENGTHS = (5, 15)
#: Steps of Adam that are tried, and how many of them; iterations of the paper's adaptation.
STEPS, ITERATIONS, OWN = (1e-5, 1e-4, 3e-4), 20, 20
ERROR, SLIDE, COST = "gap_error_mm", "gap_slide_mm_per_s", "adapted_s"


def units(places: Places) -> list[str]:
    """Gaps by their lengths, and windows by their numbers."""
    if places.smoke:
        return ["5 frames, window 0", "5 frames, window 1"]
    return [f"{n} frames, window {k}" for n in LENGTHS for k in range(COUNT + CHOSEN_ON)]


@cache
def network() -> InbetweenModel:
    """The network that ships."""
    return load_model(shipped_model())


def window(places: Places, number: int, length: int) -> Clip:
    """A second of a clip, a gap and what comes after it."""
    need = SECOND + length + AFTER
    if places.smoke:
        return trim(resample(read_clip(WALK), FPS), number, number + need - 1)
    kept, rng = names_of(places, "bandai"), np.random.default_rng(number)
    while True:
        clip = resample(clip_of(places, "bandai", kept[int(rng.integers(len(kept)))]), FPS)
        if clip.frames > need:
            first = int(rng.integers(clip.frames - need))
            return trim(clip, first, first + need - 1)


def learned_on(clip: Clip, length: int, step: float) -> InbetweenModel:
    """The network after it learned to fill the gaps of a clip's first second."""
    model = network()
    assert model.example is not None
    rig = OtherRig.between(clip, unpack_clips(*model.example)[0])
    root, rot = rig.to_model((clip.root_pos[:SECOND], clip.rot[:SECOND]))
    seen = [torch.tensor(x, dtype=torch.float32) for x in (root, rot, rig.example.skeleton.offsets)]
    past, last = model.past, SECOND - model.past - length
    rows = torch.arange(last)[:, None]
    gap = rows + past + torch.arange(length)
    offsets = seen[2].expand(last, -1, -1)
    before, after = (
        [x[rows + torch.arange(past)] for x in seen[:2]],
        [x[gap[:, -1] + 1] for x in seen[:2]],
    )
    known = Known(before[0], before[1], after[0], after[1], offsets)
    net: Any = copy.deepcopy(model.net)
    truth = joint_positions(net.layout, offsets, *(x[gap] for x in seen[:2]))
    params = [p.requires_grad_(True) for p in net.parameters()]
    optimizer = Adam(params, step, fused=False)
    with torch.enable_grad():
        for _ in range(ITERATIONS):
            filled = net.fill(known, length)
            loss = (filled.pos - truth).abs().mean() + test_loss(net, known, filled, Adaptation()).mean()
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            optimizer.step()
    for p in params:
        p.requires_grad_(False)
    return replace(model, net=net)


def figures(clip: Clip, length: int, model: InbetweenModel, adapt: int = 0) -> dict[str, float]:
    """How far the joints of a gap are from the recorded ones, and how far feet slide that stood."""
    made = inbetween(clip, (SECOND - 1, SECOND + length), model, adapt=adapt, foot_lock=False).clip
    pos, truth = made.positions(), clip.positions()
    feet = [k for k, n in enumerate(clip.skeleton.names) if re.search("foot|toe", n, re.IGNORECASE)]
    rows = slice(SECOND - 1, SECOND + length + 1)
    held = step_contacts(truth[rows][:, feet])[:-1]
    moved = np.linalg.norm(np.diff(pos[rows][:, feet, :2], axis=0), axis=-1)
    off = np.linalg.norm(pos - truth, axis=-1)[SECOND : SECOND + length].mean()
    slide = FPS * float((moved * held).sum()) / max(1, int(held.sum()))
    return {ERROR: round(1000 * float(off), 3), SLIDE: round(1000 * slide, 3)}


def measured(places: Places, unit: str) -> Any:
    """One gap: as the network ships, adapted to the gap, and to the second before."""
    length, number = (int(x) for x in re.findall(r"\d+", unit))
    clip = window(places, number, length)
    out: dict[str, Any] = {"as it ships": figures(clip, length, network())}
    out["adapted to the gap"] = figures(clip, length, network(), OWN)
    for step in STEPS[:1] if places.smoke else STEPS:
        begun = time.perf_counter()
        own = learned_on(clip, length, step)
        cost = {COST: round(time.perf_counter() - begun, 3)}
        out[str(step)] = figures(clip, length, own) | cost
    return out


def rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """Means by length; the step is the one with the least error on windows that no figure is of."""
    for length in LENGTHS:
        own = [(int(u.split()[-1]), r) for u, r in raws.items() if u.startswith(f"{length} frames")]
        if not own:
            continue
        last = 1 if places.smoke else COUNT
        held, told = ([r for k, r in own if (k >= last) is after] for after in (True, False))
        tried = [k for k in own[0][1] if k.startswith(("1e", "3e", "0."))]
        best = min(tried, key=lambda k: mean_of(r[k][ERROR] for r in held))
        for name, key in (
            ("as it ships", "as it ships"),
            ("adapted to the gap", "adapted to the gap"),
            ("adapted to the last second", best),
        ):
            subject = f"Skeleton2Humanoid, a stream that drops out for {length} frames; {name}"
            for k in (ERROR, SLIDE):
                values = [r[key][k] for r in told]
                error = float(np.std(values, ddof=1)) / len(values) ** 0.5 if len(values) > 1 else None
                spread = "" if error is None else f"+- {error:.2g}"
                yield Figure(subject, k, mean_of(values), len(told), spread)
            yield from of(subject, {COST: median_of(r[key].get(COST) for r in told)}, len(told))


PARTS = {
    "skeleton-dropout": Part(
        "the network adapted to a stream's last second", units, measured, rows, ("inbetween",), hours=0.2
    )
}
