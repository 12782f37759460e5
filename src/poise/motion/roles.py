"""Joints by the part of a human body that they play, from names and tree; joints that move others."""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from poise.errors import PoiseError, did_you_mean
from poise.motion.role_words import FINGERS, convention_of, name_words, without_rig
from poise.motion.skeleton import Skeleton, line_to_root

SIDES = ("left", "right")
LEG = ("thigh", "shin", "foot", "toes")
ARM = ("clavicle", "upper_arm", "forearm", "hand")
#: Without these no body walks.
NEEDED = ("hips", *(f"{side}_{kind}" for kind in LEG[:3] for side in SIDES))
#: Parts that a limb may lack weigh less than those that it needs, where names can be read either way.
_WEIGHT = {"clavicle": 0.5, "toes": 0.5}
#: How sure a part is that only its place between others tells, and what stated ones weigh against names.
BY_PLACE, _STATED = 0.4, 10.0
_MANY = ("spine", "neck")
_FINGER_KINDS = tuple(dict.fromkeys(FINGERS.values()))


@dataclass(frozen=True)
class Role:
    """One joint's part.

    role: "hips", "spine1", ..., "neck1", ..., "head", or with a side: "left_clavicle", "left_upper_arm",
    "left_forearm", "left_hand", "left_thigh", "left_shin", "left_foot", "left_toes", "left_index1", ...
    joint: its index. confidence: 1 where name and place agree, less where one must be preferred.
    evidence: why, in a sentence.
    """

    role: str
    joint: int
    confidence: float
    evidence: str

    @property
    def side(self) -> str:
        """ "left", "right" or ""."""
        return split_role(self.role)[0]

    @property
    def kind(self) -> str:
        """The role without side and number."""
        return split_role(self.role)[1]


@dataclass(frozen=True)
class Roles:
    """The parts of one skeleton.

    rows: pelvis and trunk first, then limbs. convention: the origin of the names, "" where unknown.
    """

    skeleton: Skeleton
    rows: tuple[Role, ...]
    convention: str
    evidence: str

    def joint(self, role: str) -> int | None:
        """The joint that plays `role`, None where none does."""
        return next((r.joint for r in self.rows if r.role == role), None)

    def role(self, joint: int) -> str | None:
        """What `joint` plays, None for a helper."""
        return next((r.role for r in self.rows if r.joint == joint), None)

    def chain(self, kind: str) -> tuple[int, ...]:
        """The joints of "spine" or "neck", from below."""
        return tuple(r.joint for r in self.rows if r.kind == kind)

    def missing(self, needed: tuple[str, ...] = NEEDED) -> tuple[str, ...]:
        """Those of `needed` that no joint plays."""
        have = {r.role for r in self.rows}
        return tuple(role for role in needed if role not in have)

    def require(self, needed: tuple[str, ...] = NEEDED) -> None:
        """Raises a PoiseError that names what is missing, what was found and how to state the rest."""
        lost = self.missing(needed)
        if not lost:
            return
        found = ", ".join(f"{r.role}={self.skeleton.names[r.joint]}" for r in self.rows[:12]) or "none"
        raise PoiseError(
            f"no joint was found for {', '.join(lost)}; found {found}; "
            f"joints {', '.join(self.skeleton.names[:30])}{', ...' if len(self.skeleton) > 30 else ''}",
            self.skeleton.source.path,
            f"State it by hand, for example --map JOINT={lost[0]}",
            code="role-missing",
        )


def split_role(role: str) -> tuple[str, str]:
    """Side and kind of a role: "left_upper_arm" is ("left", "upper_arm"), "spine2" ("", "spine")."""
    side = next((s for s in SIDES if role.startswith(f"{s}_")), "")
    return side, role.removeprefix(f"{side}_").rstrip("0123456789")


