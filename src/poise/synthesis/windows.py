"""Frames of many clips packed as arrays, windows cut from them, and motion seen in a mirror.

The windows follow the LAFAN1 protocol (Harvey et al., "Robust Motion In-betweening", 2020), which is
stated with Y up in centimetres. Poise keeps metres and Z up: the turn between both (x, y, z) ->
(x, -z, y) permutes coordinates and signs of positions and of the vector parts of quaternions, and keeps
X. The protocol's figures are blind to that and to the unit (differences are divided by the deviations of
the same coordinates), so that they come out as published; only the heading's local axis and the contact
thresholds are converted.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from poise.errors import PoiseError
from poise.motion.clip import Clip, resample
from poise.motion.mirror import level_normal, other_sides
from poise.motion.rotations import (
    axis_heading,
    forward_kinematics,
    normalize,
    quat_conj,
    quat_mul,
    quat_rotate,
    unwrap_quats,
)
from poise.motion.skeleton import Skeleton, triple
from poise.motion.vectors import Array, namespace

#: Harvey's contacts: squared step under 0.02 cm^2; two-stage's: sum of |dx| under 0.2 cm.
CONTACT_LIMITS = {"harvey": 2e-6, "two-stage": 2e-3}
#: The heading of LAFAN1: the root's local Y axis of the file, which is local Z in Poise's axes.
LAFAN1_FACING = (0.0, 0.0, 1.0)
_SAME_RATE = 0.01
#: How many frames are computed at once, and how many tell where a body faces.
_CHUNK, _MOST_FRAMES = 8192, 4000


@dataclass(frozen=True, eq=False)
class FrameBank:
    """All frames of clips of one hierarchy and rate, one after another; metres, Z up.

    names, parents: joints. fps: frames per second of all clips.
    root `(F, 3)`, rot `(F, J, 4)` wxyz local with signs continuous in each clip.
    offsets `(C, J, 3)`: each clip's own bones. first `(C + 1)`: where clips begin and the last ends.
    clips: names. feet: ankle and toe joints, left before right. facing: the root's local axis that,
    projected on the ground, is the heading. ends: where bones without a child end, see `Skeleton`.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    fps: float
    root: Tensor
    rot: Tensor
    offsets: Tensor
    first: Tensor
    clips: tuple[str, ...]
    feet: tuple[int, ...]
    facing: tuple[float, float, float]
    ends: tuple[tuple[int, tuple[float, float, float]], ...] = ()

    @property
    def frames(self) -> int:
        """The number of frames of all clips."""
        return len(self.root)

    def clip_of(self, frame: Tensor) -> Tensor:
        """Index of the clip to which each frame index belongs."""
        return torch.searchsorted(self.first, frame, right=True) - 1

    def positions(self) -> Tensor:
        """Global joint positions `(F, J, 3)` m."""
        parts = []
        for rows in torch.arange(self.frames).split(_CHUNK):
            offsets = self.offsets[self.clip_of(rows)]
            parts.append(forward_kinematics(self.parents, offsets, self.root[rows], self.rot[rows])[0])
        return torch.cat(parts)

    def only(self, wanted: Callable[[str], bool]) -> FrameBank:
        """The clips with wanted names, in their order.

        Raises:
            PoiseError: none is.
        """
        kept = [c for c, name in enumerate(self.clips) if wanted(name)]
        if not kept:
            raise PoiseError(
                f"none of the {len(self.clips)} clips belongs to this part of the split", code="no-clips"
            )
        first = self.first.tolist()
        rows = torch.cat([torch.arange(first[c], first[c + 1]) for c in kept])
        sizes = torch.tensor([0] + [first[c + 1] - first[c] for c in kept])
        return replace(
            self,
            root=self.root[rows],
            rot=self.rot[rows],
            offsets=self.offsets[kept],
            first=sizes.cumsum(0),
            clips=tuple(self.clips[c] for c in kept),
        )


def pack_frames(
    clips: Sequence[Clip],
    fps: float = 30.0,
    facing: tuple[float, float, float] | None = None,
) -> FrameBank:
    """Clips of one hierarchy as one bank at `fps`; a root that never turns gives way to its child.

    facing: the root's local heading axis; by default the one along which the feet point on average.

    Raises:
        PoiseError: no clips, clips of different hierarchies, or no feet that could be found by name.
    """
    if not clips:
        raise PoiseError("there are no clips to cut windows from", code="no-clips")
    clips = [without_still_root(at_rate(clip, fps)) for clip in clips]
    one = clips[0].skeleton
    for clip in clips:
        if clip.skeleton.names != one.names or clip.skeleton.parents != one.parents:
            hint = f"Its joints differ from those of '{clips[0].name}'; give clips of one hierarchy"
            raise PoiseError(
                "the clips do not share a skeleton", clip.name, hint, code="skeleton-differs"
            )
    rot = [torch.from_numpy(unwrap_quats(normalize(c.rot))) for c in clips]
    sizes = torch.tensor([0] + [c.frames for c in clips])
    bank = FrameBank(
        one.names,
        one.parents,
        float(fps),
        torch.cat([torch.tensor(c.root_pos) for c in clips]),
        torch.cat(rot),
        torch.stack([torch.tensor(c.skeleton.offsets) for c in clips]),
        sizes.cumsum(0),
        tuple(c.name for c in clips),
        foot_joints(one),
        facing or (0.0, 0.0, 0.0),
        one.ends,
    )
    return bank if facing else replace(bank, facing=facing_axis(bank))


