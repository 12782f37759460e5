"""The documents: snippets run, commands exist, links lead somewhere."""

from __future__ import annotations

import contextlib
import importlib.util
import re
import shlex
import shutil
import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from poise.errors import PoiseError
from poise.formats import read_clip, write_clip
from poise.motion import trim

ROOT = Path(__file__).resolve().parents[1]


def _script(name: str) -> ModuleType:
    """A script of `docs/`."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "docs" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


tables, claims = _script("tables"), _script("claims")
paper_tables, generate = _script("paper_tables"), _script("generate")
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])
WALK = ROOT / "src" / "poise" / "data" / "walk.bvh"

# Shortens what a snippet does without changing which functions it calls.
_SHORTER = (
    ("minutes=3", "iterations=1, num_envs=16, expert=False"),
    ("poise.track(clip)", 'poise.track(clip, controller="policy")'),
    ("direction=asked", 'direction=asked, controller="policy"'),
    ("(0, 20, 40)", "(0, 20, 40), adapt=0"),
    ("stiffness=200.0)", 'stiffness=200.0, config=poise.TrackConfig(controller="policy"))'),
)
#: Frames of the clips that snippets read; one of them names frame 40.
_FRAMES = 50


def _text(page: Path) -> str:
    """What is written by hand on a page: the rest is the code's own."""
    return generate.by_hand(page.read_text("utf-8"))


def _blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", _text(page), re.MULTILINE | re.DOTALL)


def _commands() -> list[tuple[str, str]]:
    """(page, command line) of every `poise ...` line in a shell block or on a line of its own."""
    found = []
    for page in PAGES:
        shell = "\n".join(_blocks(page, "sh")).splitlines()
        shell += re.findall(r"^    (poise .*)$", _text(page), re.MULTILINE)
        found += [(page.name, line) for line in shell if line.startswith("poise ")]
    return found


SNIPPETS = [(page, i) for page in PAGES for i in range(len(_blocks(page, "python")))]


def _example_clip(request: pytest.FixtureRequest) -> Path:
    """The embedded walk, else a clip that lies beside the checkout."""
    if WALK.exists():
        return WALK
    return request.getfixturevalue("data_dir") / "cmu_bvh" / "fairmotion" / "01_01.bvh"


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a toy `run` and its `policy.safetensors`."""
    from poise.jobs.open import open_run
    from poise.jobs.tracker import save_tracker
    from toy_policy import toy_run

    folder = tmp_path_factory.mktemp("policy")
    save_tracker(open_run(toy_run(folder / "run")).tracker, folder / "policy.safetensors")
    return folder


@pytest.fixture(scope="module")
def net(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of an untrained in-betweening network for the embedded walk."""
    from poise.formats import read_clip
    from poise.learn.inbetween_model import MODEL, InbetweenModel, make_net, save_model
    from poise.learn.transition import SkeletonLayout
    from poise.synthesis.windows import pack_frames
    from toy_windows import SMALL

    bank = pack_frames([read_clip(WALK)])
    made = make_net("transformer", SkeletonLayout(bank.parents, bank.feet, bank.facing), SMALL, 0)
    made.calibrate(*(x[None].float() for x in (bank.root, bank.rot)), bank.offsets.float())
    folder = tmp_path_factory.mktemp("net")
    model = InbetweenModel("transformer", made, bank.names, bank.offsets[0].float(), 30.0, 60)
    save_model(folder / MODEL, model)
    return folder


@pytest.mark.parametrize(("page", "index"), SNIPPETS, ids=lambda x: getattr(x, "name", str(x)))
def test_python_snippets_run(
    page: Path,
    index: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    request: pytest.FixtureRequest,
) -> None:
    code = _blocks(page, "python")[index]
    for long, short in _SHORTER:
        code = code.replace(long, short)
    for name in re.findall(
        r"(?:read_clip|imitate|track|push|inbetween|complete|read)\(\"([\w.]+)\"", code
    ):
        if Path(name).suffix == ".bvh":
            write_clip(trim(read_clip(_example_clip(request)), 0, _FRAMES), tmp_path / name)
    if "policy.safetensors" in code:
        shutil.copytree(request.getfixturevalue("policy"), tmp_path, dirs_exist_ok=True)
    if 'Path("net")' in code:
        shutil.copytree(request.getfixturevalue("net"), tmp_path / "net")
    monkeypatch.chdir(tmp_path)
    exec(compile(code, f"{page.name}[{index}]", "exec", dont_inherit=True), {"__name__": "snippet"})
    if '.save("out")' in code:
        assert {"score.json", "report.html"} <= {p.name for p in (tmp_path / "out").iterdir()}