def check_role(role: str) -> str:
    """`role` itself if it is one."""
    side, kind = split_role(role)
    sided = kind in (*LEG, *ARM, *_FINGER_KINDS)
    numbered = role[-1:].isdigit()
    if (kind in ("hips", "head") and not side and not numbered) or (kind in _MANY and not side):
        return role
    if sided and side and numbered == (kind in _FINGER_KINDS):
        return role
    known = ("hips", "spine1", "neck1", "head", *(f"{s}_{k}" for k in (*ARM, *LEG) for s in SIDES))
    raise PoiseError(f"there is no role '{role}'. {did_you_mean(role, known)}", code="unknown-role")


def find_roles(skeleton: Skeleton, stated: Mapping[str, str] | None = None) -> Roles:
    """The parts that the joints of a human skeleton play.

    Names say most; of names that can be read in several ways ("LeftShoulder" is a clavicle for Mixamo
    and an upper arm for Xsens) the reading is taken that makes most of the whole limb. What carries both
    legs is the pelvis, what lies between it and the arms the spine. A file that states the parts of its
    joints, as VRM does, is believed.

    Args:
        stated: roles known beforehand, by joint name; they overrule all guesses, and the file.

    Returns:
        all roles that were found; a skeleton may lack any of them (see `Roles.require`).

    Raises:
        PoiseError: a stated joint or role that does not exist.
    """
    return _found_roles(skeleton, tuple((stated or {}).items()))


@lru_cache(maxsize=8)
def _found_roles(skeleton: Skeleton, stated: tuple[tuple[str, str], ...]) -> Roles:
    """One skeleton is asked for its parts again and again: those of the last few are kept."""
    fixed = {skeleton.index(name): check_role(role) for name, role in stated}
    taken: dict[str, str] = {}
    for joint, role in fixed.items():
        if role in taken:
            raise PoiseError(
                f"both '{taken[role]}' and '{skeleton.names[joint]}' were stated to be {role}",
                code="role-conflict",
            )
        taken[role] = skeleton.names[joint]
    written = {
        joint: role
        for joint, role in _written(skeleton).items()
        if joint not in fixed and role not in taken
    }
    finder = _Finder(skeleton, fixed, written)
    finder.find()
    maker, count = convention_of(skeleton.names)
    evidence = f"{count} of {len(skeleton)} joints bear the names of {maker}" if maker else ""
    return Roles(
        skeleton, finder.rows(), maker, evidence or "the names follow no convention that is known"
    )


def _written(skeleton: Skeleton) -> dict[int, str]:
    """Roles that the file states, by joint; such of joints that are gone are left out."""
    text = dict(skeleton.source.extra).get("roles")
    stated: dict[str, str] = json.loads(text) if text else {}
    at = {name: j for j, name in enumerate(skeleton.names)}
    return {at[name]: role for name, role in stated.items() if name in at}


#: A score, and (kind of part, joint) pairs.
_Reading = tuple[float, tuple[tuple[str, int], ...]]


