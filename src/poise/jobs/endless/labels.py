"""What is done in the clips of a library: labels by their names, from a file `labels.txt` beside them.

# a label, and a regular expression that names of its clips match; the first that fits counts
walk   walk|^07_
dance  salsa
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

from poise.errors import PoiseError

if TYPE_CHECKING:
    from poise.jobs.endless.training import Motions

#: The file in a library's folder, and how many labels it may have.
LABELS, MOST = "labels.txt", 1000


class Label(NamedTuple):
    """A name, and what names of its clips match."""

    name: str
    pattern: re.Pattern[str]


def read_labels(path: Path) -> tuple[Label, ...]:
    """The labels of a file; of a folder those of its `labels.txt`, none where there is none.

    Raises:
        PoiseError: a line says something else.
    """
    if path.is_dir():
        path = path / LABELS
        if not path.is_file():
            return ()
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError):
        raise PoiseError("the labels could not be read", path, "Give a text file") from None
    out = list[Label]()
    for number, line in enumerate(lines, 1):
        words = line.split("#")[0].split(None, 1)
        if not words:
            continue
        try:
            name, pattern = words[0], re.compile(words[1].strip())
        except IndexError:
            raise PoiseError(f"line {number} has a label alone", path, "Write LABEL REGEX") from None
        except re.error as problem:
            raise PoiseError(f"line {number} has no regular expression ({problem})", path) from None
        out.append(Label(name, pattern))
    if len(out) > MOST:
        raise PoiseError(f"there may be {MOST} labels at most, got {len(out)}", path)
    return tuple(out)


def names_of(labels: Sequence[Label]) -> tuple[str, ...]:
    """The labels' names, each once, in order."""
    return tuple(dict.fromkeys(label.name for label in labels))


def kinds_of(clips: Sequence[str], labels: Sequence[Label]) -> Tensor:
    """Which label each clip has, its number among `names_of`, `(C,)`; -1 for none."""
    names = names_of(labels)
    found = [next((k for k in labels if k.pattern.search(c)), None) for c in clips]
    return torch.tensor([-1 if k is None else names.index(k.name) for k in found])


def clips_of_seeds(motions: Motions, past: int) -> Tensor:
    """Which clip each of `motions.seeds` is of, `(S,)`; as `training.motions_of` picks them."""
    sizes = torch.diff(motions.frames.first).tolist()
    clips = [c for c, n in enumerate(sizes) for _ in range(0, n - past, past)]
    return torch.tensor(clips)[spread(len(clips), len(motions.seeds))]


def spread(count: int, most: int) -> Tensor:
    """At most so many of `count` numbers from 0 on, evenly spread."""
    return torch.tensor(np.linspace(0, count - 1, min(most, count)).round().astype(int))
