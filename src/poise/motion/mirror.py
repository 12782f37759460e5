"""Motion seen in a mirror: left and right exchanged, which doubles what a network can learn from."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from poise.errors import PoiseError
from poise.motion.clip import Clip
from poise.motion.noise.base import side_pairs
from poise.motion.windows import FrameBank

#: A rest pose is not upright if its sides differ in height by more than this share of their distance.
_LEVEL = 0.2


def other_sides(names: tuple[str, ...], parents: tuple[int, ...]) -> Tensor:
    """For each joint the one on the other side `(J)`, itself for those in the middle.

    Raises:
        PoiseError: no joint's name tells a side, or the sides have different hierarchies.
    """
    other = torch.arange(len(names))
    for left, right, _ in side_pairs(names):
        other[left], other[right] = right, left
    if bool((other == torch.arange(len(names))).all()):
        raise PoiseError("no joint's name tells left from right", hint="Name joints LeftArm, RightArm")
    for j, parent in enumerate(parents):
        if parent >= 0 and int(other[parent]) != parents[int(other[j])]:
            raise PoiseError(f"'{names[j]}' and '{names[int(other[j])]}' hang on different joints")
    return other


def mirrored(bank: FrameBank, suffix: str = "-mirrored") -> FrameBank:
    """The bank's clips in a mirror that stands upright between left and right at rest.

    With the mirror's unit normal n and M = 1 - 2 n n^T, positions become M p and rotations M R M, that
    is (w, v) -> (w, -M v), on the joints of the other side; bones are mirrored likewise, so that nothing
    is asked of the body's symmetry.

    Raises:
        PoiseError: sides that are not named, or a rest pose that does not stand upright.
    """
    other = other_sides(bank.names, bank.parents)
    normal = _normal(bank.names, bank.parents, bank.offsets)
    mirror = torch.eye(3, dtype=torch.float64) - 2 * torch.outer(normal, normal)
    rot = bank.rot[:, other]
    rot = torch.cat((rot[..., :1], -(rot[..., 1:] @ mirror.to(rot))), -1)
    offsets = bank.offsets[:, other] @ mirror.to(bank.offsets)
    names = tuple(f"{name}{suffix}" for name in bank.clips)
    root = bank.root @ mirror.to(bank.root)
    return replace(bank, root=root, rot=rot, offsets=offsets, clips=names)


def mirrored_clip(clip: Clip) -> Clip:
    """A clip in a mirror, on bones in a mirror; see `mirrored` for the formulas.

    The mirror stands between left and right as they lie at rest, or, in a skeleton with a rest that is
    not upright, across the y axis; another mirror only changes the way that the clip goes.

    Raises:
        PoiseError: sides that are not named.
    """
    skeleton = clip.skeleton
    other = other_sides(skeleton.names, skeleton.parents)
    offsets = torch.tensor(skeleton.offsets)
    try:
        normal = _normal(skeleton.names, skeleton.parents, offsets[None])
    except PoiseError:
        normal = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    mirror = torch.eye(3, dtype=torch.float64) - 2 * torch.outer(normal, normal)
    root, rot = clip.tensors()
    rot = torch.cat((rot[:, other, :1], -(rot[:, other, 1:] @ mirror)), -1)
    ends = tuple(
        (int(other[j]), tuple((torch.tensor(v, dtype=torch.float64) @ mirror).tolist()))
        for j, v in skeleton.ends
    )
    seen = replace(skeleton, offsets=(offsets[other] @ mirror).numpy(), ends=ends)
    contacts = tuple((int(other[j]), touch) for j, touch in clip.contacts)
    made = clip.replaced(skeleton=seen, root_pos=(root @ mirror).numpy(), rot=rot.numpy())
    return made.replaced(contacts=contacts)


def _normal(names: tuple[str, ...], parents: tuple[int, ...], offsets: Tensor) -> Tensor:
    """The level unit vector from the right to the left at rest `offsets (C, J, 3)`, float64."""
    rest = offsets.double().clone()
    rest[:, 0] = 0.0
    for j, parent in enumerate(parents):
        if parent >= 0:
            rest[:, j] += rest[:, parent]
    apart = torch.zeros(3, dtype=torch.float64)
    for left, right, _ in side_pairs(names):
        apart = apart + (rest[:, left] - rest[:, right]).mean(0)
    level = apart * torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)
    if float(level.norm()) < 1e-6 or abs(float(apart[2])) > _LEVEL * float(level.norm()):
        raise PoiseError("the skeleton's left and right do not lie level at rest, so no mirror is known")
    return level / level.norm()


def joined(a: FrameBank, b: FrameBank) -> FrameBank:
    """The clips of two banks of one hierarchy and rate, `a` first; its feet and facing count."""
    if a.names != b.names or a.parents != b.parents or a.fps != b.fps:
        raise PoiseError("two sets of frames of different skeletons or rates cannot be joined")
    both = {k: torch.cat((getattr(a, k), getattr(b, k))) for k in ("root", "rot", "offsets")}
    first = torch.cat((a.first, b.first[1:] + a.first[-1]))
    return replace(a, **both, first=first, clips=a.clips + b.clips)
