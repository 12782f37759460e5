"""A teacher looks ahead from where the learner has come to, and says what it should have done."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from poise.plan import LookaheadTeacher, TeacherConfig
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual import build
from refusals import refused
from toy_library import PLAIN, library, tiny

CONFIG = TeacherConfig(worlds=2, candidates=6, horizon=3, hold_steps=2, best=2, decisions=3)


@pytest.fixture(scope="module")
def task() -> Imitation:
    return build(library(), tiny(**PLAIN))


class Zero:
    """A learner that does nothing."""

    def __init__(self, width: int):
        self.width = width

    def act(self, obs: Tensor) -> Tensor:
        return torch.zeros(len(obs), self.width)


def taught(teacher: LookaheadTeacher) -> tuple[Tensor, Tensor, dict[str, float]]:
    return teacher.teach(Zero(teacher.env.num_actions), lambda obs: torch.zeros(len(obs)))


def test_labels_are_of_the_learners_own_states_and_repeat(task: Imitation) -> None:
    first, second = (taught(task.teacher(CONFIG)) for _ in range(2))
    obs, action, log = first
    # Every decision labels the steps for which it holds, where clip and episode go on.
    most = CONFIG.worlds * CONFIG.hold_steps * CONFIG.decisions
    assert 0 < len(obs) <= most and len(action) == len(obs)
    # The mean of offsets of at most 0.2 rad (one deviation).
    assert bool((action != 0).any()) and float(action.abs().max()) < 1.0
    assert log["gain"] >= 0 and 0 <= log["lost_best"] <= log["lost"] <= 1
    for a, b in zip(first[:2], second[:2], strict=True):
        assert torch.equal(a, b)


def test_it_goes_on_bit_for_bit(task: Imitation) -> None:
    teacher = task.teacher(CONFIG)
    taught(teacher)
    state = {k: v.clone() for k, v in teacher.state().items()}
    expected = taught(teacher)
    other = task.teacher(CONFIG)
    other.load_state(state)
    got = taught(other)
    assert torch.equal(got[0], expected[0]) and torch.equal(got[1], expected[1])
    other.close()


def test_labels_cost_less_than_what_the_learner_does(task: Imitation) -> None:
    # With all offsets but the best averaged away, labels are the best tried, which never costs more.
    config = replace(CONFIG, best=1, jerk_price=0.0, slide_price=0.0, decisions=4)
    _, _, log = taught(task.teacher(config))
    assert log["gain"] > 0


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"best": 32}, ("out-of-range", "best")),
        ({"hold_steps": 9}, ("out-of-range", "hold_steps")),
        ({"noise_range": (0.0, 0.1)}, ("out-of-range", "noise_range")),
        ({"jerk_price": -1.0}, ("out-of-range", "jerk_price")),
    ],
)
def test_settings_that_make_no_sense(settings: dict, words: tuple) -> None:
    with refused(*words):
        TeacherConfig(**settings)


def test_it_needs_as_many_copies(task: Imitation) -> None:
    teacher = task.teacher(CONFIG)
    with refused("count-differs", says=("2 copies", "12")):
        LookaheadTeacher(teacher.env, teacher.env, CONFIG)
