"""Claims of papers, row by row, beside rows of `results/`, and how a claim ends.

A verdict follows from the rows alone, by `verdict`; nobody writes one. A row that is not there yet is
"not run", and its figures appear as soon as `results/` has them.
"""

from __future__ import annotations

import math
import re
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

from scipy.stats import t as student
from tables import Results, written

SHOWN, OPEN, OTHER, MISSING = "shown", "not shown", "the other way", "not run"
#: Share of the compared figure within which two figures are alike.
ALIKE = 0.1
_NUMBER = r"[-+]?\d[\d,]*\.?\d*(?:e[-+]?\d+)?"
Row = dict[str, str]


@dataclass(frozen=True)
class Value:
    """A figure and the interval that it lies in.

    seeds: of how many seeds the interval is the range; 0 for an interval of another kind. low and high
    are NaN where none is known.
    """

    value: float
    low: float = math.nan
    high: float = math.nan
    seeds: int = 0

    @property
    def known(self) -> bool:
        """Whether it has an interval."""
        return not math.isnan(self.low)

    @property
    def room(self) -> float:
        """How much farther than touching another interval must be off: the width of two seeds' range."""
        return self.high - self.low if self.seeds == 2 else 0.0


def verdict(
    says: str, sign: int, ours: Value | None, other: Value | None, scale: float | None = None
) -> str:
    """How a claim ends, and why where it is not shown.

    says: "better" or "worse" than `other`; "alike", up to `ALIKE` of `scale`, by default of `other`;
    "reaches", at least as good as `other`. sign: 1 where more is better, -1 where less is.
    """
    if ours is None or other is None:
        return MISSING
    if not (ours.known and other.known):
        return f"{OPEN} (no interval)"
    if says == "alike":
        margin = ALIKE * abs(other.value if scale is None else scale)
        least, most = ours.low - other.high, ours.high - other.low
        if -margin <= least and most <= margin:
            return SHOWN
        return OTHER if least > margin or most < -margin else f"{OPEN} (too wide)"
    sign = -sign if says == "worse" else sign
    room = max(ours.room, other.room)
    above, below = ours.low - other.high, other.low - ours.high
    for gap, way in ((above, 1), (below, -1)):
        if gap > room or (says == "reaches" and way == sign and gap == room):
            return SHOWN if way == sign else OTHER
    return f"{OPEN} (intervals meet)"


#: The rule of `verdict` and `value_of`, as the pages tell it.
RULE = (
    "A claim is **shown** where its two intervals do not meet and the sign is the paper's, **the other "
    "way** where they do not meet and the sign is not, else **not shown**; **not run** where a row is "
    "missing. An interval is the row's own; of a share Wilson's at 95 % over n; of three seeds or more "
    "their range; of two seeds their range, where another must also be off by the width of the wider "
    "one (chance alone does so as rarely as with three); of clips in pairs Student's t at 95 %; of a "
    "difference with its error twice the error. One seed without a spread has none, and rows of other "
    "versions of a policy are not compared. *As good as the paper's* is of the paper's own figure; "
    "*like* means that the whole difference is within a tenth. *Ours alone* is what the paper has no "
    "row of. Figures after a semicolon are in the order of the head; *beside* is what ours is compared "
    "with."
)


def wilson(share: float, n: int) -> tuple[float, float]:
    """The interval of 95 % of a share of n, which no quantity between 0 and 1 exceeds."""
    z = 1.96
    middle = (share + z * z / (2 * n)) / (1 + z * z / n)
    error = z * math.sqrt(share * (1 - share) / n + z * z / (4 * n * n)) / (1 + z * z / n)
    return max(middle - error, 0.0), min(middle + error, 1.0)


@dataclass(frozen=True)
class Measure:
    """A figure of a table: its title, its metric in `results/`, how it is written (`tables.Column`), and
    whether more (1) or less (-1) is better. unit: the whole of a share, 0 for what is none."""

    title: str
    metric: str
    form: str = "0"
    sign: int = 1
    unit: float = 0.0


