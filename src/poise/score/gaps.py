"""In-betweening scored by the LAFAN1 protocol, on LAFAN1 or any other library under its own name."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from poise.errors import PoiseError
from poise.learn.transition import FilledGap, Known, TransitionNet
from poise.metrics import l2p, l2q, npss, physics
from poise.motion.rotations import forward_kinematics
from poise.synthesis.windows import (
    FrameBank,
    centred,
    cut,
    faced,
    step_contacts,
    train_statistics,
    window_starts,
)


@dataclass(frozen=True)
class Protocol:
    """Windows, lengths and the split of one benchmark; figures of two names never share a table.

    name: of the data, printed with every figure. past: frames that are seen. lengths: of transitions.
    test_window, test_offset: windows of 10 + 45 + 10 frames every 40. train_window, train_offset: those
    of which the deviations of L2P are taken. final, validation: regular expressions found in names of
    clips held out for the final figures and for choices; all other clips are for training.
    """

    name: str
    final: str
    validation: str | None = None
    past: int = 10
    lengths: tuple[int, ...] = (5, 15, 30, 45)
    test_window: int = 65
    test_offset: int = 40
    train_window: int = 50
    train_offset: int = 20

    def part_of(self, clip: str) -> str:
        """ "final", "validation" or "train"."""
        if re.search(self.final, clip):
            return "final"
        held = self.validation is not None and re.search(self.validation, clip)
        return "validation" if held else "train"

    def split(self, bank: FrameBank, part: str) -> FrameBank:
        """The clips of one part."""
        try:
            return bank.only(lambda name: self.part_of(name) == part)
        except PoiseError as error:
            raise PoiseError(
                f"{self.name} has no clips for '{part}': {error.what}", code=error.code
            ) from None


#: Subject 5 is the published test set; there is no validation set.
LAFAN1 = Protocol("LAFAN1", final="subject5")
#: The styles old, giant, tired (set 1) and elderly (set 2) are kept for final figures; sad and chimpira
#: (set 1) and youthful (set 2) are for choices.
BANDAI = Protocol(
    "Bandai",
    final=r"dataset-1_[^_]+_(old|giant|tired)_|dataset-2_[^_]+_elderly_",
    validation=r"dataset-1_[^_]+_(sad|chimpira)_|dataset-2_[^_]+_youthful_",
)

#: Every fifth take of each motion and style is kept for final figures, another for choices: other takes
#: of the same are learned from, as LAFAN1's protocol has other actors of the same themes.
BANDAI_TAKES = Protocol("Bandai, takes", final=r"_\d\d[05](\D|$)", validation=r"_\d\d[38](\D|$)")


class TestSet(NamedTuple):
    """Windows in the protocol's place: root `(N, W, 3)`, rot `(N, W, J, 4)`, global pos `(N, W, J, 3)`
    and quat `(N, W, J, 4)`, offsets `(N, J, 3)`, std `(J, 3)` of L2P, and what states them."""

    protocol: Protocol
    root: Tensor
    rot: Tensor
    pos: Tensor
    quat: Tensor
    offsets: Tensor
    std: Tensor
    feet: tuple[int, ...]
    parents: tuple[int, ...]
    fps: float

    def known(self, length: int, rows: slice = slice(None)) -> Known:
        """What may be seen for a transition of `length` frames: the past and one keyframe."""
        p = self.protocol.past
        root, rot = self.root[rows], self.rot[rows]
        return Known(
            root[:, :p], rot[:, :p], root[:, p + length], rot[:, p + length], self.offsets[rows]
        )

    def truth(self, length: int, rows: slice = slice(None)) -> tuple[Tensor, Tensor]:
        """Global positions and quaternions of the frames to predict."""
        p = self.protocol.past
        return self.pos[rows, p : p + length], self.quat[rows, p : p + length]


@dataclass(frozen=True)
class GapRow:
    """One method at one length: L2P, L2Q and NPSS, Skeleton2Humanoid's FP (mm), FQ, JQ, SM (mm), the
    seconds one sequence took, and how far a foot joint slides per frame where the recorded one stands
    (mm): FP and FQ say nothing where no joint's centre ever sinks below the floor."""

    length: int
    l2p: float
    l2q: float
    npss: float
    fp_mm: float
    fq: float
    jq: float
    sm_mm: float
    seconds: float = 0.0
    slide_mm: float = 0.0