class _Finder:
    """Collects roles; limbs first, since what they hang on tells pelvis and chest."""

    def __init__(self, skeleton: Skeleton, said: Mapping[int, str], written: Mapping[int, str]) -> None:
        self.skeleton, self.said, self.fixed = skeleton, said, {**written, **said}
        self.words = [name_words(name) for name in without_rig(skeleton.names)]
        self.lengths = np.linalg.norm(skeleton.offsets, axis=-1)
        self.found: dict[str, Role] = {}
        self.lines = [self._line(j) for j in range(len(skeleton)) if not skeleton.children(j)]

    def find(self) -> None:
        for joint, role in self.fixed.items():
            why = "you said so" if joint in self.said else "the file's VRM bones say so"
            self._add(role, joint, 1.0, why)
        limbs = {(side, kinds): self._limb(side, kinds) for side in SIDES for kinds in (LEG, ARM)}
        for (side, _), limb in limbs.items():
            for kind, joint in limb.items():
                self._named(f"{side}_{kind}", joint)
        hips = self._carrier("foot", "thigh")
        chest = self._carrier("hand", "upper_arm")
        if hips is not None and chest is not None:
            # Where the hips and the spine hang side by side, the joint that carries both is the pelvis.
            hips = self._common(hips, chest)
        hips = next((j for j, role in self.fixed.items() if role == "hips"), hips)
        if hips is None:
            hips = next((j for j, w in enumerate(self.words) if w.score("hips") and not w.side), None)
        if hips is None:
            return
        self._hips(hips, chest)
        for side in SIDES:
            self._fill(side, LEG[:3], hips)
            if chest is not None:
                self._fill(side, ARM[1:], chest)
                self._clavicle(side, chest)
            self._fingers(side)
        self._trunk(hips, hips if chest is None else chest)

    def rows(self) -> tuple[Role, ...]:
        kinds = ("hips", "spine", "neck", "head", *ARM, *_FINGER_KINDS, *LEG)

        def place(row: Role) -> tuple[int, int, str]:
            return SIDES.index(row.side) if row.side else -1, kinds.index(row.kind), row.role

        return tuple(sorted(self.found.values(), key=place))

    def _add(self, role: str, joint: int, confidence: float, evidence: str) -> None:
        if role not in self.found and joint not in {r.joint for r in self.found.values()}:
            self.found[role] = Role(role, joint, confidence, evidence)

    def _named(self, role: str, joint: int) -> None:
        """Adds a role that a joint's name says, or may say."""
        score = self.words[joint].score(split_role(role)[1])
        name = self.skeleton.names[joint]
        if score >= 0.85:
            self._add(role, joint, 1.0, f"the name '{name}' says so")
        else:
            self._add(role, joint, 0.8, f"of the readings of '{name}' it fits the joints around it")

    def _line(self, joint: int) -> list[int]:
        """Joints from the root down to `joint`."""
        return [*line_to_root(self.skeleton.parents, joint)[::-1]]

    def _common(self, a: int, b: int) -> int:
        """The lowest joint that carries both (or is one of them)."""
        line = set(self._line(a))
        return next(j for j in reversed(self._line(b)) if j in line)

    def _score(self, joint: int, side: str, kind: str) -> float:
        stated = self.fixed.get(joint)
        role = f"{side}_{kind}"
        if stated is not None or role in self.fixed.values():
            return _STATED * float(stated == role)
        word = self.words[joint]
        return word.score(kind) * _WEIGHT.get(kind, 1.0) if word.side == side else 0.0

    def _limb(self, side: str, kinds: tuple[str, ...]) -> dict[str, int]:
        """The best reading of one limb: kinds in order along one line from the root to a leaf."""
        best: tuple[float, dict[str, int]] = (0.0, {})
        scores = [[self._score(j, side, kind) for kind in kinds] for j in range(len(self.skeleton))]
        for line in self.lines:
            score, reading = self._read(line, kinds, scores)
            if score > best[0] + 1e-9:
                best = (score, reading)
        return best[1]

    def _read(
        self, line: list[int], kinds: tuple[str, ...], scores: list[list[float]]
    ) -> tuple[float, dict[str, int]]:
        # The best reading of the rest of the line, by the kind from which on it is read; leaf first.
        below: list[_Reading] = [(0.0, ())] * (len(kinds) + 1)
        for joint in reversed(line):
            here: list[_Reading] = [(0.0, ())] * (len(kinds) + 1)
            for k in reversed(range(len(kinds))):
                # Nearer the root wins among equals: of wrist and hand the wrist is the joint.
                options = [here[k + 1], below[k]]
                own = scores[joint][k]
                if own > 0:
                    more, rest = below[k + 1]
                    options.insert(0, (own + more, ((kinds[k], joint), *rest)))
                here[k] = max(options, key=lambda option: option[0])
            below = here
        score, reading = below[0]
        return score, dict(reading)

    def _carrier(self, *kinds: str) -> int | None:
        """The lowest joint that carries a part of both sides, by the first of `kinds` that both have."""
        for kind in kinds:
            pair = [self.found.get(f"{side}_{kind}") for side in SIDES]
            if pair[0] is not None and pair[1] is not None:
                common = self._common(pair[0].joint, pair[1].joint)
                return common
        return None

    def _hips(self, joint: int, chest: int | None) -> None:
        name = self.skeleton.names[joint]
        if self.words[joint].score("hips") >= 0.6:
            self._add("hips", joint, 1.0, f"'{name}' carries both legs, and its name says so")
        else:
            what = "both legs and the spine" if chest is not None else "both legs"
            self._add("hips", joint, 0.7, f"'{name}' carries {what}")

    def _fill(self, side: str, kinds: tuple[str, ...], top: int) -> None:
        """Parts that no name says, by their place above the limb's end."""
        end = self.found.get(f"{side}_{kinds[2]}")
        if end is None:
            return
        below = end.joint
        for kind in (kinds[1], kinds[0]):
            known = self.found.get(f"{side}_{kind}")
            if known is None:
                joint = self._above(below, top)
                if joint is None:
                    return
                name = self.skeleton.names[joint]
                evidence = f"'{name}' lies above the {split_role(self._role_at(below))[1]}"
                self._add(f"{side}_{kind}", joint, BY_PLACE, evidence.replace("_", " "))
                known = self.found[f"{side}_{kind}"]
            below = known.joint

    def _role_at(self, joint: int) -> str:
        return next((r.role for r in self.found.values() if r.joint == joint), "")

    def _above(self, joint: int, top: int) -> int | None:
        """The next joint between `joint` and `top` that could be a part: a bone away, no helper."""
        length = self.lengths[joint]
        j = self.skeleton.parents[joint]
        while j not in (top, -1):
            if length > 1e-6 and not self.words[j].helper and not self._role_at(j):
                return j
            if self._role_at(j):
                return None
            length += self.lengths[j]
            j = self.skeleton.parents[j]
        return None

    def _clavicle(self, side: str, chest: int) -> None:
        arm = self.found.get(f"{side}_upper_arm")
        if arm is None or f"{side}_clavicle" in self.found:
            return
        joint = self._above(arm.joint, chest)
        if joint is not None:
            name = self.skeleton.names[joint]
            self._add(f"{side}_clavicle", joint, BY_PLACE, f"'{name}' lies between chest and arm")

    def _fingers(self, side: str) -> None:
        hand = self.found.get(f"{side}_hand")
        if hand is None:
            return
        count: dict[str, int] = {}
        for j in range(hand.joint + 1, len(self.skeleton)):
            finger = self.words[j].finger
            if finger and hand.joint in self._line(j):
                # A joint between palm and finger is its number 0, so that knuckles keep theirs.
                palm = re.search(r"metacarpal|inhand|meta", self.words[j].core) and finger != "thumb"
                number = count[finger] = 0 if palm else count.get(finger, 0) + 1
                self._add(f"{side}_{finger}{number}", j, 1.0, "the name says so, below the hand")

    def _trunk(self, hips: int, chest: int) -> None:
        """Spine between pelvis and chest; above it neck and head."""
        spine = [j for j in self._line(chest) if hips in self._line(j)[:-1]]
        top = self._head(chest)
        for j in self._line(top)[len(self._line(chest)) :] if top is not None else []:
            word = self.words[j]
            if word.score("spine") > word.score("neck"):
                # Arms that hang on a lower joint of the spine.
                spine.append(j)
            elif j != top or not word.score("head"):
                self._many("neck", j, "it lies between chest and head")
        for j in spine:
            self._many("spine", j, "it lies between pelvis and chest")
        if top is not None and self.words[top].score("head"):
            self._named("head", top)

    def _head(self, chest: int) -> int | None:
        """The joint nearest the chest that its name tells to be the head, else the topmost neck."""
        above = [
            j
            for j, w in enumerate(self.words)
            if not w.side and not w.helper and chest in self._line(j)[:-1]
        ]
        heads = [j for j, role in self.fixed.items() if role == "head"]
        heads += [j for j in above if self.words[j].score("head")]
        necks = [j for j in above if self.words[j].score("neck")]
        return heads[0] if heads else necks[-1] if necks else None

    def _many(self, kind: str, joint: int, place: str) -> None:
        if self.words[joint].helper or joint in self.fixed:
            return
        number = 1 + sum(1 for r in self.found if split_role(r)[1] == kind)
        name = self.skeleton.names[joint]
        if self.words[joint].score(kind):
            self._add(f"{kind}{number}", joint, 1.0, f"the name '{name}' says so, and {place}")
        else:
            self._add(f"{kind}{number}", joint, 0.7, f"{place}: '{name}'")