def share(title: str, metric: str, sign: int = 1) -> Measure:
    """A share between 0 and 1, written as one of 100."""
    return Measure(title, metric, "%", sign, 1.0)


def value_of(rows: Sequence[Row], measure: Measure) -> Value | None:
    """The figure of rows that are seeds of each other, or of one with its interval; None for none."""
    if not rows:
        return None
    values = [float(row["value"]) for row in rows]
    mean = statistics.fmean(values)
    if len(values) > 1:
        return Value(mean, min(values), max(values), len(values))
    row, spread = rows[0], rows[0]["spread"]
    seeds = int(row["seeds"] or 1)
    if error := re.fullmatch(rf"\+-\s*({_NUMBER})", spread):
        wide = 2 * float(error[1])
        return Value(mean, mean - wide, mean + wide)
    if ends := re.fullmatch(rf"({_NUMBER}) to ({_NUMBER})", spread):
        low, high = (float(e.replace(",", "")) for e in ends.groups())
        return Value(mean, low, high, seeds if seeds > 1 else 0)
    if measure.unit and int(row["n"] or 1) > 1:
        low, high = wilson(mean / measure.unit, int(row["n"]))
        return Value(mean, low * measure.unit, high * measure.unit)
    return Value(mean)


@dataclass(frozen=True)
class Claim:
    """A row of a paper's table or figure, and what the paper says of it.

    Attributes:
        name: the paper's row.
        ours: SUITE:SUBJECT of `results/`, "*" for any seed.
        says: as `verdict` reads it; "" where the paper states no order.
        than: the row that it is compared with; "" for nothing, so that `ours` is a difference already.
        beside: the name of that row.
        paper: the paper's own row, a subject of `results/published.csv`.
        judged: metrics that the claim is of; "-" before one turns its sign. () for all of the table.
        metric, than_metric: in place of the table's own, of a table with one measure.
        over: words in the place of "{}" in `ours` and `than`: the mean difference of these pairs counts.
        run: the command that would make the row, where it is not the table's.
        printed: what the paper has in place of a figure.
        words: the claim, in place of "better than" and the like.
        optional: left out where its row is not there.
    """

    name: str
    ours: str = ""
    says: str = ""
    than: str = ""
    beside: str = ""
    paper: str = ""
    judged: tuple[str, ...] = ()
    metric: str = ""
    than_metric: str = ""
    over: tuple[str, ...] = ()
    run: str | None = None
    printed: str = ""
    words: str = ""
    optional: bool = False


@dataclass(frozen=True)
class PaperTable:
    """A table or figure of a paper.

    Attributes:
        measures: its figures, in the paper's order.
        claims: its rows, in the paper's order.
        run: the command that makes rows that are not there; "" for none.
        samples: a subject of `results/published.csv` that states the paper's control steps.
        printed: what the paper has where it prints no figure.
    """

    measures: tuple[Measure, ...]
    claims: tuple[Claim, ...]
    run: str = ""
    samples: str = ""
    printed: str = "in words"


def found(results: Results, source: str, metric: str) -> list[Row]:
    """Rows of a metric whose subject is SUITE:SUBJECT, "*" for anything."""
    suite, _, subject = source.partition(":")
    if "*" not in subject:
        row = results.rows.get((suite, subject, metric))
        return [] if row is None else [row]
    return [
        row
        for (s, name, m), row in results.rows.items()
        if s == suite and m == metric and fnmatchcase(name, subject)
    ]


def _paired(results: Results, claim: Claim, metric: str) -> tuple[list[Row], Value | None, float]:
    """Rows of both sides, the mean difference with its interval, and the mean of what it is from."""
    pairs = [
        (a[0], b[0])
        for word in claim.over
        if (a := found(results, claim.ours.format(word), metric))
        and (b := found(results, claim.than.format(word), metric))
    ]
    if len(pairs) < 2:
        return [], None, 0.0
    gaps = [float(a["value"]) - float(b["value"]) for a, b in pairs]
    mean, error = statistics.fmean(gaps), statistics.stdev(gaps) / math.sqrt(len(gaps))
    wide = float(student.ppf(0.975, len(gaps) - 1)) * error
    base = statistics.fmean(float(b["value"]) for _, b in pairs)
    return [row for pair in pairs for row in pair], Value(mean, mean - wide, mean + wide), base


