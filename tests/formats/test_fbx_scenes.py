"""FBX scenes: nodes that move above the bones, several root bones, two people, stills, rigs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from handmade_rigs import FPS, Rig, fbx_of, walker
from scipy.spatial.transform import Rotation

from poise.formats import read_clip
from poise.formats.table import read_skeleton
from poise.motion import Clip
from refusals import refused

pytest.importorskip("ufbx")


def read(folder: Path, text: str) -> Clip:
    (folder / "a.fbx").write_text(text)
    return read_clip(folder / "a.fbx")


def check(clip: Clip, rig: Rig, *names: str) -> None:
    names = names or rig.names
    got = clip.positions()[:, [clip.skeleton.index(n) for n in names]]
    want = rig.world()[:, [rig.index(n) for n in names]]
    assert got.shape == want.shape and np.abs(got - want).max() < 1e-4


def test_what_moves_above_the_bones_counts_at_every_time(tmp_path: Path) -> None:
    """An armature that turns and jumps between two frames, in a group that travels."""
    person = walker(frames=40)
    rig = person.below(("Group", (0, 0, 0)), ("Armature", (0, 0, 0.3)))
    t = np.arange(40)[:, None] / FPS
    jump = np.where(np.arange(40) == 7, 0.2, 0.0)[:, None] * (0, 1, 0)
    rig = rig.moved("Group", t * (0.5, 0, 0)).moved("Armature", jump + (0, 0, 0.3))  # noqa: RUF005
    rig = rig.turned("Armature", Rotation.from_rotvec(0.5 * t * (0, 1, 0)))
    check(read(tmp_path, fbx_of(rig, person.names)), rig, *person.names)


def joined(*parts: Rig) -> Rig:
    """Rigs side by side below one still node, which is no bone."""
    rig = Rig((), (), (), ())
    for part in parts:
        k = len(rig.names)
        rig = Rig(
            rig.names + part.names,
            (*rig.parents, *(p + k if p >= 0 else -1 for p in part.parents)),
            rig.place + part.place,
            rig.turn + part.turn,
        )
    return rig.below(("Armature", (0, 0, 0)))


def test_root_bones_of_one_armature_are_one_body(tmp_path: Path) -> None:
    person = walker()
    target = Rig(("ik_foot",), (-1,), (person.place[0] * 0.1,), (person.turn[0],))
    rig = joined(person, target)
    clip = read(tmp_path, fbx_of(rig, (*person.names, "ik_foot")))
    check(clip, rig, *person.names)
    assert clip.skeleton.names[0] == "Armature" and "ik_foot" in clip.skeleton.names


def test_a_second_person_is_named(tmp_path: Path) -> None:
    a, b = walker(), walker(prefix="B_").moved("B_pelvis", (2, 0.95, 0))
    clip = read(tmp_path, fbx_of(joined(a, b), a.names + b.names))
    check(clip, a)
    assert len(clip.skeleton) == 18
    assert (
        "The file holds 2 bodies: 'pelvis' (18 joints) was read, and the other one was left out: "
        "'B_pelvis' (18 joints); to read another, export it alone"
    ) in clip.skeleton.source.notes


def test_a_rig_without_animation_serves_as_a_target(tmp_path: Path) -> None:
    rig = walker()
    text = fbx_of(rig)
    start, end = text.index("AnimationStack:"), text.index("\n}\nConnections")
    text = (text[:start] + text[end:]).replace('C: "OO",3,2\n', "")
    with refused("no-animation"):
        read(tmp_path, text)
    clip = read_skeleton(tmp_path / "a.fbx")
    assert clip.frames == 2 and clip.skeleton.names == rig.names
    want = np.array([p[0] for p in rig.place])[1:]
    np.testing.assert_allclose(
        np.linalg.norm(clip.skeleton.offsets[1:], axis=1), np.linalg.norm(want, axis=1), atol=1e-5
    )


def test_constant_keys_are_a_still_clip(tmp_path: Path) -> None:
    rig = walker()
    turns = tuple(Rotation.from_quat(np.tile(q.as_quat()[:1], (31, 1))) for q in rig.turn)
    still = Rig(rig.names, rig.parents, tuple(np.tile(p[:1], (31, 1)) for p in rig.place), turns)
    clip = read(tmp_path, fbx_of(still))
    check(clip, still)
    assert "Nothing moves in it: its 31 frames show one pose" in clip.skeleton.source.notes