def at_rate(clip: Clip, fps: float) -> Clip:
    """The clip at `fps`; rates that differ by less than 1 % count as the same."""
    return clip if abs(clip.fps / fps - 1) < _SAME_RATE else resample(clip, fps)


def still_root(clip: Clip) -> bool:
    """Whether the root never turns and lies in its only child (Bandai's joint_Root in its Hips)."""
    skeleton = clip.skeleton
    if skeleton.children(0) != (1,) or np.abs(skeleton.offsets[1]).max() > 1e-9:
        return False
    return bool(np.abs(clip.rot[:, 0] - (1.0, 0.0, 0.0, 0.0)).max() < 1e-9)


def without_still_root(clip: Clip) -> Clip:
    """The clip with a still root's child as its root; any other clip as it is."""
    if not still_root(clip):
        return clip
    s = clip.skeleton
    offsets = np.concatenate((np.zeros((1, 3)), s.offsets[2:]))
    parents = (-1, *(p - 1 for p in s.parents[2:]))
    ends = tuple((j - 1, tip) for j, tip in s.ends if j > 0)
    # The channels of a file belong to its own joints, so the short skeleton does not keep them.
    short = Skeleton(s.names[1:], parents, offsets, ends)
    return clip.replaced(skeleton=short, rot=clip.rot[:, 1:], contacts=())


def foot_joints(skeleton: Skeleton) -> tuple[int, ...]:
    """Ankle and toe of each leg, found by name: a toe's parent is an ankle; left before right.

    Raises:
        PoiseError: there are no such names.
    """
    low = [name.lower().rsplit(":", 1)[-1] for name in skeleton.names]
    toes = [
        j for j, name in enumerate(low)
        if "toe" in name and j > 0 and "toe" not in low[skeleton.parents[j]]
    ]  # fmt: skip
    if not toes:
        feet = [j for j, name in enumerate(low) if "foot" in name or "ankle" in name]
        feet = [j for j in feet if skeleton.parents[j] not in feet]
        pairs = [(j, next(iter(skeleton.children(j)), j)) for j in feet]
    else:
        pairs = [(skeleton.parents[j], j) for j in toes]
    if not pairs:
        hint = "Name the ankle and toe joints"
        raise PoiseError("no joint is called a toe, foot or ankle", hint=hint, code="role-missing")
    pairs.sort(key=lambda pair: (not low[pair[0]].startswith("l") and "left" not in low[pair[0]]
                                 and not low[pair[0]].endswith("_l"), pair))  # fmt: skip
    return tuple(dict.fromkeys(j for pair in pairs for j in pair))


