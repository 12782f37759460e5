"""What came of damaged files, by format, and its sum over runs."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from .oracle import Verdict

#: What is counted of a format; "wrong" is all that is neither read nor refused.
COLUMNS = ("inputs", "refused", "read", "round_trips", "wrong")


class Tally:
    """Counts by format, and what was wrong.

    Attributes:
        rows: counts under `COLUMNS`, by format.
        odd: the first text of everything wrong, by its key.
    """

    def __init__(self) -> None:
        self.rows, self.odd = dict[str, Counter[str]](), dict[str, str]()

    def add(self, format: str, verdict: Verdict, again: bool) -> tuple[str, bool]:
        """Counts one outcome: its key, and whether it is wrong and new.

        again: what was read was written and read once more.
        """
        row = self.rows.setdefault(format, Counter())
        row["inputs"] += 1
        row[verdict.kind if verdict.sound else "wrong"] += 1
        row["round_trips"] += again and verdict.kind == "read"
        key = key_of(format, verdict)
        new = not verdict.sound and key not in self.odd
        if new:
            self.odd[key] = verdict.text
        return key, new

    def told(self) -> dict[str, Any]:
        """The counts as plain values."""
        return {"files": sum(r["inputs"] for r in self.rows.values()), "formats": _plain(self.rows),
                "odd": self.odd}  # fmt: skip


def key_of(format: str, verdict: Verdict) -> str:
    """What tells one outcome from another: the sentence without its values."""
    text = re.sub(r"'[^']*'|[-+]?\d[\d.e+-]*|nan|inf", "#", verdict.text)
    return f"{format} {verdict.kind} {text[:80]}"


def record(path: Path, options: list[str]) -> Callable[[Tally], None]:
    """What adds a run's tally to those of a file, again and again."""
    before = json.loads(path.read_text()) if path.exists() else {}
    rows = {f: Counter(row) for f, row in before.get("formats", {}).items()}
    command = " ".join(["python -m tests.fuzz", *options])

    def save(tally: Tally) -> None:
        sums = {f: rows.get(f, Counter()) + tally.rows.get(f, Counter()) for f in {*rows, *tally.rows}}
        told = {
            **before,
            "commands": [*before.get("commands", []), command],
            "files": sum(r["inputs"] for r in sums.values()),
            "formats": _plain(sums),
            "odd": {**before.get("odd", {}), **tally.odd},
        }
        path.write_text(json.dumps(told, indent=1) + "\n")

    return save


def _plain(rows: dict[str, Counter[str]]) -> dict[str, dict[str, int]]:
    return {f: {name: rows[f][name] for name in COLUMNS} for f in sorted(rows)}