#: Chains that may differ in their number of joints; their rotation is shared out along them.
SHARED = ("spine", "neck", "head")


@dataclass(frozen=True)
class MappedJoint:
    """One joint of the target and what moves it.

    role: its part, "" for a joint of another kind that bears the same name in both skeletons.
    source: the joints that it follows; none where it keeps still, several where a chain is shared out.
    """

    role: str
    source: tuple[int, ...]
    target: int
    confidence: float
    evidence: str


@dataclass(frozen=True)
class JointMap:
    """How one skeleton drives another.

    direct: `(source joint, target joint)` pairs with world rotations that correspond.
    """

    source: Roles
    target: Roles
    rows: tuple[MappedJoint, ...]
    direct: tuple[tuple[int, int], ...]

    def limb_pair(self, role: str) -> tuple[int, int] | None:
        """Source and target joint of a role, None where either lacks it."""
        pair = self.source.joint(role), self.target.joint(role)
        return None if pair[0] is None or pair[1] is None else (pair[0], pair[1])

    def without(self, roles: Collection[str]) -> JointMap:
        """The map with target joints of some roles that nothing moves."""
        out = {j for j in map(self.target.joint, roles) if j is not None}
        rows = tuple(r for r in self.rows if r.target not in out)
        return replace(self, rows=rows, direct=tuple(p for p in self.direct if p[1] not in out))

    def unused(self) -> tuple[str, ...]:
        """Source joints with a part of their own that moves nothing in the target."""
        used = {j for row in self.rows for j in row.source}
        return tuple(
            self.source.skeleton.names[r.joint] for r in self.source.rows if r.joint not in used
        )

    def still(self) -> tuple[str, ...]:
        """Target joints with a part of their own that nothing moves."""
        moved = {row.target for row in self.rows if row.source}
        return tuple(
            self.target.skeleton.names[r.joint] for r in self.target.rows if r.joint not in moved
        )


