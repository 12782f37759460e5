"""A motion with a push in it: how the character and its goal give way, and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import poise
from poise.control import Stiffness
from poise.env.pushes import Push
from poise.formats import read_clip
from poise.jobs.open import open_run
from poise.jobs.track import TrackConfig, imitation_of, track
from poise.jobs.track.placement import place
from poise.jobs.track.pushed import (
    PushConfig,
    back_after,
    from_the_front,
    row_of,
    unforeseen,
    with_forces,
)
from poise.jobs.tracker import Tracker
from poise.recipes.imitation import Imitation
from refusals import refused
from toy_human import swing
from toy_policy import WALK

ALONE = TrackConfig(controller="policy", supports="none")
#: What the policy alone bears on a walk.
SOFT = {"at": "left_hand", "seconds": 0.4, "direction": (0.0, 1.0, 0.0)}


@pytest.fixture(scope="module")
def tracker() -> Tracker:
    return open_run(None).tracker


@pytest.fixture(scope="module")
def task(tracker: Tracker) -> Imitation:
    return imitation_of(tracker, [place(read_clip(WALK), tracker)])


def test_a_walk_with_a_push(tracker: Tracker, tmp_path: Path) -> None:
    made = poise.push(WALK, 40.0, tracker, ALONE, stiffness=150.0, **SOFT)  # type: ignore[arg-type]
    came, source = made.pushed, read_clip(WALK)
    assert came is not None and came.part == "lwrist" and came.force == (0.0, 40.0, 0.0)
    assert (came.first_s, came.last_s) == pytest.approx((1.0, 1.4))
    assert 0.05 < came.goal_m < 40 / 150 and came.moved_m > came.goal_m
    assert came.sentence() in made.notes
    # On the skeleton that came in, and the same before the push as without it.
    assert made.clip.skeleton.names == source.skeleton.names and made.clip.frames == source.frames
    calm = track(WALK, tracker, ALONE)
    a, b = (t.evaluation.recordings[0].qpos for t in (made, calm))
    np.testing.assert_array_equal(a[:31], b[:31])
    assert np.abs(a[31:] - b[31:]).max() > 0.05
    # What is written: the goal that gave way is the report's ghost, the push its arrow.
    paths = made.write(tmp_path / "out").paths
    page = paths["report"].read_text()
    assert '"pushed":true' in page and ">goal<" in page and ">Push<" in page
    rows = made.evaluation.recordings[0].contacts
    assert [len(r) for r in rows] == [int(30 <= k < 42) for k in range(len(rows))]
    np.testing.assert_allclose(rows[30][0, 3:], (0.0, 40.0, 0.0))
    assert json.loads(paths["score"].read_text())["help"]["limit_n"] == 0.0


def test_more_compliance_gives_way_farther(tracker: Tracker) -> None:
    def pushed(**how: object) -> float:
        given = PushConfig(30.0, **SOFT, **how)  # type: ignore[arg-type]
        came = track(WALK, tracker, ALONE, push=given).pushed
        assert came is not None
        return came.goal_m

    still, some, more = (pushed(level=a) for a in (0.0, 0.1, 0.2))
    assert still == 0.0 < some < more
    stiff, limp = (pushed(stiffness=k) for k in (800.0, 100.0))
    assert stiff < limp


def test_lookahead_knows_of_no_push_to_come(task: Imitation) -> None:
    """Copies act alike before the push, and feel it from when it acts."""
    given = with_forces(task, (PushConfig(100.0, start_s=0.2, seconds=0.1),))
    env = given.env(1, auto_reset=False, threads=1, help_scale=0.0)
    copies = unforeseen(given).env(4, auto_reset=False, threads=1, help_scale=0.0)
    zero = torch.zeros(1, dtype=torch.long)
    env.reset_to(zero, zero)
    still = torch.zeros(1, env.num_actions)
    ahead = copies.event(Push)
    assert ahead is not None
    felt = []
    for _ in range(10):
        copies.restore(env.snapshot(zero))
        seen = []
        for _ in range(3):
            seen.append(bool(ahead.acts.all()))
            copies.step(still.expand(4, -1))
        felt.append(seen)
        env.step(still)
    assert felt == [[6 <= k < 9] * 3 for k in range(10)]
    env.close()
    copies.close()


def test_parts_by_their_words(tracker: Tracker) -> None:
    table = tracker.humanoid.table
    names = [r.name for r in table.rows]
    for at, name in {
        "hand": "rwrist", "left_hand": "lwrist", "right_foot": "rfoot", "chest": "thorax",
        "pelvis": "root", "head": "head", "left_knee": "ltibia", "rradius": "rradius",
    }.items():  # fmt: skip
        assert names[row_of(table, at)] == name
    with refused("unknown-body-part", says=("hnd", "hand")):
        row_of(table, "hnd")
    with refused("unknown-body-part", says="left_chest"):
        row_of(table, "left_chest")
    # A body without hands.
    kinds = tuple(replace(r, kind="forearm" if r.kind == "hand" else r.kind) for r in table.rows)
    with refused("body-part-missing", says="left hand"):
        row_of(replace(table, rows=kinds), "left_hand")


def test_when_a_part_is_back() -> None:
    assert back_after([0.3, 0.2, 0.09, 0.2, 0.09, 0.05, 0.05, 0.3], 6.0) == pytest.approx(4 / 6)
    assert back_after([0.0, 0.0], 30.0) == 0.0
    assert back_after([0.2, 0.2], 30.0) is None and back_after([0.2, 0.05], 30.0) == pytest.approx(
        1 / 30
    )


def test_a_push_from_the_front_is_against_where_it_looks(task: Imitation) -> None:
    qpos = task.reference.qpos[0].clone()
    x, y, z = from_the_front(task.humanoid, qpos)
    ahead = task.reference.qpos[20, :2] - task.reference.qpos[0, :2]
    assert z == 0.0 and np.hypot(x, y) == pytest.approx(1.0)
    assert float(ahead[0] * x + ahead[1] * y) / float(ahead.norm()) < -0.9


@pytest.mark.parametrize(
    ("given", "what"),
    [
        ({"newtons": 0.0}, ("out-of-range", "10000")),
        ({"level": 1.5}, ("out-of-range", "1.5")),
        ({"stiffness": -1.0}, ("out-of-range", "N/m")),
        ({"seconds": 0.0}, ("out-of-range", "seconds")),
        ({"direction": (0.0, 0.0, 0.0)}, ("no-direction",)),
    ],
)
def test_pushes_that_are_none(given: dict[str, object], what: tuple) -> None:
    with refused(*what):
        PushConfig(**given)  # type: ignore[arg-type]


def test_what_cannot_be_pushed(task: Imitation, tracker: Tracker) -> None:
    with refused("push-too-late", says="9"):
        with_forces(task, (PushConfig(start_s=9.0),))
    with refused("unknown-body-part", says="wing"):
        with_forces(task, (PushConfig(at="wing"),))
    for how in ({"count": 2}, {"recover": True}, {"controller": "search"}):
        with refused("single-character-only"):
            TrackConfig(push=PushConfig(), **how)  # type: ignore[arg-type]
    with refused("single-clip-only", says="a push"):
        track([WALK, WALK], tracker, push=PushConfig())
    with refused("index-outside", says="90"):
        own = replace(task.task, events=(Push(90, (1.0, 0.0, 0.0), 0, 1),))
        replace(task, task=own).env(1)
    assert with_forces(task, ()) is task
    assert isinstance(PushConfig(stiffness=50.0).yields, Stiffness)


def test_a_toy_body_is_pushed_too() -> None:
    """Whatever has a forearm can be pushed there, by its name."""
    from poise.motion import ClipLibrary
    from poise.recipes import ResidualForce, build

    task = build(ClipLibrary.of([swing(1.5, name="calm")]), ResidualForce(num_envs=1, expert=False))
    env = with_forces(task, (PushConfig(20.0, at="LeftForeArm", start_s=0.1),)).env(1, threads=1)
    env.reset()
    env.step(torch.zeros(1, env.num_actions))
    env.close()
