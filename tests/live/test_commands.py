"""What is taken from strangers, and what is not."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from poise.errors import PoiseError
from poise.live.admission import ALL, BURST, DEPTH, EACH, MOST_BYTES, Bucket, Guard, _shallow, parse
from poise.live.protocol import command, turned
from poise.live.sources import JsonStream
from poise.live.stream import PEOPLE, WAIT, Inbox
from poise.motion.rotations import quat_rotate
from refusals import refused

NAMES = ["hips", "spine"]


def say(**fields: object) -> str:
    return json.dumps({"v": 1, **fields})


def pose(person: str = "a", **changes: object) -> str:
    told = {
        "type": "pose",
        "person": person,
        "time": 1.0,
        "root": [0, 0, 1],
        "rotations": [[1, 0, 0, 0]] * 2,
    }
    return say(**{**told, **changes})


def stream() -> JsonStream:
    out = JsonStream(Inbox())
    told = say(type="skeleton", person="a", names=NAMES, parents=[-1, 0], offsets=[[0, 0, 0], [0, 0, 1]])
    assert out.receive(told, 0.0) is None
    return out


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("x" * (MOST_BYTES + 1), "over-limit"),
        ("[" * (DEPTH + 1), "nested-too-deep"),
        ("{", "bad-json"),
        ("[1]", "not-an-object"),
        ("{}", "version-differs"),
        (b"\xff\xfe", "not-text"),
        ('{"v": 2}', "version-differs"),
        ("9" * 5000, "bad-json"),
    ],
)
def test_what_is_no_message_is_refused(text: str | bytes, why: str) -> None:
    with refused(why):
        parse(text)
    assert parse('{"v": 1, "a": "[[[[[[[["}')["a"] == "[" * 8


@pytest.mark.parametrize(
    "fields",
    [
        {"type": "eval"}, {"type": ["knock"]}, {"type": "knock"}, {"type": "knock", "character": -1},
        {"type": "knock", "character": True}, {"type": "knock", "character": 0, "x": 1},
        {"type": "set", "buffer": 0.5}, {"type": "set", "noise": "1"}, {"type": "pause", "on": 1},
        {"type": "pull", "character": 0, "body": 1, "point": [0, 0], "to": [0, 0, 0]},
        {"type": "pull", "character": 0, "body": 1, "point": [0, 0, 0], "to": [0, 0, 1e9]},
        {"type": "follow", "character": 0, "person": "\n"},
    ],
)  # fmt: skip
def test_commands_are_those_of_the_list(fields: dict) -> None:
    with pytest.raises(PoiseError):
        command(parse(say(**fields)))


def test_commands_that_are_taken() -> None:
    assert command(parse(say(type="knock", character=2))) == {"type": "knock", "character": 2}
    assert command(parse(say(type="set", noise=1)))["noise"] == 1.0
    assert command(parse(say(type="follow", character=0, person=None)))["person"] is None


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"rotations": [[1, 0, 0, 0], [math.nan, 0, 0, 0]]}, "not finite"),
        ({"root": [0, 0, math.inf]}, "not finite"),
        ({"root": [0, 0, 1e5]}, "too far away"),
        ({"rotations": [[1, 0, 0, 0]]}, "shape"),
        ({"rotations": [[0, 0, 0, 0]] * 2}, "no rotation"),
        ({"rotations": [[True, 0, 0, 0]] * 2}, "no number"),
        ({"root": [0, 0]}, "no rows"),
        ({"time": "now"}, "no number"),
        ({"time": 10**400}, "not finite"),
        ({"person": "b"}, "no skeleton yet"),
        ({"person": ""}, "no name"),
        ({"type": "code"}, "unknown type"),
    ],
)
def test_poses_that_are_none_are_counted(changes: dict, why: str) -> None:
    source = stream()
    source.receive(pose(**changes), 0.0)
    assert source.inbox.refused == {why: 1} and source.inbox.received == 0


@pytest.mark.parametrize(
    "changes",
    [
        {"parents": [-1, 5]}, {"parents": [-1, True]}, {"parents": [0, 0]}, {"names": ["a", "a"]},
        {"names": [1, 2]}, {"offsets": [[0, 0, 0]]}, {"offsets": [[0, 0, 0], [0, 0, math.nan]]},
        {"up": "X"}, {"names": ["a"] * 300},
    ],
)  # fmt: skip
def test_skeletons_that_are_none_are_refused(changes: dict) -> None:
    told = {"names": NAMES, "parents": [-1, 0], "offsets": [[0, 0, 0], [0, 0, 1]], **changes}
    source = JsonStream(Inbox())
    assert source.receive(say(type="skeleton", person="a", **told), 0.0) is not None


def test_a_vertical_along_y_is_turned() -> None:
    rng = np.random.default_rng(1)
    q = rng.normal(size=(5, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    v = rng.normal(size=(5, 3))
    np.testing.assert_allclose(turned(np.array([1.0, 2.0, 3.0]), "Y"), [3.0, 1.0, 2.0])
    import torch

    a, b = (
        quat_rotate(torch.tensor(x), torch.tensor(y)).numpy()
        for x, y in ((q, v), (turned(q, "Y"), turned(v, "Y")))
    )
    np.testing.assert_allclose(turned(a, "Y"), b, atol=1e-12)


def test_the_newest_wins_and_queues_are_bounded() -> None:
    source = stream()
    for k in range(WAIT + 10):
        source.receive(pose(time=float(k)), float(k))
    assert source.inbox.crowded == 10
    line = source.inbox.take()["a"]
    assert len(line) == WAIT and line[-1][1].time_s == WAIT + 9
    # As many people as may come, and five more, by several doors.
    one = line[-1][1]
    taken = [source.inbox.offer(replace(one, person=f"p{k}"), 0.0) for k in range(PEOPLE + 5)]
    assert taken == [True] * PEOPLE + [False] * 5
    assert source.inbox.refused["too many people"] == 5 and len(source.inbox.take()) == PEOPLE


def test_who_comes_in() -> None:
    here = Guard("127.0.0.1", 8000)
    own = {"Host": "127.0.0.1:8000"}
    assert here.admits("/live", own) is None
    assert here.admits("/live", {**own, "Origin": "http://127.0.0.1:8000"}) is None
    assert here.admits("/live", {**own, "Origin": "http://evil.example"}) == (403, "another origin")
    assert here.admits("/live", {**own, "Origin": "null"}) == (403, "another origin")
    assert here.admits("/", {"Host": "evil.example"}) == (403, "another host")
    open_ = Guard("0.0.0.0", 8000, "secret")
    far = {"Host": "192.168.0.7:8000"}
    assert open_.admits("/", far) == (401, "no token")
    assert open_.admits("/?token=wrong", far) == (401, "no token")
    assert open_.admits("/?token=secret", far) is None
    assert open_.admits("/", {**far, "Authorization": "Bearer secret"}) is None


def test_connections_are_capped() -> None:
    guard = Guard("127.0.0.1", 1)
    assert [guard.enter("a") for _ in range(EACH + 1)][-1] == "too many connections from this address"
    guard.leave("a")
    assert guard.enter("a") is None
    for k in range(ALL - EACH):
        assert guard.enter(f"b{k}") is None
    assert guard.enter("c") == "too many connections"
    bucket = Bucket()
    assert sum(bucket.takes() for _ in range(2 * int(BURST))) < 1.2 * BURST


def test_depth_is_told_as_by_reading_letter_by_letter() -> None:
    """The naive twin goes through the letters."""

    def naive(text: str) -> bool:
        depth, quoted, skip = 0, False, False
        for c in text:
            if skip:
                skip = False
            elif quoted:
                skip, quoted = c == "\\", c != '"'
            elif c == '"':
                quoted = True
            elif c in "[{":
                depth += 1
                if depth > DEPTH:
                    return False
            elif c in "]}":
                depth -= 1
        return True

    rng, deep = np.random.default_rng(0), 0
    for _ in range(4000):
        text = "".join(rng.choice(list('[[[{{]}"\\a\n'), int(rng.integers(0, 24))))
        try:
            _shallow(text)
            shallow = True
        except PoiseError:
            shallow = False
        assert shallow == naive(text), text
        deep += not shallow
    assert 50 < deep < 3950