def test_commands_are_shown() -> None:
    verbs = {line.split()[1] for page, line in _commands() if page == "README.md"}
    assert {"info", "imitate", "play"} <= verbs


@pytest.mark.parametrize(("page", "line"), _commands())
def test_commands_parse(page: str, line: str) -> None:
    from poise.cli.main import VERBS, parser_of
    from poise.cli.parse import options_of, parse

    verb, *rest = shlex.split(line, comments=True)[1:]
    assert verb in VERBS
    try:
        name, prog, rest = parser_of(verb, rest)
        parse(options_of(import_module(f"poise.cli.{name}")), rest, prog)
    except PoiseError as problem:
        pytest.fail(f"{page}: {line}: {problem}")


def test_named_options_exist(capsys: pytest.CaptureFixture[str]) -> None:
    """Options in running text belong to some verb."""
    from poise.cli.main import VERBS
    from poise.cli.parse import options_of, parse

    known = {"--help", "--version"}
    for verb in (*VERBS, "play_compliant"):
        with contextlib.suppress(SystemExit):
            parse(options_of(import_module(f"poise.cli.{verb}")), ["--help"], f"poise {verb}")
        known |= set(re.findall(r"--[a-z][\w-]*", capsys.readouterr().out))
    for page in PAGES:
        named = set(re.findall(r"`[^`\n]*?(--[a-z][\w.-]*)", _text(page)))
        assert {n for n in named if not _is_setting(n)} <= known, page.name


def _is_setting(option: str) -> bool:
    """Whether `--style.lr` and the like name a setting of a recipe, as in its TOML file."""
    from poise.recipes import ResidualForce
    from poise.recipes.perpetual_settings import Perpetual

    def inside(value: object, path: list[str]) -> bool:
        return not path or (hasattr(value, path[0]) and inside(getattr(value, path[0]), path[1:]))

    path = option.removeprefix("--").replace("-", "_").split(".")
    return len(path) > 1 and any(inside(c, path) for c in (Perpetual().taught(), ResidualForce()))


def test_named_files_and_keys_exist() -> None:
    readme = (ROOT / "README.md").read_text("utf-8")
    targets = set(re.findall(r"`make (\w+)`", readme + (ROOT / "CONTRIBUTING.md").read_text("utf-8")))
    makefile = (ROOT / "Makefile").read_text("utf-8")
    assert targets and all(re.search(rf"^{t}:", makefile, re.MULTILINE) for t in targets)


def test_links_lead_somewhere() -> None:
    links = _script("check_links")
    assert [sentence for page in links.pages() for sentence in links.broken(page)] == []


def test_pages_are_short_and_state_no_figures() -> None:
    assert _script("check_text").problems() == []


@pytest.mark.parametrize(
    ("prose", "found"),
    [
        ("It is 3.2 mm off.", 1),
        ("Feet slide at 120 mm/s, 2.4 times the clip's.", 2),
        ("Success is 97 %, 130 of 132 clips.", 2),
        ("A ratio of .93.", 1),
        ("Control runs at `30` Hz; give `--fps 60`.", 0),
        ("Frames 0, 30 and 60 are keyframes, ten minutes each.", 0),
        ("<!-- table: unseen -->\n\n| 97 % | 3.2 mm |\n\n<!-- end -->", 0),
        ("    poise imitate walk.bvh --minutes 10  # 10 minutes", 0),
        ("As Sec. 4.1 and Section 5.2.1 say, 4.1 mm off.", 1),
    ],
)
def test_figures_in_prose_are_found(prose: str, found: int) -> None:
    assert len(_script("check_text").figures(prose)) == found


def test_generated_parts_are_current(capsys: pytest.CaptureFixture[str]) -> None:
    """`python docs/generate.py` has nothing to write."""
    assert generate.main(["--check"]) == 0, capsys.readouterr().out


def test_a_table_without_its_row_is_an_error() -> None:
    line = tables.Line("track:no such clips")
    table = tables.Table("clips", (tables.Column("done", ("done",), "%"),), (line,))
    with pytest.raises(KeyError, match="no such clips"):
        tables.markdown(table, tables.Results.read())


@pytest.mark.parametrize(
    ("value", "form", "text"),
    [
        ("0.9695", "%", "97 %"),
        ("0.907", "%", "90.7 %"),
        ("1.347", "x", "1.35 x"),
        ("1582.1", "0", "1,582"),
        ("-0.01", "0", "0"),
        ("", "%", ""),
    ],
)
def test_numbers_are_written_as_their_column_says(value: str, form: str, text: str) -> None:
    assert tables.written(value, form) == text


