"""The documents' tables: their rows of `results/`, and how they are written.

A cell is looked up by suite, subject and metric. A row of a policy that does not ship says so.
"""

from __future__ import annotations

import csv
import re
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "results"
#: Name, then the digest of a policy's file.
_POLICY = re.compile(r"([\w-]+-v\d+) ([0-9a-f]{16})")


@dataclass(frozen=True)
class Column:
    """A column: its title, its metrics (two are written as "a, b"), and how a number is written: "%" as
    a share, "x" as a ratio, else with so many decimals."""

    title: str
    metrics: tuple[str, ...]
    form: str = "0"


@dataclass(frozen=True)
class Line:
    """A row: where its figures stand (SUITE:SUBJECT), its name, and what its metrics begin with."""

    source: str
    name: str = ""
    prefix: str = ""


@dataclass(frozen=True)
class Table:
    """One table of at most twelve rows.

    first: the title of the first column. commands: whether the lines that made the rows stand below it.
    """

    first: str
    columns: tuple[Column, ...]
    lines: tuple[Line, ...]
    commands: bool = True


@dataclass
class Results:
    """All rows of `results/*.csv` by suite, subject and metric; of several the last one counts.

    Attributes:
        rows: each with its suite.
        ships: the digest of each policy that ships, by name.
        steps: control steps that policies learned from, by digest.
    """

    rows: dict[tuple[str, str, str], dict[str, str]] = field(default_factory=dict)
    ships: dict[str, str] = field(default_factory=dict)
    steps: dict[str, float] = field(default_factory=dict)

    @classmethod
    def read(cls, folder: Path = RESULTS) -> Results:
        found = cls()
        for file in sorted(folder.glob("*.csv")):
            with file.open(encoding="utf-8", newline="") as text:
                rows = list(csv.DictReader(text))
            if file.stem == "policies":
                # The last policy of a file is the one that ships.
                latest = {row["file"]: row for row in rows}
                found.ships = {row["policy"]: row["digest"] for row in latest.values()}
                learned = {row["digest"]: row["control_steps"] for row in rows}
                found.steps = {digest: float(steps) for digest, steps in learned.items() if steps}
                continue
            for row in rows:
                found.rows[file.stem, row["subject"], row["metric"]] = row | {"suite": file.stem}
        return found

    def older(self, policy: str) -> list[str]:
        """Names of policies that a row is of and that do not ship."""
        found = _POLICY.findall(policy)
        if not found and policy not in ("", "published"):
            return [policy.partition(" (")[0]]
        return [name for name, digest in found if self.ships.get(name) != digest]


def written(value: str, form: str) -> str:
    """A number as a table shows it; "" for none."""
    if value == "":
        return ""
    number = float(value)
    if form == "%":
        text = f"{100 * number:.1f}"
        return f"{text.removesuffix('.0')} %"
    if form == "x":
        return f"{number:.2f} x"
    text = f"{number:,.{int(form)}f}"
    return text if text.strip("-0.,") else "0"


def markdown(table: Table, results: Results) -> str:
    """A table as markdown, with the commands that made its rows below it.

    Raises:
        KeyError: a row has no figure in `results/`.
    """
    heads = [table.first, *(c.title for c in table.columns), "n", "seeds"]
    out = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    made: dict[tuple[str, str], None] = {}
    for line in table.lines:
        cells, used = [], []
        suite, subject = line.source.split(":", 1)
        for column in table.columns:
            shown = []
            for metric in column.metrics:
                row = results.rows.get((suite, subject, line.prefix + metric))
                if row is not None:
                    used.append(row)
                    shown.append(written(row["value"], column.form))
            cells.append(", ".join(shown))
        if not used:
            raise KeyError(f"no row of results/ is called {line.source}")
        name = line.name or subject
        before = sorted({p for row in used for p in results.older(row["policy"])})
        if before:
            name += f" (of {', '.join(before)}, not what ships)"
        if used[0]["policy"] == "published":
            name += f" ({used[0]['command']})"
        else:
            made |= {(row["command"], row["commit"]): None for row in used}
        out.append("| " + " | ".join([name, *cells, used[0]["n"], used[0]["seeds"]]) + " |")
    if table.commands:
        out += ["", *(f"    {command}  # {commit}" for command, commit in made)]
    return "\n".join(out)