def map_joints(source: Skeleton, target: Skeleton, stated: Mapping[str, str] | None = None) -> JointMap:
    """The joints of `target` by the joints of `source` that move them.

    Args:
        stated: joints of the source by name with the target joint that each moves. Either may also be a
            role ("left_thigh"), which says what the other one is.

    Raises:
        PoiseError: an unknown joint or role (the nearest is named), a target joint that is stated twice,
            a mapping that turns the hierarchy round, no pelvis or no legs in either skeleton.
    """
    fixed_source, fixed_target, extra = _stated(source, target, stated or {})
    roles = find_roles(source, fixed_source), find_roles(target, fixed_target)
    for found in roles:
        found.require()
    direct = dict(_direct(*roles))
    direct.update({b: a for a, b in extra})
    if (source.names, source.parents) == (target.names, target.parents) and not stated:
        direct = {j: j for j in range(len(target))}
    _check_order(source, target, direct)
    rows = [_row(j, direct, *roles) for j in range(len(target))]
    kept = tuple(r for r in rows if r is not None)
    return JointMap(*roles, kept, tuple((a, b) for b, a in direct.items()))


def _stated(
    source: Skeleton, target: Skeleton, stated: Mapping[str, str]
) -> tuple[dict[str, str], dict[str, str], list[tuple[int, int]]]:
    """Roles that the user's pairs fix in both skeletons, and pairs that bear no role."""
    in_source: dict[str, str] = {}
    in_target: dict[str, str] = {}
    extra: list[tuple[int, int]] = []
    ends: dict[str, str] = {}
    if not stated:
        return in_source, in_target, extra
    guessed_source, guessed_target = find_roles(source), find_roles(target)
    for a, b in stated.items():
        if b in ends and b in target.names:
            raise PoiseError(
                f"both '{ends[b]}' and '{a}' were mapped to '{b}'; one joint moves each",
                code="joint-mapped-twice",
            )
        ends[b] = a
        if a not in source.names and _is_role(a):
            _known(target, b, "target")
            in_target[b] = a
            continue
        _known(source, a, "source")
        if b not in target.names and _is_role(b):
            in_source[a] = b
            continue
        _known(target, b, "target")
        pair = source.index(a), target.index(b)
        role = guessed_source.role(pair[0]) or guessed_target.role(pair[1])
        if role is None or split_role(role)[1] in SHARED:
            extra.append(pair)
        else:
            in_source[a] = in_target[b] = role
    return in_source, in_target, extra


