"""Which joint of one skeleton moves which joint of another."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

from poise.errors import PoiseError, did_you_mean
from poise.motion.roles import Roles, check_role, find_roles, split_role
from poise.motion.skeleton import Skeleton

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
            raise PoiseError(f"both '{ends[b]}' and '{a}' were mapped to '{b}'; one joint moves each")
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
        raise PoiseError(f"the {side} has no joint '{name}'. {did_you_mean(name, skeleton.names)}")


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
                    f"'{source.names[a]}' in the source"
                )