def _done(title: str = "done", metric: str = "done") -> Column:
    return Column(title, (metric,), "%")


_TRACK = (
    _done("done whole"),
    Column("g-MPJPE, mm", ("g_mpjpe_mm",)),
    Column("MPJPE, mm", ("mpjpe_mm",)),
    Column("E_acc, mm/frame²", ("acc_mm_per_frame2",), "1"),
)
_AHEAD = (
    _done("done whole"),
    Column("g-MPJPE, mm", ("median_g_mpjpe_mm",)),
    Column("E_acc, mm/frame²", ("median_acc_mm_per_frame2",), "1"),
    Column("jerk over the source's", ("median_jerk_ratio",), "x"),
    Column("slide, source's, mm/s", ("median_slide_mm_per_s", "median_source_slide_mm_per_s")),
)
_BACK = (_done("back in 5 s", "back_in_5_s"), _done("back in 10 s", "back_in_10_s"))
_MENDED = (
    ("as it came", "null"),
    ("`poise doctor --fix`", "repair"),
    ("best of three filters, an oracle's cut-off", "best filter"),
    ("that filter, then a foot lock told the contacts", "best filter, then foot lock"),
)
_UNSEEN, _HELD = "Bandai, never learned (validation)", "held-out CMU subjects 05, 11, 14"
_LIBRARY = "recordings and their retimed copies, learned"

