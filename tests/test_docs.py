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


tables, generate = _script("tables"), _script("generate")
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