def facing_axis(bank: FrameBank) -> tuple[float, float, float]:
    """The root's local axis along which the feet point, upright on average, of length 1.

    The mean over frames of R^-1 (toe - ankle), made orthogonal to the mean of R^-1 up.
    """
    rows = torch.arange(0, bank.frames, max(1, bank.frames // _MOST_FRAMES))
    offsets = bank.offsets[bank.clip_of(rows)]
    pos, _ = forward_kinematics(bank.parents, offsets, bank.root[rows], bank.rot[rows])
    inverse = quat_conj(bank.rot[rows, 0])
    ahead = torch.zeros_like(bank.root[rows])
    for ankle, toe in zip(bank.feet[::2], bank.feet[1::2], strict=False):
        ahead = ahead + pos[:, toe] - pos[:, ankle]
    up = normalize(quat_rotate(inverse, torch.tensor([0.0, 0, 1]).to(ahead)).mean(0))
    axis = quat_rotate(inverse, ahead).mean(0)
    axis = axis - (axis @ up) * up
    if float(axis.norm()) < 1e-6:
        axis = torch.eye(3, dtype=up.dtype)[int(up.abs().argmin())]
        axis = axis - (axis @ up) * up
    return triple(normalize(axis).tolist())


def window_starts(first: Tensor, window: int, offset: int, strict: bool = True) -> Tensor:
    """Start frames `(N)` of windows of `window` frames every `offset` frames of each clip.

    The protocol's own bound is strict, start + window < frames of the clip, so that a window never
    holds a clip's last frame. strict=False allows it.
    """
    starts = []
    for a, b in zip(first[:-1].tolist(), first[1:].tolist(), strict=True):
        last = b - a - window - (1 if strict else 0)
        if last >= 0:
            starts.append(a + torch.arange(0, last + 1, offset))
    return torch.cat(starts) if starts else torch.zeros(0, dtype=torch.long)


def cut(bank: FrameBank, starts: Tensor, window: int) -> tuple[Tensor, Tensor, Tensor]:
    """Windows: root `(N, W, 3)`, rot `(N, W, J, 4)` and the bones of each `(N, 1, J, 3)`."""
    at = starts[:, None] + torch.arange(window)
    return bank.root[at], bank.rot[at], bank.offsets[bank.clip_of(starts)][:, None]


def centred(root: Tensor) -> Tensor:
    """Root paths `(N, W, 3)` less their mean over the whole window on the ground; heights stay."""
    mean = root.mean(1, keepdim=True)
    return root - torch.cat((mean[..., :2], torch.zeros_like(mean[..., 2:])), -1)


def faced(
    root: Tensor, rot: Tensor, facing: Sequence[float] | Tensor, at: int = 9
) -> tuple[Tensor, Tensor]:
    """Windows turned about the world's Z so that the heading at frame `at` is +X."""
    axis = torch.as_tensor(facing, dtype=rot.dtype)
    back = quat_conj(axis_heading(rot[:, at, 0], axis))[:, None].expand(*rot.shape[:2], 4)
    turned = torch.cat((quat_mul(back, rot[..., 0, :]).unsqueeze(-2), rot[..., 1:, :]), -2)
    return quat_rotate(back, root), turned


def step_contacts(points: Array, rule: Literal["harvey", "two-stage"] = "harvey") -> Array:
    """Contact `(..., T, F)` bool of foot joints `(..., T, F, 3)` m at 30 fps, told from steps alone.

    harvey: |p(t+1) - p(t)|^2 < 0.02 cm^2 (4.2 cm/s). two-stage: sum of |dx| < 0.2 cm. The last frame
    repeats the one before; heights do not matter. The two disagree on purpose.
    """
    step = points[..., 1:, :, :] - points[..., :-1, :, :]
    size = (step * step).sum(-1) if rule == "harvey" else abs(step).sum(-1)
    label = size < CONTACT_LIMITS[rule]
    return namespace(label).concat((label, label[..., -1:, :]), axis=-2)


def train_statistics(
    bank: FrameBank, window: int = 50, offset: int = 20, at: int = 9, chunk: int = 512
) -> tuple[Tensor, Tensor]:
    """Mean and deviation `(J, 3)` m of global positions over all frames of the train windows."""
    starts = window_starts(bank.first, window, offset)
    if not len(starts):
        raise PoiseError(
            f"no clip has more than {window} frames, so there are no train statistics",
            code="clip-too-short",
        )
    total = square = torch.zeros(len(bank.names), 3, dtype=torch.float64)
    for part in starts.split(chunk):
        root, rot, offsets = cut(bank, part, window)
        root, rot = faced(centred(root), rot, bank.facing, at)
        pos, _ = forward_kinematics(bank.parents, offsets, root, rot)
        total = total + pos.sum((0, 1))
        square = square + pos.square().sum((0, 1))
    count = len(starts) * window
    mean = total / count
    return mean, (square / count - mean.square()).clamp_min(0).sqrt()


def mirrored(bank: FrameBank, suffix: str = "-mirrored") -> FrameBank:
    """The bank's clips in a mirror that stands upright between left and right at rest.

    With the mirror's unit normal n and M = 1 - 2 n n^T, positions become M p and rotations M R M, that
    is (w, v) -> (w, -M v), on the joints of the other side; bones are mirrored likewise, so that nothing
    is asked of the body's symmetry.

    Raises:
        PoiseError: sides that are not named, or a rest pose that does not stand upright.
    """
    other = other_sides(bank.names, bank.parents)
    normal = torch.from_numpy(level_normal(bank.names, bank.parents, bank.offsets.numpy()))
    mirror = torch.eye(3, dtype=torch.float64) - 2 * torch.outer(normal, normal)
    rot = bank.rot[:, other]
    rot = torch.cat((rot[..., :1], -(rot[..., 1:] @ mirror.to(rot))), -1)
    offsets = bank.offsets[:, other] @ mirror.to(bank.offsets)
    names = tuple(f"{name}{suffix}" for name in bank.clips)
    root = bank.root @ mirror.to(bank.root)
    return replace(bank, root=root, rot=rot, offsets=offsets, clips=names)


def joined(a: FrameBank, b: FrameBank) -> FrameBank:
    """The clips of two banks of one hierarchy and rate, `a` first; its feet and facing count."""
    if a.names != b.names or a.parents != b.parents or a.fps != b.fps:
        raise PoiseError(
            "two sets of frames of different skeletons or rates cannot be joined",
            code="skeleton-differs",
        )
    both = {k: torch.cat((getattr(a, k), getattr(b, k))) for k in ("root", "rot", "offsets")}
    first = torch.cat((a.first, b.first[1:] + a.first[-1]))
    return replace(a, **both, first=first, clips=a.clips + b.clips)
