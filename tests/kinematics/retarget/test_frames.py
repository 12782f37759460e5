"""Frame by frame is what the whole clip is."""

from __future__ import annotations

import numpy as np
import pytest

from poise.formats import read_clip
from poise.jobs.open import open_run
from poise.kinematics import clip_to_qpos
from poise.kinematics.coords import Hinges
from poise.kinematics.retargeting.passage import Retargeter, local_of, world_of
from poise.kinematics.retargeting.standing import ClipWorld
from poise.motion import Clip
from poise.motion.rotations import normalize, quat_mul, quat_rotate, quat_to_matrix, slerp
from test_docs import WALK


@pytest.fixture(scope="module")
def walk() -> Clip:
    return read_clip(WALK)


def test_rotations_are_those_of_spatial() -> None:
    rng = np.random.default_rng(3)
    a, b = (normalize(rng.normal(size=(50, 4))) for _ in range(2))
    v, share = rng.normal(size=(50, 3)), rng.uniform(size=50)
    ta, tb, tv = (x for x in (a, b, v))
    np.testing.assert_allclose(quat_mul(a, b), quat_mul(ta, tb), atol=1e-12)
    np.testing.assert_allclose(quat_rotate(a, v), quat_rotate(ta, tv), atol=1e-12)
    np.testing.assert_allclose(quat_to_matrix(a), quat_to_matrix(ta), atol=1e-12)
    mixed = slerp(a, b, share)
    there = slerp(ta, tb, share)
    np.testing.assert_allclose(np.abs((mixed * there).sum(-1)), 1.0, atol=1e-9)


def test_a_frame_passes_as_the_clip_does(walk: Clip) -> None:
    tracker = open_run(None).tracker
    one = Retargeter.between(walk, tracker.example)
    rot, root = one.transfer(ClipWorld.of(walk))
    hinges, last = Hinges(tracker.example.skeleton, tracker.humanoid.table), None
    made = []
    for t in range(walk.frames):
        there, world = one(walk.root_pos[t], world_of(walk.skeleton, walk.rot[t]))
        np.testing.assert_allclose(there, root[t], atol=1e-9)
        own = local_of(one.target, world)
        np.testing.assert_allclose(np.abs((own * rot[t]).sum(-1)), 1.0, atol=1e-9)
        made.append(hinges(there, world, last))
        last = made[-1][7:]
    whole = Clip(one.target, root, rot, walk.fps)
    there = clip_to_qpos(whole, tracker.humanoid.table)
    np.testing.assert_allclose(np.stack(made)[:, 7:], there[:, 7:], atol=1e-6)
    np.testing.assert_allclose(np.stack(made)[:, :3], there[:, :3], atol=1e-9)


def test_world_and_local_are_each_other(walk: Clip) -> None:
    back = local_of(walk.skeleton, world_of(walk.skeleton, walk.rot[7]))
    np.testing.assert_allclose(np.abs((back * walk.rot[7]).sum(-1)), 1.0, atol=1e-12)
