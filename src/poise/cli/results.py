"""Score cards as tables."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from rich.text import Text

from poise.cli.console import say, table

if TYPE_CHECKING:
    from poise.eval import ScoreCard

_STYLES = {"good": "green", "fair": "yellow", "poor": "red"}


def print_card(card: ScoreCard) -> None:
    """The score card with its verdicts, then the one sentence that sums it up."""
    from poise.eval import table as rows_of
    from poise.view.verdict import sentence

    rows = [
        (label, "-" if math.isnan(value) else f"{value:,.4g}", unit, _verdict(verdict))
        for label, value, unit, verdict in rows_of(card)
    ]
    episodes = "1 episode" if card.episodes == 1 else f"{card.episodes} episodes"
    title = f"{card.clip or 'run'}: {episodes}, {card.frames:,} frames"
    table(title, ("", "value", "unit", "verdict"), rows)
    say(sentence(card.to_dict()))


def _verdict(word: str) -> Text:
    return Text(word, style=_STYLES.get(word, ""))
