"""Pushes, commanded stiffness and held things at frames: what they do, and what is said of them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from poise.env.pushes import HeldThing
from poise.env.yielding import Yielding
from poise.formats import read_clip
from poise.jobs.complete import complete
from poise.jobs.open import open_run
from poise.jobs.track import TrackConfig, imitation_of, track
from poise.jobs.track.direction import direction_of
from poise.jobs.track.placement import place
from poise.jobs.track.pushed import (
    ForceEffect,
    HeldConfig,
    PushConfig,
    Pushed,
    row_of,
    with_forces,
    without_forces,
)
from poise.jobs.tracker import Tracker
from poise.plan import LookaheadConfig
from poise.recipes.imitation import Imitation
from refusals import refused
from toy_policy import WALK

ALONE = TrackConfig(controller="policy", supports="none")


@pytest.fixture(scope="module")
def tracker() -> Tracker:
    return open_run(None).tracker


@pytest.fixture(scope="module")
def task(tracker: Tracker) -> Imitation:
    return imitation_of(tracker, [place(read_clip(WALK), tracker)])


def test_words_of_forces() -> None:
    made = direction_of(
        pushes=("30:hand=150", "45:chest=200:0.3:0,1,0"),
        stiffness=("30=200", "50=900"),
        held=("10-40:right_hand=2.5", "41-60:left_hand=1:0.3"),
    )
    assert made.pushes[0].push == PushConfig(150.0, "hand")
    assert made.pushes[1].push == PushConfig(200.0, "chest", seconds=0.3, direction=(0.0, 1.0, 0.0))
    assert made.forces and not made.leads
    pushes, held = made.forces_of(30.0)
    assert [p.start_s for p in pushes] == [1.0, 1.5]
    assert (held[0].start_s, held[0].seconds) == pytest.approx((1 / 3, 1.0)) and held[1].size_m == 0.3
    law = made.yields(30.0, 60.0)
    assert law is not None and law.newtons_per_metre == 200.0 and law.schedule == ((100, 900.0),)
    # Retimed frames take everything along.
    later = made.moved(lambda frame: 2 * frame)
    assert later.pushes[0].frame == 60 and later.held[0].last == 80 and later.stiffness[1].frame == 100


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"pushes": ("hand=150",)}, ("option-malformed", "hand=150")),
        ({"pushes": ("30:hand",)}, ("option-malformed", "30:hand")),
        ({"pushes": ("30:hand=-1",)}, ("out-of-range", "newtons")),
        ({"pushes": ("30:hand=9:1:0,1",)}, ("option-malformed", "three numbers")),
        ({"stiffness": ("200",)}, ("option-malformed", "200")),
        ({"stiffness": ("30=0",)}, ("out-of-range", "newtons_per_metre")),
        ({"held": ("30:right_hand=2",)}, ("option-malformed", "30:right_hand=2")),
        ({"held": ("30-30:right_hand=2",)}, ("option-malformed", "30-30")),
        ({"held": ("30-60:foot=2",)}, ("unknown-limb", "foot")),
        ({"held": ("30-60:right_hand=0",)}, ("out-of-range", "kg")),
    ],
)
def test_words_that_make_no_sense(asked: dict, message: tuple[str, str]) -> None:
    with refused(message[0], says=message[1]):
        direction_of(**asked)


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"pushes": ("900:hand=50",)}, ("frame-outside", "900")),
        ({"pushes": ("30:wing=50",)}, ("unknown-body-part", "wing")),
        ({"stiffness": ("30=200",)}, ("option-needs-option", "pushes")),
        ({"held": ("30-900:right_hand=2",)}, ("frame-outside", "900")),
        ({"held": ("10-40:left_hand=2", "30-60:left_hand=2")}, ("settings-conflict", "two things")),
    ],
)
def test_forces_that_the_clip_or_the_body_does_not_have(
    tracker: Tracker, asked: dict, message: tuple[str, str]
) -> None:
    with refused(message[0], says=message[1]):
        track(WALK, tracker, ALONE, direction=direction_of(**asked))


def test_forces_are_for_a_single_character_without_a_range() -> None:
    held = direction_of(held=("10-40:left_hand=2",))
    with refused("single-character-only", says="held"):
        TrackConfig(count=2, direction=held)
    with refused("single-character-only", says="push"):
        TrackConfig(recover=True, direction=direction_of(pushes=("30:hand=50",)))


def test_a_held_thing_weighs_while_it_is_held(task: Imitation) -> None:
    row = row_of(task.humanoid.table, "left_hand")
    held = with_forces(task, (), (HeldConfig("left_hand", 3.0, 0.3, 0.1, 0.2),))
    env = held.env(2, auto_reset=False, threads=1)
    clip = torch.zeros(2, dtype=torch.long)
    env.reset_to(clip, clip)
    body, own = row + 1, float(held.humanoid.model.body_mass[row + 1])
    action = torch.zeros(2, env.num_actions)
    masses = list[float]()
    for _ in range(12):
        env.step(action)
        masses.append(float(env.backend.get_model(0).body_mass[body]))
    assert masses == pytest.approx([own + 3.0 * (3 <= k < 9) for k in range(12)], abs=1e-5)
    inertia = env.backend.get_model(0).body_inertia[body]
    np.testing.assert_allclose(inertia, held.humanoid.model.body_inertia[body], rtol=1e-5)
    # A new episode begins with an empty hand.
    env.reset_to(clip, clip)
    assert float(env.backend.get_model(1).body_mass[body]) == pytest.approx(own, abs=1e-5)
    env.close()
    plain = without_forces(held).task
    assert not any(isinstance(e, HeldThing) for e in plain.events) and plain.compliance is None


def test_what_a_held_thing_pulls_with_is_its_weight(tracker: Tracker, tmp_path: Path) -> None:
    made = track(WALK, tracker, ALONE, direction=direction_of(held=("10-50:right_hand=2:0.25",)))
    (told,) = made.evaluation.card.forces
    assert told["kind"] == "held" and told["mass_kg"] == 2.0
    assert (told["first_s"], told["last_s"]) == pytest.approx((1 / 3, 5 / 3), abs=0.02)
    # On average over a walk's steps the weight, with what swinging adds.
    assert 0.9 * 2 * 9.81 < told["force_n"] < 2.0 * 2 * 9.81 and told["most_n"] > told["force_n"]
    calm = track(WALK, tracker, ALONE)
    ref = calm.imitation.reference.pose.pos
    pos = calm.evaluation.rollouts.pos[0]
    rate = calm.imitation.reference.rate_hz
    last = round((told["last_s"] + 0.5) * rate)
    first = round(told["first_s"] * rate)
    off = (pos[first : last + 1] - ref[first : first + len(pos[first : last + 1])]).norm(dim=-1)
    assert told["without_mm"] == pytest.approx(1000 * float(off.mean()), rel=1e-4)
    assert told["error_mm"] != pytest.approx(told["without_mm"], rel=1e-3)
    paths = made.write(tmp_path / "out").paths
    assert json.loads(paths["score"].read_text())["forces"][0]["part"] == told["part"]
    assert '"pushed":true' in paths["report"].read_text()
    rows = made.evaluation.recordings[0].contacts
    assert [len(r) for r in rows[9:12]] == [0, 1, 1]
    np.testing.assert_allclose(rows[20][0, 3:], (0.0, 0.0, -2 * 9.81))


def test_a_stiffness_is_commanded_from_a_frame_on(task: Imitation) -> None:
    asked = direction_of(
        pushes=("2:left_hand=20:0.2:0,1,0", "12:left_hand=20:0.2:0,1,0"), stiffness=("0=800", "10=100")
    )
    rate = task.reference.rate_hz
    pushed = with_forces(task, asked.forces_of(rate)[0], (), asked.yields(rate, rate))
    env = pushed.env(1, auto_reset=False, threads=1)
    zero = torch.zeros(1, dtype=torch.long)
    env.reset_to(zero, zero)
    yielding = env.event(Yielding)
    assert yielding is not None
    dials, gave = list[float](), list[float]()
    for _ in range(20):
        env.step(torch.zeros(1, env.num_actions))
        dials.append(float(yielding.level[0]))
        gave.append(float(yielding.goal.offset.norm()))
    assert dials == [800.0] * 10 + [100.0] * 10
    assert max(gave[12:20]) > 2 * max(gave[:10]) > 0.0
    env.close()


def test_two_pushes_are_told_one_by_one(tracker: Tracker) -> None:
    words = ("20:left_hand=20:0.2:0,1,0", "45:chest=30:0.2")
    made = track(WALK, tracker, ALONE, direction=direction_of(pushes=words))
    first, second = made.evaluation.card.forces
    assert (first["kind"], second["kind"]) == ("push", "push") and first["part"] != second["part"]
    assert first["force"] == (0.0, 20.0, 0.0)
    assert (first["first_s"], second["first_s"]) == pytest.approx((2 / 3, 1.5))
    assert made.pushed is not None and made.pushed.part == first["part"]
    assert sum("was pushed with" in n and "without" in n for n in made.notes) == 2


def test_keyframes_with_a_thing_in_a_hand(tracker: Tracker) -> None:
    few = LookaheadConfig().with_budget(40)
    asked = direction_of(held=("15-30:right_hand=1.5",), pushes=("15:chest=40:0.2",))
    done = complete(
        WALK,
        (0, 15, 30, 45),
        tracker,
        adapt=0,
        threads=1,
        lookahead=few,
        supports="none",
        controller="lookahead",
        direction=asked,
    )
    kinds = [f["kind"] for f in done.evaluation.card.forces]
    assert kinds == ["push", "held"]
    assert any("held 1.5 kg" in note for note in done.notes)


def test_an_effect_counts_frames_while_it_acts() -> None:
    goals = torch.zeros(30, 2, 3)
    pos, without = goals.clone(), goals.clone()
    pos[10:21, :, 0], without[10:21, :, 0] = 0.05, 0.01
    came = Pushed("head", (1.0, 0.0, 0.0), 10 / 30, 20 / 30, 0.0, 0.0, None, 1.0)
    effect = ForceEffect.between(came, pos, without, goals, 30.0)
    assert effect.error_mm > 3 * effect.without_mm > 0.0
    assert effect.to_dict()["kind"] == "push"
