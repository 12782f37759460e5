"""Parts of a human body, told from names and from the tree of joints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from poise.body.topology import find_limbs, head_line, subtree
from poise.errors import PoiseError
from poise.motion import Clip, Skeleton
from poise.motion.role_words import name_words
from poise.motion.roles import Roles, find_roles

#: Bodies of the trunk and the neck at most; where a skeleton has more joints there, the shortest bones
#: ride on their parents, since a long chain of servos is soft.
MOST_SPINE, MOST_NECK = 5, 2


@dataclass(frozen=True)
class Part:
    """One joint's place in the body.

    Attributes:
        kind: pelvis, spine, neck, head, clavicle, upper_arm, forearm, hand, thigh, shin, foot.
        side: "left", "right" or "".
    """

    joint: int
    kind: str
    side: str = ""


@dataclass(frozen=True)
class Anatomy:
    """The parts found in a skeleton; joints that are no part ride rigidly on their nearest ancestor.

    Attributes:
        parts: depth first, as MuJoCo numbers bodies; the first is the pelvis.
        toes: first joint below each foot, by side, where there is one.
        evidence: what was told by shape instead of by name, in sentences.
    """

    parts: tuple[Part, ...]
    toes: tuple[tuple[str, int], ...]
    evidence: tuple[str, ...] = ()

    def of(self, kind: str, side: str = "") -> tuple[int, ...]:
        """Joint indices of one kind (and side)."""
        return tuple(p.joint for p in self.parts if p.kind == kind and (not side or p.side == side))

    def riders(self, skeleton: Skeleton) -> dict[int, int]:
        """Every joint without a body of its own, and the joint of the body that it rides on.

        Joints above the pelvis ride on the pelvis.
        """
        own, pelvis = {p.joint for p in self.parts}, self.parts[0].joint
        return {
            j: next((a for a in skeleton.ancestors(j) if a in own), pelvis)
            for j in range(len(skeleton))
            if j not in own
        }


def _path(skeleton: Skeleton, top: int, bottom: int) -> list[int]:
    """Joints from just below `top` down to `bottom`, inclusive."""
    line = [bottom, *skeleton.ancestors(bottom)]
    return line[: line.index(top)][::-1]


def _common(skeleton: Skeleton, a: int, b: int) -> int:
    line = {a, *skeleton.ancestors(a)}
    return next(j for j in (b, *skeleton.ancestors(b)) if j in line)


def find_anatomy(skeleton: Skeleton, clips: Sequence[Clip] = ()) -> Anatomy:
    """The body parts of a human skeleton: by its joints' names, else by its shape.

    Args:
        skeleton: any human tree.
        clips: motions of it; their first frame shows how it stands, for skeletons with names that
            say nothing and a folded rest pose.

    Raises:
        PoiseError: where a foot or a hand can be told neither by name nor by shape; an arm that
            hangs on a leg.
    """
    roles = find_roles(skeleton)
    legs, arms = _limbs(roles, ("thigh", "shin", "foot")), _limbs(roles, _ARM)
    evidence: tuple[str, ...] = ()
    pose: np.ndarray | None = None
    if len(legs) + len(arms) < 4:
        shape = find_limbs(skeleton, clips)
        if shape is None:
            raise _missing(roles, legs, arms)
        legs, arms, evidence, pose = shape.legs, shape.arms, shape.evidence, shape.pose
    pelvis = _common(skeleton, legs["left"][2], legs["right"][2])
    chest = _common(skeleton, arms["left"][2], arms["right"][2])
    # Where the hips and the spine hang side by side, the joint that carries both is the pelvis.
    pelvis = _common(skeleton, pelvis, chest)
    kinds: dict[int, tuple[str, str]] = {pelvis: ("pelvis", "")}
    spine = [j for j in _path(skeleton, pelvis, chest) if j == chest or not _helper(skeleton, j)]
    for j in _longest(skeleton, spine, MOST_SPINE):
        kinds[j] = ("spine", "")
    toes: list[tuple[str, int]] = []
    for side in _SIDES:
        for line, names in ((legs[side], ("thigh", "shin", "foot")), (arms[side], _ARM)):
            kinds |= {j: (kind, side) for j, kind in zip(line, names, strict=True)}
        above = [j for j in _path(skeleton, chest, arms[side][0])[:-1] if not _helper(skeleton, j)]
        if above:
            kinds[above[-1]] = ("clavicle", side)
        below = [c for c in skeleton.children(legs[side][2]) if not _helper(skeleton, c)]
        if below:
            # A heel bone or the like may hang beside the toes.
            named = [c for c in below if any(w in skeleton.names[c].lower() for w in ("toe", "ball"))]
            toes.append((side, (named or below)[0]))
    _check_apart(skeleton, kinds, legs, arms)
    kinds |= _neck_and_head(roles, chest, kinds, pose)
    parts = tuple(Part(j, *kinds[j]) for j in subtree(skeleton, 0) if j in kinds)
    return Anatomy(parts, tuple(toes), evidence)


_SIDES = ("left", "right")
_ARM = ("upper_arm", "forearm", "hand")
_Lines = dict[str, tuple[int, int, int]]


def _helper(skeleton: Skeleton, joint: int) -> bool:
    """Whether a joint's name says that it helps the rig or its skin: twist bones, IK targets, meshes."""
    words = name_words(skeleton.names[joint])
    # A name without a word ("bone07") says nothing.
    return words.helper and bool(words.tokens)


