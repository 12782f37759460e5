"""info, convert, body, eval, play, doctor and the frame around them."""

from __future__ import annotations

import io
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from tiny_clips import ASF, amc, bvh, put

import poise
from poise.cli import options
from poise.cli.info import KEYS
from poise.cli.main import VERBS, main
from poise.cli.options import override
from poise.errors import PoiseError
from refusals import refused

SNAPSHOTS = Path(__file__).parent / "snapshots"
#: Set to write the help texts anew.
UPDATE = "POISE_UPDATE_SNAPSHOTS"


def call(*argv: object, **env: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "poise", *map(str, argv)],
        capture_output=True,
        text=True,
        env={**os.environ, **env},
        check=False,
        timeout=120,
    )


@pytest.mark.parametrize("verb", ["", *VERBS])
def test_help_texts_are_as_they_were(verb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.setenv("NO_COLOR", "1")
    # The frames are drawn with lines only where stdout says that it takes UTF-8.
    page = io.TextIOWrapper(io.BytesIO(), encoding="utf-8")
    monkeypatch.setattr("sys.stdout", page)
    assert main([verb, "--help"] if verb else []) == 0
    page.flush()
    shown = page.buffer.getvalue().decode("utf-8")  # type: ignore[attr-defined]
    text = "\n".join(x.rstrip() for x in shown.splitlines()) + "\n"
    path = SNAPSHOTS / f"{verb or 'poise'}.txt"
    if os.environ.get(UPDATE):
        path.write_text(text, encoding="utf-8")
    assert text == path.read_text(encoding="utf-8"), f"set {UPDATE}=1 to accept the new text"


def test_info_loads_no_physics() -> None:
    """It answers within two or three seconds, most of which torch takes."""
    walk = Path(poise.__file__).parent / "data/walk.bvh"
    code = (
        "import sys; from poise.cli.main import main; main(['info', sys.argv[1]]); "
        "assert not {'mujoco', 'scipy.linalg', 'jinja2'} & set(sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(walk)], capture_output=True, text=True, check=False, timeout=120
    )
    assert done.returncode == 0, done.stderr


def test_version_and_help_come_quickly_and_without_torch() -> None:
    start = time.perf_counter()
    done = call("--version")
    assert done.stdout == f"poise {poise.__version__}\n" and done.returncode == 0
    # A loaded machine gets some slack; the command itself takes 0.1 s.
    assert time.perf_counter() - start < 2.0
    for argv, heavy in (
        *((x, ("torch", "mujoco", "numpy", "rich", "tyro")) for x in ([], ["--help"], ["--version"])),
        (["imitate", "--help"], ("torch", "mujoco", "numpy")),
    ):
        code = f"import sys, poise.cli.main as m; code = m.main({argv}); "
        code += f"sys.exit(code or 3 * any(x in sys.modules for x in {heavy}))"
        assert subprocess.run([sys.executable, "-c", code], capture_output=True).returncode == 0, argv


def test_every_verb_says_what_it_does_before_it_imports_what_takes_seconds() -> None:
    given = {
        "doctor": [],
        "convert": ["a.bvh", "b.bvh"],
        "retarget": ["a.bvh", "--onto", "b.bvh", "-o", "c.bvh"],
        "train": ["residual-force", "a.bvh", "-o", "out"],
        "inbetween": ["a.bvh", "--keyframes", "0,5", "-o", "out.bvh"],
        "complete": ["a.bvh", "--keyframes", "0,5", "-o", "out"],
        "dream": ["-o", "out"],
        "demo": [],
    }
    out = ("imitate", "track", "push", "fleet")
    lines = [
        [verb, *given.get(verb, ["a.bvh", *(["-o", "out"] if verb in out else [])])] for verb in VERBS
    ]
    # In one process: what one of them imports, it imports for all.
    code = (
        "import sys, poise.cli.console as c, poise.cli.main as m\n"
        "def tell(text, style=''):\n"
        "    sys.exit(7 + any(x in sys.modules for x in ('torch', 'mujoco', 'numpy')))\n"
        "c.tell = tell\n"
        f"for line in {lines}:\n"
        "    try:\n"
        "        code = m.main(line)\n"
        "    except SystemExit as told:\n"
        "        code = told.code\n"
        "    assert code == 7, (line, code)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_an_unknown_verb_is_answered_with_the_nearest(refused) -> None:
    refused("imitat", words=("'imitat'", "Did you mean 'imitate'?"))


def test_what_tyro_refuses_becomes_one_sentence() -> None:
    import tyro

    from poise.cli.imitate import Options
    from poise.cli.parse import TRIED, joined, parse

    # The events are private to tyro: where this fails after an upgrade, try the sentences below again.
    assert tyro.__version__ == TRIED or tyro.__version__.split(".")[:2] == TRIED.split(".")[:2]

    def said(*argv: str) -> str:
        with pytest.raises(PoiseError) as problem:
            parse(Options, argv, "poise imitate")
        text = str(problem.value)
        assert text.endswith(". See poise imitate --help") or "? See poise imitate --help" in text
        return text.removesuffix(" See poise imitate --help").rstrip(".")

    # Help is wrapped at the window's width alone, not where docstrings in the source are.
    assert (
        joined("It walks\n    and (then)\n    0 runs.\n\n    Or not.")
        == "It walks and (then) 0 runs.\n\nOr not."
    )
    given = ("a.bvh", "-o", "out")
    assert said("a.bvh") == "poise imitate needs -o DIR|FILE"
    assert said() == "poise imitate needs CLIP and -o DIR|FILE"
    near = "there is no option --minuts. Did you mean --minutes?"
    assert said(*given, "--minuts", "3") == near
    assert said(*given, "--xyzzy") == "there is no option --xyzzy"
    assert said(*given, "b.bvh") == "b.bvh is one argument too many"
    assert said(*given, "--up", "Q") == "--up cannot be 'Q'. Known: -X, -Y, -Z, X, Y, Z"
    assert said(*given, "--fps", "soon") == "--fps needs a number, got 'soon'"
    assert said(*given, "--envs", "1.5") == "--envs needs a whole number, got '1.5'"
    assert said(*given, "--fps") == "--fps needs a value"


def test_choices_are_those_of_the_parts_behind_them() -> None:
    from poise.cli.train import RECIPES
    from poise.jobs.inbetween import inbetween_training as inbetween
    from poise.metrics.tracking_errors import RULES
    from poise.papers.compliant import imitation_controller, scene_training
    from poise.papers.residual_force import dual_run
    from poise.recipes import RECIPE, perpetual

    assert get_args(options.Rule) == tuple(RULES)
    assert (
        RECIPE["name"],
        inbetween.RECIPE["name"],
        perpetual.RECIPE["name"],
        "endless",
        scene_training.RECIPE["name"],
        imitation_controller.RECIPE["name"],
        dual_run.NAME,
    ) == RECIPES


def test_info_json_holds_exactly_the_keys(clip: Path, answered) -> None:
    facts = answered("info", clip)["result"]
    assert tuple(facts) == KEYS
    assert facts["frames"] == 16 and facts["format"] == "deepmimic" and facts["unit_m"] == 1.0


def test_info_of_several_clips(
    clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], answered
) -> None:
    walk = put(tmp_path, "walk [bold].bvh", bvh())
    assert main(["info", str(clip), str(walk)]) == 0
    said = capsys.readouterr().out
    assert "walk [bold].bvh" in said and "The file states no unit" in said and "15" in said
    assert [f["format"] for f in answered("info", clip, walk)["result"]] == ["deepmimic", "bvh"]


def test_info_takes_the_reading_options(tmp_path: Path, answered) -> None:
    walk = put(tmp_path, "walk.bvh", bvh())
    facts = answered("info", walk, "--fps", "25", "--unit", "0.012", "--up", "Z")["result"]
    assert (facts["fps"], facts["unit_m"], facts["up_axis"]) == (25.0, 0.012, "Z")
    facts = answered("info", walk, "--unit", "cm")["result"]
    assert facts["unit_m"] == 0.01 and main(["info", str(walk), "--unit", "feet"]) == 2
    motion = put(tmp_path, "02_01.amc", amc())
    skeleton = put(tmp_path, "other.asf", ASF)
    assert answered("info", motion, "--skeleton", skeleton)["result"]["joints"] == 5


def test_convert_and_resample(
    clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], answered
) -> None:
    target = tmp_path / "half.bvh"
    assert main(["convert", str(clip), str(target), "--resample", "15"]) == 0
    assert str(target) in capsys.readouterr().out
    again = answered("convert", clip, "-o", target, "--resample", "15", "--force")
    assert again["outputs"] == {"clip": str(target)} and again["result"]["frames"] == 8
    facts = answered("info", target)["result"]
    assert facts["frames"] == 8 and facts["fps"] == pytest.approx(15.0)


