"""The policies and networks that ship, by name and digest, as rows of `results/` state them."""

from __future__ import annotations

import csv
import hashlib
from functools import cache
from pathlib import Path

import poise

ROOT = Path(__file__).resolve().parents[2]
DATA = Path(poise.__file__).parent / "data"
#: File of each kind in the package's data.
FILES = {
    "tracker": "tracker.safetensors",
    "keypoints": "keypoints.safetensors",
    "generator": "generator.safetensors",
    "ball": "ball.safetensors",
    "chicken": "chicken.safetensors",
    "door": "door.safetensors",
    "hands": "hands.safetensors",
    "hops": "hops.safetensors",
    "inbetween": "inbetween/model.safetensors",
}


@cache
def shipped(kind: str) -> str:
    """Name and digest of what ships now: "tracker-v6 68ef92c615ec3b19".

    A file that `results/policies.csv` does not list has the name "tracker-unlisted", so that no row
    takes it for a release."""
    digest = hashlib.sha256((DATA / FILES[kind]).read_bytes()).hexdigest()[:16]
    with (ROOT / "results" / "policies.csv").open(encoding="utf-8", newline="") as text:
        names = {row["digest"]: row["policy"] for row in csv.DictReader(text)}
    return f"{names.get(digest, f'{kind}-unlisted')} {digest}"


def stated(kinds: tuple[str, ...]) -> str:
    """The column `policy` of rows of these kinds; "" for none."""
    return "; ".join(shipped(kind) for kind in kinds)