def _results(*rows: tuple[str, str, float, str, int, int, str]) -> Any:
    """Made-up rows: subject, metric, value, spread, n, seeds, policy."""
    made = tables.Results(ships={"tracker-v2": "2" * 16}, steps={"2" * 16: 4e8})
    names = ("subject", "metric", "value", "spread", "n", "seeds", "policy")
    for row in rows:
        told = {k: str(v) for k, v in zip(names, row, strict=True)}
        suite = "published" if told["policy"] == "published" else "papers"
        told |= {"suite": suite, "command": "python x.py", "commit": "abc"}
        made.rows[suite, row[0], row[1]] = told
    return made


_V = claims.Value


@pytest.mark.parametrize(
    ("says", "sign", "ours", "other", "told"),
    [
        # Intervals that do not meet, in the paper's sense and against it.
        ("better", -1, _V(1.0, 0.9, 1.1), _V(2.0, 1.8, 2.2), "shown"),
        ("better", 1, _V(1.0, 0.9, 1.1), _V(2.0, 1.8, 2.2), "the other way"),
        ("worse", 1, _V(1.0, 0.9, 1.1), _V(2.0, 1.8, 2.2), "shown"),
        ("better", -1, _V(1.0, 0.9, 1.9), _V(2.0, 1.8, 2.2), "not shown (intervals meet)"),
        ("better", -1, _V(1.0), _V(2.0, 1.8, 2.2), "not shown (no interval)"),
        ("better", -1, None, _V(2.0, 1.8, 2.2), "not run"),
        ("better", -1, _V(1.0, 0.9, 1.1), None, "not run"),
        # Two seeds must lie farther apart than the wider range is wide, three need not.
        ("better", -1, _V(1.0, 0.9, 1.1, 2), _V(1.4, 1.2, 1.6, 2), "not shown (intervals meet)"),
        ("better", -1, _V(1.0, 0.9, 1.1, 2), _V(2.0, 1.8, 2.2, 2), "shown"),
        ("better", -1, _V(1.0, 0.9, 1.1, 3), _V(1.4, 1.2, 1.6, 3), "shown"),
        # The paper's own figure is one point.
        ("reaches", 1, _V(0.97, 0.95, 0.99), _V(0.95, 0.95, 0.95), "shown"),
        ("reaches", 1, _V(0.97, 0.95, 0.99), _V(0.96, 0.96, 0.96), "not shown (intervals meet)"),
        ("reaches", 1, _V(0.97, 0.95, 0.99), _V(0.995, 0.995, 0.995), "the other way"),
        # The whole difference within a tenth, partly, not at all.
        ("alike", 1, _V(1.0, 0.99, 1.01), _V(1.0, 0.98, 1.02), "shown"),
        ("alike", 1, _V(1.0, 0.8, 1.2), _V(1.0, 0.98, 1.02), "not shown (too wide)"),
        ("alike", 1, _V(2.0, 1.9, 2.1), _V(1.0, 0.98, 1.02), "the other way"),
    ],
)
def test_a_verdict_follows_from_the_intervals(
    says: str, sign: int, ours: Any, other: Any, told: str
) -> None:
    assert claims.verdict(says, sign, ours, other) == told


def test_intervals_are_those_of_their_rows() -> None:
    share, plain = claims.share("done", "done"), claims.Measure("off", "off", "1", -1)

    def of(*rows: tuple[float, str, int, int], measure: Any = plain) -> Any:
        texts = [
            {"value": str(v), "spread": spread, "n": str(n), "seeds": str(seeds)}
            for v, spread, n, seeds in rows
        ]
        return claims.value_of(texts, measure)

    assert of() is None
    assert not of((3.0, "", 40, 1)).known
    assert of((3.0, "2.5 to 1e+01", 40, 1)) == _V(3.0, 2.5, 10.0, 0)
    assert of((3.0, "2 to 4", 40, 2)) == _V(3.0, 2.0, 4.0, 2)
    assert of((3.0, "-1 to 4", 40, 1)).low == -1.0
    assert of((3.0, "+- 0.5", 40, 1)) == _V(3.0, 2.0, 4.0, 0)
    assert of((3.0, "", 40, 1), (4.0, "", 40, 1), (8.0, "", 40, 1)) == _V(5.0, 3.0, 8.0, 3)
    # Wilson's interval of 19 of 20.
    found = of((0.95, "", 20, 1), measure=share)
    assert (round(found.low, 3), round(found.high, 3)) == (0.764, 0.991)
    assert not of((1.0, "", 1, 1), measure=share).known