def test_convert_takes_a_part(clip: Path, tmp_path: Path, answered, refused) -> None:
    whole, part = poise.read(clip), tmp_path / "part.bvh"
    assert answered("convert", clip, part, "--frames", "2-7")["result"]["frames"] == 6
    got = poise.read(part)
    np.testing.assert_allclose(got.root_pos, whole.root_pos[2:8], atol=1e-5)
    for words in ("7-2", "0-9999", "-1-3", "a-b", "3"):
        refused("convert", clip, tmp_path / "x.bvh", f"--frames={words}", words=("--frames",))


def test_convert_refuses_unknown_suffixes_and_itself(clip: Path, tmp_path: Path, refused) -> None:
    refused("convert", clip, tmp_path / "x.amc", words=("amc", ".bvh"))
    refused("convert", clip, clip, words=("over itself",))
    refused("convert", clip, tmp_path / "x.bvh", "--resample", "0", words=("frame rate",))
    refused("convert", clip, words=("needs OUT", "-o OUT"))
    refused("convert", clip, tmp_path / "x.bvh", "-o", tmp_path / "y.bvh", words=("twice",))


def test_body_lists_what_is_trained(clip: Path, capsys: pytest.CaptureFixture[str], answered) -> None:
    command = ["body", str(clip), "--mass", "50", "--set", "right_ankle.kp=123"]
    facts = answered(*command)["result"]
    rows = {row["body"]: row for row in facts["bodies"]}
    assert facts["mass_kg"] == pytest.approx(50.0) and rows["right_ankle"]["kp"] == 123.0
    assert main(command) == 0
    assert "right_ankle" in capsys.readouterr().out