def _limbs(roles: Roles, kinds: tuple[str, str, str]) -> _Lines:
    """The three joints of a limb by side, for the sides on which all of them are known."""
    out: _Lines = {}
    for side in _SIDES:
        a, b, c = (roles.joint(f"{side}_{kind}") for kind in kinds)
        if a is not None and b is not None and c is not None:
            out[side] = (a, b, c)
    return out


def _check_apart(
    skeleton: Skeleton, kinds: dict[int, tuple[str, str]], legs: _Lines, arms: _Lines
) -> None:
    """Refuses a tree in which a joint of a limb is another part as well."""
    for lines, names in ((legs, ("thigh", "shin", "foot")), (arms, _ARM)):
        for side, line in lines.items():
            for j, kind in zip(line, names, strict=True):
                if kinds[j] != (kind, side):
                    other = " ".join(reversed(kinds[j])).replace("_", " ").strip()
                    own = f"{side} {kind.replace('_', ' ')}"
                    raise PoiseError(
                        f"joint '{skeleton.names[j]}' is the {own} by its name and the {other} by its "
                        "place in the tree",
                        skeleton.source.path,
                        code="role-conflict",
                    )


def _missing(roles: Roles, legs: _Lines, arms: _Lines) -> PoiseError:
    """What keeps this skeleton from being a human's."""
    skeleton = roles.skeleton
    ends = {
        f"{side} {kind}": roles.joint(f"{side}_{kind}") for kind in ("foot", "hand") for side in _SIDES
    }
    for label, joint in ends.items():
        if joint is None:
            name = "".join(word.capitalize() for word in label.split())
            return PoiseError(
                f"no {label} was found among the joints {', '.join(skeleton.names)}",
                skeleton.source.path,
                f"Name the joint '{name}' or similar",
                code="role-missing",
            )
    for what, found, end in (("leg", legs, "foot"), ("arm", arms, "hand")):
        both = [ends[f"{side} {end}"] for side in _SIDES]
        for side, joint in zip(_SIDES, both, strict=True):
            if side not in found and joint is not None:
                top = _common(skeleton, both[0] or 0, both[1] or 0)
                line = _path(skeleton, top, joint)
                return PoiseError(
                    f"the {side} {what} has {len(line)} joints "
                    f"({', '.join(skeleton.names[j] for j in line)}) and needs at least 3",
                    skeleton.source.path,
                    code="limb-too-short",
                )
    return PoiseError("the skeleton is no human's", skeleton.source.path, code="not-human")


def _longest(skeleton: Skeleton, line: Sequence[int], most: int) -> list[int]:
    """At most `most` joints of a chain: those with the shortest bones above them ride on their parents.

    The last joint stays, since limbs hang on it.
    """
    kept = list(line)
    while len(kept) > most:
        kept.remove(min(kept[:-1], key=lambda j: float(np.linalg.norm(skeleton.offsets[j]))))
    return kept


def _neck_and_head(
    roles: Roles, chest: int, kinds: dict[int, tuple[str, str]], pose: np.ndarray | None
) -> dict[int, tuple[str, str]]:
    """Necks and head above the chest: by name, else (told by shape) the highest central branch."""
    skeleton = roles.skeleton
    necks = [j for j in roles.chain("neck") if j not in kinds and chest in skeleton.ancestors(j)]
    head = roles.joint("head")
    heads = [head] if head is not None and chest in skeleton.ancestors(head) else []
    if pose is not None and not necks and not heads:
        limbs = [j for j, (kind, _) in kinds.items() if kind in _ARM]
        line = head_line(skeleton, chest, limbs, pose)
        necks, heads = line[:1], line[1:2]
    out = {j: ("neck", "") for j in _longest(skeleton, necks, MOST_NECK)}
    return out | {j: ("head", "") for j in heads}