def test_set(held_out: FrameBank, statistics: Tensor, protocol: Protocol) -> TestSet:
    """The protocol's test windows of the clips held out; `statistics` is the deviation `(J, 3)` m.

    Raises:
        PoiseError: no clip is long enough.
    """
    starts = window_starts(held_out.first, protocol.test_window, protocol.test_offset)
    if not len(starts):
        raise PoiseError(
            f"no clip of {protocol.name} has more than {protocol.test_window} frames",
            code="clip-too-short",
        )
    root, rot, offsets = cut(held_out, starts, protocol.test_window)
    root, rot = faced(centred(root), rot, held_out.facing, protocol.past - 1)
    pos, quat = forward_kinematics(held_out.parents, offsets, root, rot)
    return TestSet(
        protocol, root, rot, pos, quat, offsets[:, 0], statistics, held_out.feet, held_out.parents,
        held_out.fps,
    )  # fmt: skip


def deviation(train: FrameBank, protocol: Protocol) -> Tensor:
    """The deviation `(J, 3)` m that L2P divides by."""
    return train_statistics(train, protocol.train_window, protocol.train_offset, protocol.past - 1)[1]


def score(test: TestSet, filled: FilledGap, length: int, seconds: float = 0.0) -> GapRow:
    """The figures of transitions of all windows of a test set."""
    pos, quat = test.truth(length)
    mine, turned = forward_kinematics(
        test.parents, test.offsets[:, None], filled.root.to(pos), filled.rot.to(pos)
    )
    return GapRow(
        length,
        float(l2p(mine, pos, test.std)),
        float(l2q(turned, quat)),
        float(npss(turned.flatten(2), quat.flatten(2))),
        *physics(mine, test.feet, test.fps),
        seconds,
        slide(test, mine, length),
    )


def slide(test: TestSet, pos: Tensor, length: int) -> float:
    """How far feet of transitions `pos (N, length, J, 3)` m slide per frame, mm.

    Mean over foot joints and steps, those into and out of the transition too, in which the recorded
    joint stands by Harvey et al.'s rule (`synthesis.windows.step_contacts`); 0 where none stands.
    """
    feet, past = list(test.feet), test.protocol.past
    truth = test.pos[:, past - 1 : past + length + 1, feet]
    held = step_contacts(truth)[:, :-1]
    path = torch.cat((truth[:, :1], pos[:, :, feet], truth[:, -1:]), 1)
    moved = torch.diff(path[..., :2], dim=1).norm(dim=-1)
    return float(1000 * (moved * held).sum() / held.sum().clamp_min(1))


@torch.no_grad()
def predict(net: TransitionNet, test: TestSet, length: int, batch: int = 256) -> tuple[FilledGap, float]:
    """Transitions of all windows in float32 where the network has weights, and seconds a sequence."""
    begun = time.perf_counter()
    dtype = next((p.dtype for p in net.parameters()), test.root.dtype)
    parts = []
    for low in range(0, len(test.root), batch):
        known = Known(*(x.to(dtype) for x in test.known(length, slice(low, low + batch))))
        parts.append(net.fill(known, length))
    filled = FilledGap(*(torch.cat(x) for x in zip(*parts, strict=True)))
    return filled, (time.perf_counter() - begun) / len(test.root)


def evaluate(
    net: TransitionNet,
    test: TestSet,
    lengths: Sequence[int] | None = None,
    adapted: Callable[[TransitionNet, int], TransitionNet] | None = None,
) -> list[GapRow]:
    """A row per length. adapted: gives the network for a length, such as after test-time adaptation."""
    rows = []
    for n in lengths or test.protocol.lengths:
        own = net if adapted is None else adapted(net, n)
        filled, seconds = predict(own, test, n)
        rows.append(score(test, filled, n, seconds))
    return rows