def _policy(results: Results, rows: Sequence[Row]) -> str:
    """The policies of rows: what ships, what does not, what was trained for the table."""
    told = dict[str, None]()
    for policy in dict.fromkeys(row["policy"] for row in rows):
        if kind := re.search(r"\((.+)\)$", policy):
            told[kind[1]] = None
        elif policy:
            gone = results.older(policy)
            told |= {name: None for name in re.findall(r"[\w-]+-v\d+", policy) if name not in gone}
            told |= {f"of {name}, not what ships": None for name in gone}
    return ", ".join(told) or ("-" if rows else "")


def _steps(results: Results, rows: Sequence[Row]) -> str:
    """Control steps that a policy learned from, of a row that states them or of what shipped then."""
    for row in rows:
        stated = results.rows.get((row["suite"], row["subject"], "samples"))
        if stated is not None:
            return _millions(float(stated["value"]))
        for digest in re.findall(r"[0-9a-f]{16}", row["policy"]):
            if steps := results.steps.get(digest):
                return _millions(steps)
    return "not stated" if any(row["policy"].endswith(")") for row in rows) else ""


def _millions(steps: float) -> str:
    return f"{steps / 1e6:,.3g} million"


def _cell(measures: Sequence[Measure], values: Sequence[Value | None], plus: bool = False) -> str:
    """Figures with their intervals, "" for none at all."""
    out = []
    for measure, value in zip(measures, values, strict=True):
        if value is None:
            out.append("-")
            continue
        text = written(f"{value.value}", measure.form)
        text = f"+{text}" if plus and value.value > 0 else text
        if value.known:
            ends = [written(f"{v}", measure.form).removesuffix(" %") for v in (value.low, value.high)]
            text += f" ({ends[0]} to {ends[1]})"
        out.append(text)
    return "; ".join(out) if any(v is not None for v in values) else ""


def _printed(measures: Sequence[Measure], rows: Sequence[Row | None]) -> str:
    """The paper's figures, with the digits that it prints."""
    if not any(rows):
        return ""
    shown = [
        "-" if r is None else written(r["value"], "%") if m.form == "%" else r["value"]
        for m, r in zip(measures, rows, strict=True)
    ]
    return "; ".join(shown)


@dataclass
class _Sides:
    """One measure of a claim: rows of `results/`, ours, what it is compared with, and how it ends."""

    rows: list[Row]
    ours: Value | None
    other: Value | None
    end: str


def _differ(rows: Sequence[Row], others: Sequence[Row]) -> bool:
    """Whether two sides are of different versions of one policy that came along."""

    def versions(side: Sequence[Row]) -> dict[str, set[str]]:
        out = dict[str, set[str]]()
        for row in side:
            for kind, version in re.findall(r"([a-z]+)-(v\d+)", row["policy"]):
                out.setdefault(kind, set()).add(version)
        return out

    mine, theirs = versions(rows), versions(others)
    return any(mine[kind] != theirs[kind] for kind in mine.keys() & theirs.keys())


def _sides(claim: Claim, measure: Measure, results: Results, paper: Row | None) -> _Sides:
    metric = claim.metric or measure.metric
    scale, stale = None, False
    if claim.over:
        rows, ours, scale = _paired(results, claim, metric)
        other = Value(0.0, 0.0, 0.0)
    else:
        rows = found(results, claim.ours, metric)
        ours, other = value_of(rows, measure), Value(0.0, 0.0, 0.0)
        if claim.says == "reaches":
            other = None if paper is None else Value(*[float(paper["value"])] * 3)
        elif claim.than:
            against = found(results, claim.than, claim.than_metric or metric)
            other, stale = value_of(against, measure), _differ(rows, against)
    turned = f"-{measure.metric}" in claim.judged
    if not claim.says or not (turned or not claim.judged or measure.metric in claim.judged):
        return _Sides(rows, ours, None, "")
    sign = -measure.sign if turned else measure.sign
    end = f"{OPEN} (other policies)" if stale else verdict(claim.says, sign, ours, other, scale)
    return _Sides(rows, ours, other, end)