def test_body_is_written_as_mjcf(clip: Path, tmp_path: Path, answered, refused) -> None:
    import mujoco

    path = tmp_path / "body.xml"
    found = answered("body", clip, "-o", path)
    assert found["outputs"] == {"body": str(path)}
    model = mujoco.MjModel.from_xml_path(str(path))
    assert model.nu == found["result"]["hinges"]
    refused("body", clip, "-o", path, words=("is there already", "--force"))
    refused("body", clip, "-o", tmp_path / "body.urdf", words=("MJCF",))
    assert main(["body", str(clip), "-o", str(path), "--force"]) == 0


def test_eval_writes_rollouts(trained: Path, tmp_path: Path, answered, refused) -> None:
    path = tmp_path / "steps.npz"
    assert answered("eval", trained, "--rollouts", path)["outputs"] == {"rollouts": str(path)}
    with np.load(path) as steps:
        assert len(steps["obs"]) == len(steps["actions"]) > 0
    refused("eval", trained, "--rollouts", path, words=("is there already", "--force"))
    refused("eval", trained, "--rollouts", tmp_path / "steps.csv", words=(".npz",))


def test_overrides_are_name_and_number() -> None:
    assert override("lfoot.kp=4e2") == ("lfoot.kp", 400.0)
    for text in ("lfoot.kp", "=3", "lfoot.kp=much"):
        with refused("option-malformed", says="--set"):
            override(text)


def test_doctor(answered) -> None:
    facts = answered("doctor")["result"]
    states = {c["name"]: c["state"] for c in facts["checks"]}
    assert facts["ready"]
    assert {states[n] for n in ("python", "torch", "mujoco", "mujoco.batch", "physics")} == {"ok"}
    assert all(c["todo"] for c in facts["checks"] if c["state"] != "ok")


def test_doctor_says_what_is_missing(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from poise.cli import doctor

    absent = doctor.package("no_such_package_at_all", "none", "pip install it")
    monkeypatch.setattr(doctor, "CHECKS", (doctor.python, absent))
    assert main(["doctor"]) == 1
    said = capsys.readouterr().out
    assert "missing" in said and "pip install it" in said


def test_an_unexpected_fault_is_one_sentence(
    clip: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise ZeroDivisionError("[red]half\nway[/red]")

    monkeypatch.setattr("poise.formats.read_clip", broken)
    assert main(["info", str(clip)]) == 1
    complained = capsys.readouterr().err
    assert complained.count("\n") == 2 and "[red]half way[/red]" in complained
    assert "ZeroDivisionError" in complained and "POISE_DEBUG=1" in complained
    monkeypatch.setenv("POISE_DEBUG", "1")
    assert main(["info", str(clip)]) == 1
    assert "Traceback" in capsys.readouterr().err


def test_a_full_disk_and_a_lack_of_memory(
    clip: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for problem, code in ((OSError(28, "No space left on device"), 2), (MemoryError(), 1)):

        def broken(*_: object, problem: BaseException = problem, **__: object) -> None:
            raise problem

        monkeypatch.setattr("poise.formats.read_clip", broken)
        assert main(["info", str(clip)]) == code
        complained = capsys.readouterr().err
        assert complained.startswith("reading ") and complained.count("\nerror: ") == 1


def test_ctrl_c_anywhere(
    clip: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("poise.formats.read_clip", stopped)
    assert main(["info", str(clip)]) == 130
    assert capsys.readouterr().err == f"reading {clip}\nerror: interrupted\n"


@pytest.mark.skipif(os.name != "posix", reason="pipes of a shell")
def test_a_closed_pipe_is_quiet() -> None:
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run(
        [sys.executable, "-m", "poise", "imitate", "--help"], stdout=write, stderr=subprocess.PIPE
    )
    os.close(write)
    assert done.stderr == b"" and done.returncode in (0, 141)
