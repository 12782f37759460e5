"""Trials of recovery beside the paper's."""

from __future__ import annotations

import math

from field.paper import PHC_RECOVERY
from poise.score.recovered import SECONDS, RecoveryCard


def recovery_markdown(card: RecoveryCard) -> str:
    """A table with the paper's rows beneath its own."""
    times = [f"Succ-{s:g}s" for s in card.seconds]
    kinds = [r.kind for r in card.rows]
    head = ["method", "trials", *(f"{kind} {time}" for kind in kinds for time in times)]
    own = [card.method, str(max(r.trials for r in card.rows))]
    lines = [head, ["---"] * len(head), [*own, *(_share(x) for r in card.rows for x in r.within)]]
    told = {(r.method, r.start): (r.succ_5s, r.succ_10s) for r in PHC_RECOVERY}
    for name in dict.fromkeys(r.method for r in PHC_RECOVERY):
        found = [dict(zip(SECONDS, told[name, kind], strict=True)) for kind in kinds]
        cells = [_share(f.get(s, math.nan) / 100) for f in found for s in card.seconds]
        lines.append([f"{name} (table 4)", "1000", *cells])
    table = "\n".join("| " + " | ".join(line) + " |" for line in lines)
    low, high = card.distance
    where = f"{low:g} m" if low == high else f"{low:g} to {high:g} m"
    return (
        f"{table}\n\nReference: {card.reference} from frame {card.frame}. Back: bodies on average "
        f"within {card.near:g} m for {card.held:g} s. Far: {where} away. The paper does not say "
        "what counts as back; its clip stands still.\n"
    )


def _share(x: float) -> str:
    return "" if math.isnan(x) else f"{100 * x:.1f} %"
