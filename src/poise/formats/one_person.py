"""Files that hold several people: one is read, and the others are named."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from poise.errors import PoiseError, did_you_mean
from poise.formats.markers import split_label, unknown_labels
from poise.formats.text import MAX_JOINTS, listed, shown

# A person's mark before or behind a label, which may consist of words itself: "P1:LKnee", "Anna_LASI",
# "person 1 LKnee", "L_Knee-2", "LKnee (P2)".
_APART = r"[\s:|/._(\[-]"
_FIRST = re.compile(rf"^([^\s:|/._(\[-]+){_APART}+(.+)$")
_LAST = re.compile(rf"^(.+?){_APART}+([^\s:|/._(\[-]+)$")
_SIDES = {"l", "r", "left", "right", "lt", "rt"}
#: Labels of more characters are none.
LONGEST = 200
#: An axis of people is no longer than this.
MOST_PEOPLE = 8
#: So many points make a person, and this share of them the other people have too.
_POINTS, _SHARED = 8, 0.7


def person_of(
    names: Sequence[str], take: str | None, path: Path
) -> tuple[list[int], tuple[str, ...], list[str]]:
    """Columns and bare labels of one person's points, and a note about the others; all as they are where
    there is one person.

    People are told by a mark before or behind their labels: the same labels appear with several marks.

    Args:
        take: which one, by mark or by number from 0; the first by default.

    Raises:
        PoiseError: no person is called `take`.
    """
    if len(names) > MAX_JOINTS * MOST_PEOPLE or max(map(len, names), default=0) > LONGEST:
        # Their reader refuses them; a pattern would take its time with them.
        return list(range(len(names))), tuple(names), []
    ways = ((pattern, mark) for mark in (1, 2) for pattern in (_FIRST, _LAST))
    people = next((found for pattern, mark in ways if (found := _marked(names, pattern, mark))), None)
    if people is None:
        return list(range(len(names))), tuple(names), []
    one, note = chosen(list(people), take, path)
    return list(people[one].values()), tuple(people[one]), note


def chosen(people: Sequence[str], take: str | None, path: Path) -> tuple[str, list[str]]:
    """One of several people, the first unless `take` says another by name or number, and the note.

    Raises:
        PoiseError: no person is called `take`.
    """
    one = people[0]
    if take is not None:
        if take in people:
            one = take
        elif take.isdecimal() and int(take) < len(people):
            one = people[int(take)]
        else:
            raise PoiseError(
                f"it holds {len(people)} people, and none is called {shown(take)}",
                path,
                f"{did_you_mean(take, list(people))}, or give a number from 0",
                code="unknown-take",
            )
    if len(people) == 1:
        return one, []
    others = listed(shown(p) for p in people if p != one)
    rest = "other is" if len(people) == 2 else "others are"
    return one, [
        f"The file holds {len(people)} people: {shown(one)} was read; the {rest} {others} (--take NAME, "
        "or a number from 0)"
    ]


def _marked(names: Sequence[str], pattern: re.Pattern[str], mark: int) -> dict[str, dict[str, int]]:
    """Each person's columns by bare label, by mark; empty if the labels tell no two people.

    mark: the group of the pattern that is the person's, 1 or 2.
    """
    by_mark: dict[str, dict[str, int]] = {}
    for k, name in enumerate(names):
        match = pattern.match(name.strip(")] "))
        if match and match.group(mark).lower() not in _SIDES:
            by_mark.setdefault(match.group(mark), {}).setdefault(match.group(3 - mark), k)
    whole = {one: parts for one, parts in by_mark.items() if _is_person(list(parts))}
    return {
        one: parts
        for one, parts in whole.items()
        if any(
            len(parts.keys() & o.keys()) >= _SHARED * len(parts) for w, o in whole.items() if w != one
        )
    }


def _is_person(labels: list[str]) -> bool:
    """Whether labels are those of a body: enough places, on both sides."""
    known = set(labels) - set(unknown_labels(labels))
    sides = {split_label(label)[0] for label in known}
    return len(known) >= _POINTS and {"left", "right"} <= sides


def one_person(
    table: np.ndarray, axes: int, take: str | None, path: Path
) -> tuple[np.ndarray, list[str]]:
    """A table of `axes` axes, the first its frames: where it has one more, one person's, and the note.

    The axis of people is the shorter one of the first two.
    """
    if table.ndim != axes + 1 or min(table.shape[:2]) > MOST_PEOPLE:
        return table, []
    axis = 0 if table.shape[0] < table.shape[1] else 1
    names = [str(k) for k in range(table.shape[axis])]
    if not names:
        raise PoiseError("its axis of people is empty", path, code="no-people")
    one, note = chosen(names, take, path)
    return np.take(table, int(one), axis=axis), note


def one_of_dicts(
    value: Any, known: Callable[[Mapping[str, Any]], bool], take: str | None, path: Path
) -> tuple[Any, list[str]]:
    """One of a dict (or list) of people, each a dict of arrays that is `known`; else the value."""
    pairs: Iterable[tuple[Any, Any]]
    if isinstance(value, dict):
        pairs = value.items()
    elif isinstance(value, list):
        pairs = enumerate(value)
    else:
        return value, []
    parts = list(pairs)
    # What stands beside the people, such as the frame rate, is everybody's.
    shared: dict[str, Any] = {
        str(k): v for k, v in parts if isinstance(k, str) and not isinstance(v, dict)
    }
    people = {
        str(key): {**shared, **item}
        for key, item in parts
        if isinstance(item, dict) and all(isinstance(k, str) for k in item) and known({**shared, **item})
    }
    if not people or known(shared):
        return value, []
    one, note = chosen(list(people), take, path)
    return people[one], note