def _is_role(text: str) -> bool:
    try:
        return bool(check_role(text))
    except PoiseError:
        return False


def _known(skeleton: Skeleton, name: str, side: str) -> None:
    if name not in skeleton.names:
        raise PoiseError(
            f"the {side} has no joint '{name}'. {did_you_mean(name, skeleton.names)}",
            code="unknown-joint",
        )


def _direct(source: Roles, target: Roles) -> list[tuple[int, int]]:
    """(target, source) joints that play the same part, or none and bear the same name."""
    pairs = []
    for row in target.rows:
        joint = source.joint(row.role)
        if joint is not None and row.kind not in SHARED:
            pairs.append((row.joint, joint))
    for j, name in enumerate(target.skeleton.names):
        if target.role(j) is None and name in source.skeleton.names:
            other = source.skeleton.index(name)
            if source.role(other) is None:
                pairs.append((j, other))
    return pairs


def _row(j: int, direct: Mapping[int, int], source: Roles, target: Roles) -> MappedJoint | None:
    role = next((r for r in target.rows if r.joint == j), None)
    if j in direct:
        other = next((r for r in source.rows if r.joint == direct[j]), None)
        if role is None:
            return MappedJoint("", (direct[j],), j, 1.0, "the same name in both, or stated")
        if other is None:
            return MappedJoint(role.role, (direct[j],), j, 1.0, "you said so")
        weaker = min(other, role, key=lambda r: r.confidence)
        return MappedJoint(role.role, (direct[j],), j, weaker.confidence, weaker.evidence)
    if role is None:
        return None
    if role.kind not in SHARED:
        return MappedJoint(role.role, (), j, 1.0, "the source has none; it keeps its rest pose")
    if role.kind == "spine":
        ends = source.chain("spine") or tuple(x for x in (source.joint("hips"),) if x is not None)
    else:
        ends = source.chain("neck") + source.chain("head")
    words = {0: "the source has none; it follows what carries it", 1: "it follows the only one"}
    share = words.get(len(ends), f"shared out along {len(ends)} joints")
    return MappedJoint(role.role, ends, j, role.confidence, share)


def _check_order(source: Skeleton, target: Skeleton, direct: Mapping[int, int]) -> None:
    """Refuses pairs that turn the hierarchy round."""

    for b, a in direct.items():
        for b_up in direct.keys() & set(target.ancestors(b)):
            a_up = direct[b_up]
            if a in source.ancestors(a_up) or a == a_up:
                raise PoiseError(
                    f"the mapping turns the hierarchy round: '{target.names[b_up]}' carries "
                    f"'{target.names[b]}' in the target, but their '{source.names[a_up]}' hangs below "
                    f"'{source.names[a]}' in the source",
                    code="hierarchy-reversed",
                )
