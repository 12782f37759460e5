"""The nodes of a glTF file that are joints of one body: of its skins, of its animation, of VRM."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, cast

from poise.errors import PoiseError
from poise.formats.gltf_file import GltfFile, index_of
from poise.formats.gltf_tracks import Tree
from poise.formats.text import MAX_JOINTS, listed, others_note, shown
from poise.motion.clip_info import landmarks

#: A skin of fewer joints that hangs on no other, such as a sword's, is no second body to be named.
_BODY_JOINTS = 8
#: A part is compared with so many bodies. Numbered parts of so many joints each are two people.
_PARTS, _WHOLE = 8, 15


def choose_joints(
    tree: Tree, file: GltfFile, targeted: set[int], moving: set[int], notes: list[str]
) -> list[int]:
    """The nodes that become joints, parents first.

    They are the joints of the body with the skins that the animation moves most, see `_bodies`, and
    what is animated below them; without a skin, the animated nodes and what hangs on them. Nodes between
    joints and moving nodes above them belong to the joints. Of several people one is taken, and the
    others are named. Without any animation it is the largest body, or else the largest tree.

    Args:
        targeted: nodes with translation or rotation channels.
        moving: those with channels that vary.
    """
    skin = _skin_joints(tree, file, targeted, notes)
    bare = set(targeted) or {n for n in range(len(tree.names)) if not tree.solid[n]}
    if not skin and not bare:
        raise PoiseError(
            "the file holds no joints", file.path, "Export its skeleton too", code="no-joints"
        )
    wanted = set(skin) if skin else _biggest_tree(tree, bare)
    if not skin and wanted != bare:
        others = sorted(tree.names[n] for n in bare - wanted)
        notes.append(
            f"{len(others)} animated nodes outside the figure were left out, such as '{others[0]}'"
        )
    if len(wanted) > MAX_JOINTS:
        raise PoiseError(
            f"it has {len(wanted)} joints, more than the {MAX_JOINTS} allowed",
            file.path,
            code="too-many-joints",
        )
    best = _biggest_tree(tree, wanted)
    if best != wanted:
        notes.append(f"{len(wanted - best)} joints that hang on no common node were left out")
    best = _one_person(tree, best, targeted, notes)
    best |= _moving_above(tree, best, moving)
    joints, root = _connected(tree, best)
    joints |= _animated_below(tree, joints, root, targeted) if skin else _hanging_on(tree, joints)
    if len(joints) > MAX_JOINTS:
        raise PoiseError(
            f"it has {len(joints)} joints, more than the {MAX_JOINTS} allowed",
            file.path,
            code="too-many-joints",
        )
    order = [j for j in skin if j in joints]
    if len(order) == len(joints) and _parents_first(tree, order, root):
        return order
    return [node for node in tree.below(root) if node in joints]


def _connected(tree: Tree, nodes: Iterable[int]) -> tuple[set[int], int]:
    """The nodes with all between them, and the node on which all of them hang."""
    lowest, depth = list(nodes), _depths(tree)
    out = set(lowest)
    # The deepest of the tops gives way to its parent until one top is left.
    tops = {n for n in out if tree.parents[n] not in out}
    by_depth: dict[int, set[int]] = {}
    for top in tops:
        by_depth.setdefault(depth[top], set()).add(top)
    level = max(by_depth)
    while level > min(by_depth) or len(by_depth[level]) > 1:
        for top in by_depth.pop(level, ()):
            up = tree.parents[top]
            if up not in out:
                out.add(up)
                by_depth.setdefault(level - 1, set()).add(up)
        level -= 1
        by_depth.setdefault(level, set())
    return out, next(iter(by_depth[level]))


def _depths(tree: Tree) -> list[int]:
    out, todo = [0] * len(tree.names), [n for n, p in enumerate(tree.parents) if p < 0]
    for node in todo:
        for child in tree.children[node]:
            out[child] = out[node] + 1
        todo += tree.children[node]
    return out


def _moving_above(tree: Tree, nodes: set[int], moving: set[int]) -> set[int]:
    """The outermost node that moves above any of the nodes, of each of their lines."""
    first: dict[int, int] = {}
    todo = [n for n, p in enumerate(tree.parents) if p < 0]
    for node in todo:
        above = first.get(tree.parents[node], -1)
        first[node] = above if above >= 0 else node if node in moving else -1
        todo += tree.children[node]
    return {first[n] for n in nodes if first[n] >= 0}


def _skin_joints(tree: Tree, file: GltfFile, targeted: set[int], notes: list[str]) -> list[int]:
    """The joints of the body that is animated most, of its skins in their order."""
    skins: list[list[int]] = []
    for i, skin in enumerate(file.doc["skins"]):
        joints = skin.get("joints", [])
        if not isinstance(joints, list):
            raise PoiseError(f"the joints of skin {i} are no list", file.path, code="not-a-list")
        found = [index_of(j, tree.names, f"a joint of skin {i}", file) for j in joints]
        skins.append(list(dict.fromkeys(found)))
    bodies = _bodies(tree, file, [s for s in skins if s], targeted)
    if not bodies:
        return []
    best = max(bodies, key=lambda body: (len(targeted & set(body)), len(body)))
    if targeted and not targeted & set(best):
        return []
    rest = [b for b in bodies if b is not best]
    others = [(tree.names[b[0]], len(b)) for b in rest if len(b) >= _BODY_JOINTS]
    if others:
        notes.append(others_note(tree.names[best[0]], len(best), others))
    things = [tree.names[j] for b in rest if len(b) < _BODY_JOINTS for j in b if j in targeted]
    if things:
        notes.append(f"Joints of other skins, {listed(map(shown, things), 3)}, were left out")
    return best


def _bodies(tree: Tree, file: GltfFile, skins: list[list[int]], targeted: set[int]) -> list[list[int]]:
    """The skins' joints, put together where skins belong to one body.

    They do where they share joints, where the joints of one hang on those of the other, and where both
    hang on one node that moves or is the parent of both, unless each has a head or feet of its own.
    """
    group = list(range(len(skins)))

    def top(i: int) -> int:
        while group[i] != i:
            group[i] = group[group[i]]
            i = group[i]
        return i

    owner: dict[int, int] = {}
    for i, joints in enumerate(skins):
        for j in joints:
            group[top(i)] = top(owner.setdefault(j, i))
    # The nearest joint above each node, from the roots down.
    above: dict[int, int] = {}
    todo = [n for n, p in enumerate(tree.parents) if p < 0]
    for node in todo:
        up = tree.parents[node]
        above[node] = up if up in owner else above.get(up, -1)
        todo += tree.children[node]
    for j, i in owner.items():
        if above[j] >= 0:
            group[top(i)] = top(owner[above[j]])
    parts: dict[int, list[int]] = {}
    for i, joints in enumerate(skins):
        parts.setdefault(top(i), []).extend(joints)
    # Each part hangs on one node; the parts of one node are tried one by one, the largest first.
    merged: list[list[int]] = []
    for part in sorted(parts.values(), key=len, reverse=True):
        joints = list(dict.fromkeys(part))
        host = next((m for m in merged[:_PARTS] if _one_body(tree, m, joints, targeted)), None)
        if host is None:
            merged.append(joints)
        else:
            host += joints
    first = {j: k for k, j in enumerate(j for joints in skins for j in joints)}
    return sorted(merged, key=lambda body: min(first[j] for j in body))


def _one_body(tree: Tree, a: list[int], b: list[int], targeted: set[int]) -> bool:
    """Whether parts that share no joint are of one body."""
    if tree.tops[a[0]] != tree.tops[b[0]]:
        return False
    names = [[tree.names[j] for j in part] for part in (a, b)]
    (head_a, feet_a), (head_b, feet_b) = (_marks(n) for n in names)
    if (head_a and head_b) or (feet_a and feet_b) or _alike(*names):
        return False
    (_, root_a), (_, root_b) = _connected(tree, a), _connected(tree, b)
    common = _connected(tree, (root_a, root_b))[1]
    beside = tree.parents[root_a] == tree.parents[root_b] or common in (root_a, root_b)
    return beside or common in targeted or (head_a and feet_b) or (feet_a and head_b)


def _marks(names: Sequence[str]) -> tuple[bool, bool]:
    """Whether names tell a head, and whether they tell two ankles or feet."""
    heads, _, ankles = landmarks(names)
    return bool(heads), len(ankles) > 1


def _alike(a: Sequence[str], b: Sequence[str]) -> bool:
    """Whether two parts have the same names but for the numbers that exporters add."""
    plain = [{re.sub(r"[._ ]?\d+$", "", n.lower()) for n in names} for names in (a, b)]
    if min(map(len, plain)) < 3:
        # Numbers alone: two bodies are of one size.
        small, large = sorted((len(a), len(b)))
        return small >= _WHOLE and 5 * small > 4 * large
    return 2 * len(plain[0] & plain[1]) > min(map(len, plain))


def _one_person(tree: Tree, nodes: set[int], targeted: set[int], notes: list[str]) -> set[int]:
    """The nodes of one person, where several hang on a node that is no joint itself.

    A person has a head and feet, by name, of their own.
    """
    while True:
        root = _connected(tree, nodes)[1]
        if root in nodes:
            return nodes
        branch = {c: {n for n in tree.below(c) if n in nodes} for c in tree.children[root]}
        parts = [part for part in branch.values() if part]
        people = [p for p in parts if all(_marks([tree.names[n] for n in p]))]
        if len(people) < 2:
            return nodes
        best = max(people, key=lambda p: (len(targeted & p), len(p)))
        named = [(tree.names[_connected(tree, p)[1]], len(p)) for p in people]
        k = next(i for i, p in enumerate(people) if p is best)
        notes.append(others_note(*named[k], [n for i, n in enumerate(named) if i != k]))
        nodes = best


def _biggest_tree(tree: Tree, nodes: set[int]) -> set[int]:
    """Those of the nodes under the scene root that has most of them (cameras have their own)."""
    groups: dict[int, set[int]] = {}
    for node in nodes:
        groups.setdefault(tree.tops[node], set()).add(node)
    return max(groups.values(), key=len)


def _hanging_on(tree: Tree, joints: Iterable[int]) -> set[int]:
    """What hangs on the joints, down to nodes that carry a mesh or a camera."""
    out: set[int] = set()
    stack = [child for joint in joints for child in tree.children[joint]]
    while stack:
        node = stack.pop()
        if node not in out and not tree.solid[node]:
            out.add(node)
            stack += tree.children[node]
    return out


def _animated_below(tree: Tree, joints: set[int], root: int, targeted: set[int]) -> set[int]:
    """Limbs without a skin of their own: what is animated below joints other than the root, the nodes
    between, and what hangs on them."""
    out: set[int] = set()
    for node in tree.below(root):
        if node in joints or node not in targeted or tree.solid[node]:
            continue
        way = [node]
        while (up := tree.parents[way[-1]]) not in joints and up not in out:
            way.append(up)
        if up != root and not any(tree.solid[n] for n in way):
            out |= set(way)
    return out | _hanging_on(tree, out)


def _parents_first(tree: Tree, order: Sequence[int], root: int) -> bool:
    place = {node: i for i, node in enumerate(order)}
    return all(n == root or place.get(tree.parents[n], len(order)) < i for i, n in enumerate(order))


#: Where VRM 1.0, motions of VRM (.vrma) and VRM 0.x hold their humanoid.
_PLACES = ("VRMC_vrm", "VRMC_vrm_animation", "VRM")
_SIDED = {
    "Shoulder": "clavicle",
    "UpperArm": "upper_arm",
    "LowerArm": "forearm",
    "Hand": "hand",
    "UpperLeg": "thigh",
    "LowerLeg": "shin",
    "Foot": "foot",
    "Toes": "toes",
}
_FINGERS = {"Index": "index", "Middle": "middle", "Ring": "ring", "Little": "pinky"}
_SEGMENTS = ("Proximal", "Intermediate", "Distal")


def _parts() -> dict[str, str]:
    """The role of each of VRM's bones; of the trunk the ends alone: the rest tells its
    place, as a thumb's segments do, which VRM 0.x and 1.0 name differently."""
    out = {"hips": "hips", "head": "head"}
    for side in ("left", "right"):
        out |= {f"{side}{bone}": f"{side}_{kind}" for bone, kind in _SIDED.items()}
        for finger, kind in _FINGERS.items():
            out |= {f"{side}{finger}{s}": f"{side}_{kind}{n}" for n, s in enumerate(_SEGMENTS, 1)}
    return out


