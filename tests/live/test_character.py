"""What a character is to do, by hand: no physics."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from poise.env.recovery.get_up import GetUpPlanner
from poise.env.recovery.planner import walk_of
from poise.jobs.open import open_run
from poise.live.characters import (
    EASE,
    PASSES_S,
    RETURNS,
    SPEEDS_UP,
    TRACKS,
    CharacterGoals,
    CharacterState,
)
from poise.motion.rotations import facing

RATE = 30.0


class Person:
    """Moves along x as it stands, from wherever it is put."""

    def __init__(self, speed: float, ease: Tensor):
        self.speed, self.ease, self.at = speed, ease, 0.0
        self.shift = torch.tensor([5.0, 3.0])

    def read(self) -> Tensor:
        self.at += self.speed / RATE
        out = self.ease.clone()
        out[:2] = torch.tensor([self.at, 0.0]) + self.shift
        return out

    def put(self, seen: Tensor, to: Tensor) -> None:
        self.shift = self.shift + to[:2] - seen[:2]


@pytest.fixture(scope="module")
def get_up() -> GetUpPlanner:
    tracker = open_run(None).tracker
    assert tracker.recovery_clips is not None
    return GetUpPlanner(tracker.recovery_clips, tracker.humanoid.table, RATE)


def step(character: CharacterGoals, person: Person, *what: object) -> Tensor:
    """The next frame; the person's motion goes on from where it was put."""
    out = character.next(person.read(), *what)  # type: ignore[arg-type]
    if character.moved is not None:
        person.put(*character.moved)
    return out


def followed(get_up: GetUpPlanner, speed: float) -> tuple[CharacterGoals, Person]:
    # As a walk along x faces.
    ease = facing(get_up.recovery_clips.ease, walk_of(get_up, 0)[2])
    person = Person(speed, ease)
    character = CharacterGoals(get_up, (0.0, 0.0))
    character.begin(ease)
    return character, person


def body_of(frame: Tensor, moves: float = 0.0) -> CharacterState:
    return CharacterState(frame.clone(), 0.0, moves, torch.tensor([moves, 0.0], dtype=torch.float64))


@pytest.mark.parametrize("speed", [0.5, 1.7, 3.0])
def test_a_character_that_stands_speeds_up_to_its_person_and_does_not_run_after_it(
    get_up: GetUpPlanner, speed: float
) -> None:
    character, person = followed(get_up, speed)
    places = [character.last[0].item()]
    for _ in range(120):
        places.append(float(step(character, person, body_of(character.last))[0]))
    moved = torch.tensor(places).diff() * RATE
    assert character.doing == TRACKS and character.lost == 0
    assert float(moved.max()) < 1.01 * speed
    # Twice its mean at most, since shares begin and end without speed.
    assert float(moved.diff().max()) * RATE < 2 * max(SPEEDS_UP, speed / PASSES_S)
    assert float(moved[-1]) == pytest.approx(speed, rel=1e-3)


def test_a_person_that_comes_back_out_of_a_gap_is_gone_on_with_from_where_the_character_is(
    get_up: GetUpPlanner,
) -> None:
    character, person = followed(get_up, 1.5)
    for _ in range(60):
        step(character, person, body_of(character.last))
    steps = list[float]()
    for k in range(60):
        before = character.last
        frame = person.read()
        if k < 10:
            # Nothing new has come; what was extrapolated rests.
            person.at -= person.speed / RATE
            frame = person.read()
            person.at -= person.speed / RATE
        if k == 10:
            person.at += 0.8
            frame = person.read()
        steps.append(float((character.next(frame, body_of(before), k < 10)[:2] - before[:2]).norm()))
    assert max(steps) < 1.2 * 1.5 / RATE and character.lost == 0 and character.doing == TRACKS


def test_a_body_that_walks_comes_to_a_halt_by_walking_where_nothing_more_comes(
    get_up: GetUpPlanner,
) -> None:
    character, person = followed(get_up, 1.3)
    for _ in range(60):
        step(character, person, body_of(character.last, 1.3))
    here = character.last.clone()
    frame = step(character, person, body_of(here, 1.3), True)
    assert character.doing == EASE and character.anew and torch.allclose(frame[:2], here[:2], atol=0.02)
    places = [float(frame[0])]
    for _ in range(90):
        frame = step(character, person, body_of(character.last), True)
        places.append(float(frame[0]))
    moved = torch.tensor(places).diff() * RATE
    # It goes on by steps, slower and slower, and stands at the end.
    assert 0.2 < places[-1] - places[0] < 1.5
    assert float(moved[:6].mean()) > 0.8 and float(moved[-5:].abs().max()) < 0.01
    assert character.lost == 0 and character.still


@pytest.mark.parametrize(("speed", "doing"), [(0.0, RETURNS), (1.2, TRACKS)])
def test_after_a_leap_it_walks_to_who_stands_and_goes_on_with_who_walks(
    get_up: GetUpPlanner, speed: float, doing: str
) -> None:
    character, person = followed(get_up, speed)
    for _ in range(60):
        step(character, person, body_of(character.last))
    before = character.last
    person.at += 3.0
    character.jump()
    for _ in range(4):
        frame = step(character, person, body_of(character.last))
    assert character.doing == doing and character.lost == 0
    assert float((frame[:2] - before[:2]).norm()) < 0.3
    for _ in range(300):
        frame = step(character, person, body_of(character.last))
    if not speed:
        assert float((frame[:2] - person.read()[:2]).norm()) < 0.3
    assert character.doing == TRACKS and character.recovered == 0