def test_a_papers_table_stands_beside_ours() -> None:
    measures = (claims.share("done", "done"), claims.Measure("off, mm", "off", "1", -1))
    table = claims.PaperTable(
        measures,
        (
            claims.Claim("theirs", "papers:b, seed *", paper="P; b"),
            claims.Claim("ours", "papers:a, seed *", "better", "papers:b, seed *", "theirs", "P; a"),
            claims.Claim("older", "papers:c", "better", "papers:a, seed 0", "ours"),
            claims.Claim("never tried", "papers:d", "better", "papers:b, seed *", "theirs"),
            claims.Claim("gone", "papers:e", optional=True),
        ),
        "python -m benchmarks papers",
        "P; any",
    )
    now, before = f"tracker-v2 {'2' * 16}", f"tracker-v1 {'1' * 16}"
    trained = "a (trained for this table)"
    results = _results(
        ("P; a", "done", 0.9, "", 140, "", "published"),
        ("P; any", "samples", 75e6, "", "", "", "published"),
        *((f"a, seed {k}", "done", 0.9 + k / 100, "", 20, 1, now) for k in range(3)),
        *((f"a, seed {k}", "off", 30.0 + k, "", 20, 1, now) for k in range(3)),
        *((f"b, seed {k}", "done", 0.5 + k / 100, "", 20, 1, trained) for k in range(3)),
        *((f"b, seed {k}", "off", 31.0 + k, "", 20, 1, trained) for k in range(3)),
        ("c", "done", 0.2, "0.1 to 0.3", 20, 1, before),
    )
    text = claims.paper_markdown(table, results)
    theirs, ours, older, never = [row.split(" | ") for row in text.splitlines()[2:6]]
    assert theirs[-1] == "- |" and theirs[-2] == "trained for this table"
    assert ours[0] == "| ours: better than theirs" and ours[1] == "90 %; -"
    assert ours[2] == "91 % (90 to 92); 31.0 (30.0 to 32.0)"
    assert ours[4:8] == ["20", "3", "400 million", "tracker-v2"]
    assert ours[-1] == "shown: done; not shown (intervals meet): off |"
    assert older[-2] == "of tracker-v1, not what ships"
    assert older[-1] == "not shown (other policies): done; not run: off |"
    assert never[2] == "not run: `python -m benchmarks papers`" and never[-1] == "not run |"
    assert "gone" not in text and "The paper: 75 million control steps" in text
    assert text.endswith("    python x.py  # abc")


def test_clips_are_compared_in_pairs() -> None:
    results = _results(
        *((f"{c}; a", "off", v, "", 1, 1, "") for c, v in (("x", 5.0), ("y", 8.0), ("z", 2.0))),
        *((f"{c}; b", "off", v, "", 1, 1, "") for c, v in (("x", 6.0), ("y", 9.1), ("z", 3.1))),
    )
    claim = claims.Claim("a", "papers:{}; a", "better", "papers:{}; b", "b", over=("x", "y", "z", "w"))
    table = claims.PaperTable((claims.Measure("off", "off", "1", -1),), (claim,))
    row = claims.paper_markdown(table, results).splitlines()[2].split(" | ")
    assert row[2] == "-1.1 (-1.2 to -0.9)" and row[4] == "3 pairs" and row[-1] == "shown |"


def test_rows_of_papers_name_what_is_there() -> None:
    """Papers' rows are in `published.csv`; commands are of a suite and a part, which makes rows."""
    from benchmarks.__main__ import arguments
    from benchmarks.common.runner import parts_of

    results = tables.Results.read()
    printed = {subject for suite, subject, _ in results.rows if suite == "published"}
    for name, table in paper_tables.PAPER_TABLES.items():
        for claim in table.claims:
            assert not claim.paper or claim.paper in printed, f"{name}: {claim.paper}"
            command = table.run if claim.run is None else claim.run
            if command:
                told = arguments().parse_args(shlex.split(command)[3:])
                parts = parts_of(told.suite)
                assert all(any(p.startswith(o) for p in parts) for o in told.only), command
    known = {name for page in generate.generated() for name in _marked(page)}
    assert {*paper_tables.PAPER_TABLES} <= known


def _marked(page: Path) -> list[str]:
    return re.findall(r"<!-- table: ([\w-]+) -->", page.read_text("utf-8"))