_VRM_PARTS = _parts()


def humanoid_of(file: GltfFile, tree: Tree, joints: Sequence[int]) -> dict[int, str]:
    """The roles that a VRM file states, by joint; none where the file is no VRM.

    Of a bone or a joint that is stated twice the first counts; what names no joint is left out.
    """
    out: dict[int, str] = {}
    for bone, node in _bones(file.doc):
        role = _VRM_PARTS.get(bone)
        known = isinstance(node, int) and not isinstance(node, bool) and node in joints
        if role is not None and known and role not in out.values():
            out.setdefault(joints.index(node), role)
    return out


def _bones(doc: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    """(bone, node) as they are written, unchecked."""
    extensions = _dict(doc.get("extensions"))
    for place in _PLACES:
        bones = _dict(_dict(extensions.get(place)).get("humanoid")).get("humanBones")
        if isinstance(bones, dict):
            for name, bone in cast("dict[str, Any]", bones).items():
                yield name, _dict(bone).get("node")
        elif isinstance(bones, list):
            for bone in cast("list[Any]", bones):
                name = _dict(bone).get("bone")
                if isinstance(name, str):
                    yield name, _dict(bone).get("node")


def _dict(value: Any) -> dict[str, Any]:
    return cast("dict[str, Any]", value) if isinstance(value, dict) else {}
