"""A tree of joints, and what must be remembered to write it back as it came."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from poise.errors import PoiseError, did_you_mean
from poise.motion.rotations import forward_kinematics
from poise.motion.vectors import Array, like

#: Bones that differ by less (m) are the same; files round their numbers.
SAME_M = 1e-4


@dataclass(frozen=True)
class Channel:
    """The channels of one joint as its file lists them, in the file's own frame and names.

    order: e.g. ("Xposition", "Yposition", "Zposition", "Zrotation", "Xrotation", "Yrotation")
        for BVH, ("rx", "rz") for ASF degrees of freedom.
    axis: Euler angles in radians and their order ("XYZ") of the joint's own axes relative to the
        world in the rest pose (ASF `axis`); None where the axes are the parent's.
    limits: (low, high) in radians per rotation channel, where the file states them.
    """

    order: tuple[str, ...] = ()
    axis: tuple[float, float, float] | None = None
    axis_order: str = "XYZ"
    limits: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True)
class Source:
    """Where a skeleton came from: enough to write the same hierarchy, names, order and unit.

    format: "bvh", "asf-amc", "deepmimic", or "poise" for one made in code.
    unit_m: metres in one file unit. up_axis: the file's vertical, "Y", "Z" or "X", with "-" where
    the axis points down.
    channels: one `Channel` per joint. notes: what was guessed or repaired, one sentence each.
    frame_time: seconds per frame exactly as the file states it.
    travel_joint: the joint with the channels that carry the travel (Bandai: "Hips", not the root).
    ground_m: where the floor was before it was moved to z = 0 by the user's word; None if it was not.
    evidence: ("unit", sentence) pairs, why a value is what it is: unit, up, fps.
    mended: (kind, joint, first frame, last frame, size) of what the reader had to mend: "bone drift" m,
        "quaternion length" (distance from 1), "rest frame" (frames dropped), "tremble" m of keypoints
        (with its frequency, such as "5.0333", or "" for the joint); last frame -1 is the end.
    rates: where neither the file nor the user states a frame rate, those that such files have, frames/s;
        the first was taken.
    raw: the motion is followed as it is, by the user's word or as its noise was judged: no tremble is
        taken off, and joints that were lost are not filled in.
    """

    format: str = "poise"
    path: str | None = None
    unit_m: float = 1.0
    up_axis: str = "Z"
    channels: tuple[Channel, ...] = ()
    frame_time: float | None = None
    travel_joint: str | None = None
    ground_m: float | None = None
    notes: tuple[str, ...] = ()
    evidence: tuple[tuple[str, str], ...] = ()
    mended: tuple[tuple[str, str, int, int, float], ...] = ()
    extra: tuple[tuple[str, str], ...] = ()
    rates: tuple[float, ...] = ()
    raw: bool = False


@dataclass(frozen=True)
class Skeleton:
    """Joint names, parents and rest offsets; metres, Z up, right-handed.

    names: `J` unique joint names; the root is joint 0 and parents come before children.
    parents: index of each joint's parent, -1 for the root.
    offsets: `(J, 3)` m, each joint's place in its parent's frame; with every local rotation at
        identity the skeleton stands in its rest pose in the world's axes. Row 0 is zero.
    ends: `(joint index, (x, y, z) m)` bone tips ("End Site") in the joint's frame.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    offsets: np.ndarray
    ends: tuple[tuple[int, tuple[float, float, float]], ...] = ()
    source: Source = field(default_factory=Source)

    def __post_init__(self) -> None:
        offsets = np.array(self.offsets, dtype=np.float64)
        offsets.flags.writeable = False
        object.__setattr__(self, "offsets", offsets)
        count = len(self.names)
        if len(self.parents) != count or offsets.shape != (count, 3):
            raise PoiseError(
                f"a skeleton needs one parent and one offset per joint, got {count} names, "
                f"{len(self.parents)} parents and offsets of shape {offsets.shape}",
                code="count-differs",
            )
        if count == 0:
            raise PoiseError("a skeleton needs at least one joint", code="no-joints")
        seen: set[str] = set()
        for name in self.names:
            if name in seen:
                raise PoiseError(f"joint name '{name}' appears twice", code="name-repeated")
            seen.add(name)
        for j, parent in enumerate(self.parents):
            if (j == 0) != (parent == -1) or parent >= j:
                raise PoiseError(
                    f"joint '{self.names[j]}' has parent index {parent}; the first joint must be "
                    "the only root and parents must come before children",
                    code="parent-order",
                )
        if not np.isfinite(offsets).all():
            bad = self.names[int(np.argwhere(~np.isfinite(offsets))[0][0])]
            raise PoiseError(f"joint '{bad}' has an offset that is not finite", code="not-finite")

    def __len__(self) -> int:
        return len(self.names)

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, Skeleton)
            and self.names == other.names
            and self.parents == other.parents
            and np.array_equal(self.offsets, other.offsets)
            and self.ends == other.ends
            and self.source == other.source
        )

    def __hash__(self) -> int:
        return hash((self.names, self.parents, self.offsets.tobytes()))

    @property
    def tips(self) -> tuple[tuple[int, tuple[float, float, float]], ...]:
        """The `ends` that may be a body's: files have some that are longer than any of their bones, and
        mean nothing."""
        bones = [o for o, parent in zip(self.offsets, self.parents, strict=True) if parent >= 0]
        longest = max((float(np.linalg.norm(o)) for o in bones), default=np.inf)
        return tuple((j, tip) for j, tip in self.ends if np.linalg.norm(tip) <= longest)

    def index(self, name: str) -> int:
        """The index of joint `name`; an unknown name is answered with the nearest one."""
        try:
            return self.names.index(name)
        except ValueError:
            raise PoiseError(
                f"there is no joint '{name}'. {did_you_mean(name, self.names)}", code="unknown-joint"
            ) from None

    def same_bones(self, other: Skeleton, atol: float = SAME_M) -> bool:
        """Whether the other skeleton has the same joints and bones, to within `atol` m."""
        if (self.names, self.parents) != (other.names, other.parents):
            return False
        # The root's offset is no bone.
        return bool(np.allclose(self.offsets[1:], other.offsets[1:], rtol=0.0, atol=atol))

    def children(self, joint: int) -> tuple[int, ...]:
        """Indices of the joints with the parent `joint`."""
        return self._below[joint]

    @cached_property
    def _below(self) -> tuple[tuple[int, ...], ...]:
        out: list[list[int]] = [[] for _ in self.parents]
        for j, parent in enumerate(self.parents):
            if parent >= 0:
                out[parent].append(j)
        return tuple(map(tuple, out))

    def ancestors(self, joint: int) -> tuple[int, ...]:
        """Indices of the joints above `joint`, its parent first."""
        return line_to_root(self.parents, joint)[1:]

    def forward(self, root_pos: Array, rot: Array) -> tuple[Array, Array]:
        """World positions `(..., J, 3)` m and rotations `(..., J, 4)`, see `forward_kinematics`."""
        return forward_kinematics(self.parents, like(self.offsets, rot), root_pos, rot)

    def rest_positions(self) -> np.ndarray:
        """`(J, 3)` m, joint positions with every rotation at identity and the root at the origin."""
        return rest_positions(self.parents, self.offsets)

    def with_source(self, **changes: object) -> Skeleton:
        """The same skeleton with fields of its `Source` replaced."""
        return replace(self, source=replace(self.source, **changes))  # type: ignore[arg-type]


def line_to_root(parents: Sequence[int], joint: int) -> tuple[int, ...]:
    """The joint and those above it, up to the root."""
    out = [joint]
    while parents[out[-1]] >= 0:
        out.append(parents[out[-1]])
    return tuple(out)


def rest_positions(parents: Sequence[int], offsets: np.ndarray) -> np.ndarray:
    """`(J, 3)` joint positions with every rotation at identity and the root at the origin."""
    out = np.zeros((len(parents), 3))
    for j, parent in enumerate(parents):
        if parent >= 0:
            out[j] = out[parent] + offsets[j]
    return out


def triple(v: Iterable[float]) -> tuple[float, float, float]:
    """Three numbers as plain ones."""
    x, y, z = (float(c) for c in v)
    return x, y, z