TABLES: dict[str, Table] = {
    "unseen": Table(
        "clips, controller",
        _TRACK,
        (
            Line(f"track:{_UNSEEN}; policy alone"),
            Line(f"track:{_UNSEEN}; policy of keypoints alone"),
            Line(f"track:{_HELD}; policy alone"),
            Line("track:recordings, learned; policy alone"),
            Line(f"track:{_LIBRARY}; policy alone"),
            Line(f"track:{_LIBRARY}; policy of keypoints alone"),
            Line("track:files of real pose estimators; policy alone"),
            Line(f"track:{_UNSEEN}; nothing (action 0)"),
            Line("published:PHC, AMASS-Test"),
            Line("published:PHC of keypoints, AMASS-Test"),
            Line("published:PHC, AMASS-Train"),
            Line("published:SONIC-K1, unseen clips"),
        ),
    ),
    "ahead": Table(
        "clips, controller",
        _AHEAD,
        (
            Line(f"lookahead-search:{_UNSEEN}; policy alone"),
            Line(f"lookahead-search:{_UNSEEN}; lookahead"),
            Line(f"lookahead-search:{_UNSEEN}; lookahead, other draws"),
            Line(f"lookahead-search:{_HELD}; policy alone"),
            Line(f"lookahead-search:{_HELD}; lookahead"),
            Line("lookahead-search:every eighth recording, learned; policy alone"),
            Line("lookahead-search:every eighth recording, learned; lookahead"),
            Line("published:PHC, AMASS-Test"),
        ),
    ),
    "recover": Table(
        "trials",
        _BACK,
        (
            Line("recover:fallen; policy"),
            Line("recover:fallen; policy of keypoints"),
            Line("published:fallen; PHC"),
            Line("recover:far; policy", "3 m away; policy"),
            Line("recover:far; policy of keypoints", "3 m away; policy of keypoints"),
            Line("published:far; PHC", "3 m away; PHC"),
            Line("recover:fallen and far; policy"),
            Line("recover:fallen and far; policy of keypoints"),
            Line("published:fallen and far; PHC"),
        ),
    ),
    "imitate": Table(
        "clip",
        (
            _done("success from all starts", "success_over_all_starts"),
            Column("MPJPE, mm", ("mpjpe_mm",)),
            Column("first shown whole after, s", ("shown_after_s",)),
            Column("trained for, s", ("learned_in_s",)),
        ),
        (
            Line("imitate:CMU 02_01, walk"),
            Line("imitate:DeepMimic kick"),
            Line("imitate:CMU 90_02, cartwheel"),
            Line("imitate:CMU 90_08, side flip"),
            Line("imitate:CMU 90_11, handspring"),
            Line("imitate:DeepMimic backflip"),
            Line("imitate:DeepMimic spin"),
            Line("imitate:CMU 05_13, dance, never learned"),
            Line("imitate:CMU 05_06, dance, never learned"),
            Line(
                "imitate:CMU 05_06, dance, never learned; from nothing, seed 0",
                "CMU 05_06, from nothing (`--from none`)",
            ),
            Line(
                "imitate:CMU 90_08, side flip; from nothing, seed 0",
                "CMU 90_08, from nothing (`--from none`)",
            ),
            Line("published:Residual Force Control, any of its clips"),
        ),
    ),
    "repair": Table(
        "dirt, what is done to it",
        (
            Column("off the truth, mm", ("distance_mm",), "1"),
            Column("end of the path off, mm", ("end_mm",)),
            Column("slide more than the truth, mm/s", ("slide_more_mm_per_s",)),
            Column("jerk over the truth's", ("jerk_ratio",), "x"),
        ),
        tuple(
            Line(f"{suite}:{dirt}", f"{dirt}, {kind}", f"{what}: ")
            for suite, dirt, rows in (
                ("repair", "white 25 mm", _MENDED),
                ("repair", "all 25 mm", _MENDED),
                ("repair_track", "all 25 mm", (("`poise track`", "tracked"),)),
            )
            for kind, what in rows
        ),
    ),
    "keyframes": Table(
        "clips, what fills the gaps",
        tuple(Column(f"L2P at {n}", (f"l2p_{n}",), "3") for n in (5, 15, 30, 45)),
        (
            Line("inbetween-complete:six CMU subjects, never learned; interpolation"),
            Line("inbetween-complete:six CMU subjects, never learned; network"),
            Line("inbetween-complete:windows as hard as LAFAN1; interpolation"),
            Line("inbetween-complete:windows as hard as LAFAN1; network"),
            Line("inbetween-complete:Bandai, other takes of what was learned; interpolation"),
            Line(
                "inbetween-complete:Bandai, other takes of what was learned; transformer trained on it"
            ),
            Line("inbetween-complete:Bandai, styles never learned; interpolation"),
            Line("inbetween-complete:Bandai, styles never learned; transformer trained on it"),
            Line("published:LAFAN1; interpolation"),
            Line("published:LAFAN1; Skeleton2Humanoid, network and adaptation"),
            Line("published:LAFAN1; two-stage transformer"),
        ),
    ),
    "compliance": Table(
        "scene",
        (
            Column("stiffness of a hand, N/m", ("stiffness_n_per_m",)),
            Column("force on a hand, N", ("force_mean_n", "force_n", "across_n")),
            Column("torque, N m", ("torque_nm",)),
            Column("stays up, s", ("stays_s",), "1"),
            _done("lost", "lost"),
        ),
        (
            Line("scenes:standing, hands, law off"),
            Line("scenes:standing, hands, commanded 20 N/m"),
            Line("scenes:standing, hands, commanded 160 N/m"),
            Line("scenes:standing, hands, commanded 1000 N/m"),
            Line("scenes:standing, hands, level 0.2"),
            Line("scenes:hand in hand, walking, without", "hand in hand, walking, law off"),
            Line("scenes:hand in hand, walking, level 0.16"),
            Line("scenes:hand in hand, walking, stiffness 500, lag 0.5 s"),
            Line("scenes:ball, without", "ball on a rod of 1 m, law off"),
            Line("scenes:ball, learned", "ball on a rod of 1 m, learned"),
            Line("scenes:ball, rod of 0.8 m, learned", "ball on a rod of 0.8 m, learned for 1 m"),
            Line("scenes:ball, rod of 1.2 m, learned", "ball on a rod of 1.2 m, learned for 1 m"),
        ),
    ),
    "throws": Table(
        "two hundred throws at a standing character",
        (
            Column("impulse", ("impulse_ratio",), "x"),
            Column("peak force", ("peak_ratio",), "x"),
            Column("torque", ("torque_ratio",), "x"),
            Column("goal moved, mm", ("goal_moved_mm",), "1"),
            Column("fell", ("fell",)),
        ),
        (
            Line("scenes:throws, eq8, 60 Hz, level 0", "level 0"),
            Line("scenes:throws, eq8, 60 Hz, level 0.2", "level 0.2"),
            Line("scenes:throws, stiffness, 60 Hz, 4000 N/m", "4000 N/m"),
            Line("scenes:throws, stiffness, 60 Hz, 200 N/m", "200 N/m"),
            Line("scenes:throws, stiffness, 60 Hz, 50 N/m", "50 N/m"),
        ),
    ),
    "endless": Table(
        "who follows what",
        (
            Column("falls an hour", ("falls_per_hour",)),
            Column("stayed down", ("stayed_down",)),
            Column("without a fall", ("without_a_fall",), "%"),
            Column("slide, mm/s", ("foot_slide_mm_per_s",)),
            Column("jerk, m/s³", ("jerk_m_per_s3",)),
            Column("latency p50, p99, ms", ("latency_p50_ms", "latency_p99_ms")),
            Column("losses, came back", ("losses", "came_back")),
        ),
        (
            Line("dream:futures tried, ten minutes each", "`poise dream`, policy, ten minutes each"),
            Line("dream:policy alone, ten minutes each", "the same, without trying futures"),
            Line("dream:lookahead", "`poise dream`, lookahead, ten minutes each"),
            Line("live:4 dreaming, 2 cores", "four in real time, two cores, three minutes"),
            Line("dream:its library, as recorded", "the recordings that it learned"),
            Line(
                "track:an hour of clips in a row, with recovery; policy alone",
                "an hour of clips in a row",
            ),
            Line("live:four people, otherwise free cores", "`poise live`, four people, free cores"),
            Line("live:four people, busy cores", "`poise live`, four people, busy cores"),
        ),
    ),
    "speed": Table(
        "what is stepped",
        (
            Column("simulator alone, steps/s", ("raw_steps_per_s", "raw_per_s")),
            Column("environment, steps/s", ("env_steps_per_s", "stepping_per_s")),
            Column("training, samples/s", ("training_samples_per_s", "training_per_s", "samples_per_s")),
            Column("one step, ms", ("ms_a_step",), "2"),
        ),
        (
            Line("engine:512 characters, two threads"),
            Line("engine:32 characters, 1 threads", "32 characters, one thread"),
            Line("published:MuJoCo rollout, 64 worlds, the same model"),
            Line("published:Gymnasium Humanoid-v5, 64 environments"),
            Line("published:mjlab on the CPU, 64 environments"),
            Line("engine:DeepMimic walk, learner of poise", "one clip, this learner, two cores"),
            Line("engine:DeepMimic walk, learner of rsl_rl", "one clip, rsl_rl, the same environments"),
            Line("engine:tracking, one character, one thread"),
            Line("gpu:stepping, MuJoCo on the cores", "4,096 characters, sixteen cores"),
            Line("gpu:stepping, MuJoCo Warp", "4,096 characters, one H100"),
            Line("gpu:training, physics on cuda, networks on cuda", "training the tracker, one H100"),
        ),
    ),
    "files": Table(
        "files",
        (
            _done("read", "read"),
            Column("seconds for a megabyte", ("s_per_mb",), "3"),
            _done("read, or refused in one sentence", "read_or_refused_in_one_sentence"),
            _done("the same as without a kill", "same_as_without"),
        ),
        (
            Line("read:real motion files, nothing stated"),
            Line("published:upc-pymotion, BVH files"),
            Line("published:bvhsdk, BVH files"),
            Line("published:pybvh, BVH files"),
            Line("attack:hostile files, runs and commands"),
            Line("attack:trainings killed and resumed: imitate"),
            Line("attack:trainings killed and resumed: perpetual"),
            Line("attack:trainings killed and resumed: inbetween"),
            Line("attack:trainings killed and resumed: endless"),
        ),
    ),
}