def _ending(claim: Claim, measures: Sequence[Measure], sides: Sequence[_Sides]) -> str:
    """One verdict, or several with the measures that end so."""
    if not any(side.rows for side in sides):
        return MISSING
    if not claim.says:
        return "-"
    ends = dict[str, list[str]]()
    for measure, side in zip(measures, sides, strict=True):
        if side.end:
            ends.setdefault(side.end, []).append(measure.title.partition(",")[0])
    if len(ends) == 1:
        return next(iter(ends))
    ranks = (SHOWN, OTHER, OPEN, MISSING)
    ordered = sorted(ends, key=lambda end: ranks.index(end.partition(" (")[0]))
    return "; ".join(f"{end}: {', '.join(ends[end])}" for end in ordered)


def _name(claim: Claim) -> str:
    """The row and its claim."""
    said = {"better": "better than", "worse": "worse than", "alike": "like"}
    if claim.says == "reaches":
        return f"{claim.name}: {claim.words or 'as good as the paper' + chr(39) + 's'}"
    words = claim.words or said.get(claim.says, "")
    return f"{claim.name}: {words} {claim.beside}" if words else claim.name


def _line(claim: Claim, table: PaperTable, results: Results) -> tuple[list[str], list[Row]]:
    """The cells of a claim, and its rows."""
    printed = [
        (found(results, f"published:{claim.paper}", m.metric) or [None])[0] for m in table.measures
    ]
    sides = [
        _sides(claim, measure, results, row)
        for measure, row in zip(table.measures, printed, strict=True)
    ]
    rows = [row for side in sides for row in side.rows]
    paper = _printed(table.measures, printed) or claim.printed or table.printed
    ours, beside, n, seeds = "not run", "", "", ""
    if rows:
        same = next(side.rows for side in sides if side.rows)
        ours = _cell(table.measures, [side.ours for side in sides], bool(claim.over))
        n, seeds = same[0]["n"], same[0]["seeds"]
        if claim.over:
            n = f"{len(same) // 2} pairs"
        elif len(same) > 1:
            seeds = f"{len(same)}"
        if claim.than and not claim.over:
            beside = _cell(table.measures, [side.other for side in sides])
    elif command := table.run if claim.run is None else claim.run:
        ours = f"not run: `{command}`"
    cells = [_name(claim), paper, ours, beside, n, seeds, _steps(results, rows), _policy(results, rows)]
    return [*cells, _ending(claim, table.measures, sides)], rows


def paper_markdown(table: PaperTable, results: Results) -> str:
    """A paper's table as markdown: each row beside ours, with the commands that made the rows below."""
    lines = [
        line for claim in table.claims if (line := _line(claim, table, results))[1] or not claim.optional
    ]
    what = "; ".join(m.title for m in table.measures)
    heads = ["row", f"paper: {what}", "ours", "beside", "n", "seeds", "control steps", "policy"]
    heads.append("verdict")
    out = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    out += ["| " + " | ".join(cells) + " |" for cells, _ in lines]
    if table.samples:
        row = results.rows["published", table.samples, "samples"]
        out += ["", f"The paper: {_millions(float(row['value']))} control steps ({row['command']})."]
    made = dict[str, None]()
    for row in (row for _, rows in lines for row in rows):
        hours = f", {row['core_hours']} core-hours, {row['machine']}" if row.get("core_hours") else ""
        made[f"    {row['command']}  # {row['commit']}{hours}"] = None
    return "\n".join([*out, *([""] if made else []), *made])
