"""`poise train perpetual` in miniature: the run, going on, Ctrl-C, what is refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from tiny_clips import deepmimic, put

from poise.cli import train_perpetual
from poise.cli.main import main
from poise.jobs.open import open_run
from poise.jobs.perpetual import perpetual_run
from poise.jobs.run_file import RUN_FILE
from poise.learn import LATEST, CloneConfig, PPOConfig
from poise.papers.perpetual.ablations import StagedPerpetual
from poise.recipes.perpetual_settings import RecoveryPlan
from poise.settings import from_toml

MINIATURE = ["--envs", "8", "--threads", "1", "--iterations", "4", "--max-primitives", "2"]


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """The recipe with networks that are trained in no time."""
    ppo = PPOConfig(horizon=4, epochs=1, std=0.02, policy_hidden=(8,), value_hidden=(8,))
    own = {"ppo": ppo, "clone": CloneConfig(steps=4, rounds=0, critic_steps=4), "style": None}
    own["recovering"] = RecoveryPlan(falls=4, trials=2, final_trials=2, seconds=(0.1, 0.2))

    def plain(additive: bool) -> StagedPerpetual:
        return StagedPerpetual.additive(**own) if additive else StagedPerpetual(**own)

    monkeypatch.setattr(train_perpetual, "recipe", plain)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    where = tmp_path_factory.mktemp("clips")
    put(where, "bend.txt", deepmimic(24))
    put(where, "stand.txt", deepmimic(16))
    return where


def command(folder: Path, out: Path, *more: str) -> list[str]:
    return ["train", "perpetual", "--library", str(folder), "-o", str(out), *MINIATURE, *more]


def test_a_run_goes_on_from_another_ones_policy(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, then = tmp_path / "first", tmp_path / "then"
    one = ("--no-multiplicative", "--no-recovery", "--help-start", "0")
    assert main(command(folder, first, *one)) == 0
    more = ("--no-recovery", "--seed", "3", "--noise", "0.5", "--set", "acceleration=0.3")
    more = (*more, "--ppo.smooth-weight", "0.02", "--ppo.epochs", "3")
    go_on = command(folder, then, *more, "--from", str(first))
    go_on = [x for x in go_on if x not in ("--max-primitives", "2")]
    assert main(go_on) == 0
    before, after = (json.loads((x / "result.json").read_text()) for x in (first, then))
    assert after["samples"] > 0 and after["clips"] == 2 * before["clips"]
    config = open_run(then).task.config
    assert (
        config.noise == (0.5,) and config.seed == 3 and not config.multiplicative and not config.expert
    )
    assert config.acceleration == 0.3 and (config.ppo.smooth_weight, config.ppo.epochs) == (0.02, 3)
    assert main([*go_on, "--resume"]) == 0
    capsys.readouterr()
    # What it says of its settings beforehand.
    assert main([*go_on, "--print-config"]) == 0
    said = tmp_path / "said.toml"
    said.write_text(capsys.readouterr().out)
    assert from_toml(StagedPerpetual, said) == config
    # What does not fit is refused before anything is written.
    wide = [str(tmp_path / "wide") if x == str(then) else x for x in go_on]
    assert main([*wide, "--ppo.smooth-over", "[1,9999]"]) == 2
    assert "smooth_over ends at 9999 of" in capsys.readouterr().err
    assert not (tmp_path / "wide").exists()
    go_on[go_on.index(str(first))], go_on[go_on.index(str(then))] = "nothing", str(tmp_path / "none")
    assert main(go_on) == 2
    assert "no such file or folder" in capsys.readouterr().err
    assert not (tmp_path / "none").exists()


def test_a_run_that_was_killed_before_its_first_checkpoint_goes_on_from_the_policy(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    first, then = tmp_path / "first", tmp_path / "then"
    assert main(command(folder, first, "--single", "--no-recovery", "--no-expert")) == 0
    go_on = ["train", "perpetual", "--library", str(folder), "-o", str(then), "--envs", "8"]
    go_on += ["--threads", "1", "--iterations", "1", "--no-recovery", "--from", str(first)]

    def killed(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(perpetual_run, "train", killed)
        assert main(go_on) != 0
    assert (then / RUN_FILE).exists() and not (then / LATEST).exists()
    assert "--resume" in "".join(capsys.readouterr())
    assert main([*go_on, "--resume"]) == 0
    before, after = (open_run(x).tracker.about["samples"] for x in (first, then))
    assert after > before


def test_a_policy_that_goes_on_has_its_own_settings_and_body(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    more = ("--from", str(tmp_path), "--mass", "120", "--goal", "keypoints")
    own = [x for x in command(folder, tmp_path / "run", *more) if x not in ("--max-primitives", "2")]
    assert main(own) == 2
    assert "there is goal, mass" in capsys.readouterr().err
    bound = {
        "ppo.policy_hidden": "[8]",
        "ppo": "{}",
        "sim.rate_hz": "120",
        "single": "true",
        "lfoot.kp": "4",
    }
    for name, value in bound.items():
        asked = ("--from", str(tmp_path), "--set", f"{name}={value}")
        own = [
            x for x in command(folder, tmp_path / "run", *asked) if x not in ("--max-primitives", "2")
        ]
        assert main(own) == 2
        assert f"there is {name}" in capsys.readouterr().err


def test_paths_and_no_expert_contradict(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(command(folder, tmp_path / "run", "--paths", "2", "--no-expert")) == 2
    assert "--paths are for the expert" in capsys.readouterr().err


def test_all_stages_by_one_command(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    assert main(command(folder, out)) == 0
    said, told = capsys.readouterr()
    assert "2 clips" in said and "Without help" in said and str(out) in said
    assert "primitive 1:" in told and "of 2 clips succeed" in told and "left" in told
    result = json.loads((out / "result.json").read_text())
    assert result["clips"] == 2 and result["help_n"] == 0.0 and result["iterations"] <= 4
    # The run is evaluated and played as any other, without help.
    assert main(["eval", str(out), "--json"]) == 0
    score = json.loads(capsys.readouterr().out)["result"]
    assert score["method"] == "perpetual" and score["help"]["limit_n"] == 0.0
    assert score["samples"] == result["samples"] > 0
    assert main(["play", str(out), "--clip", "nobody"]) == 2
    assert main(["play", str(out), "-o", str(tmp_path / "page.html")]) == 0
    capsys.readouterr()
    assert main(command(folder, out)) == 2
    assert "already holds a run" in capsys.readouterr().err
    assert main(command(folder, out, "--resume")) == 0
    assert "nothing was trained" in capsys.readouterr().out
    other = command(folder, out, "--resume", "--seed", "5", "--single")
    assert main(other) == 2
    assert "other settings (seed, single)" in capsys.readouterr().err
    shutil.copytree(folder, tmp_path / "moved")
    assert main(command(tmp_path / "moved", out, "--resume")) == 2
    assert "a run on the library" in capsys.readouterr().err


def test_ctrl_c_saves_and_says_how_to_go_on(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from poise.cli import train_perpetual as perpetual_shown

    plain = perpetual_shown.events

    def stopped(p: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(perpetual_shown, "events", stopped)
    argv = command(folder, tmp_path / "run", "--single")
    assert main(argv) == 130
    told = capsys.readouterr().err
    assert "Stopped in single; the training so far is saved. Go on with:" in told
    assert told.rstrip().endswith("--single --resume") and "poise train perpetual --library" in told
    monkeypatch.setattr(perpetual_shown, "events", plain)
    assert main([*argv, "--resume"]) == 0
    assert "one network" in capsys.readouterr().out


def test_the_switches_reach_the_run(folder: Path, tmp_path: Path, capsys) -> None:
    out, onto = tmp_path / "run", str(folder / "bend.txt")
    more = ("--goal", "keypoints", "--no-multiplicative", "--termination", "all", "--onto", onto)
    more += ("--library-fps", "stand=15", "--no-expert", "--no-style")
    assert main(command(folder, out, *more)) == 0
    said, told = capsys.readouterr()
    assert "Recovery, 2 trials each: fallen " in said and "single with recovery begins" in told
    config = open_run(out).task.config
    assert (config.goal, config.multiplicative, config.termination) == ("keypoints", False, "all")
    assert config.method == "perpetual-plain" and config.recovery
    assert config.action == "absolute" and config.style is None
    # Other frames per second of the same files are another library.
    assert main(command(folder, out, *more, "--library-fps", "bend=15", "--resume")) == 2
    assert "a run on the library" in capsys.readouterr().err
    # Half as many frames a second last twice as long.
    assert open_run(out).task.library.clips[1].seconds == pytest.approx(15 / 15)


def test_additive_actions_come_with_their_settings(folder: Path, tmp_path: Path) -> None:
    assert main(command(folder, tmp_path / "run", "--action", "additive", "--no-recovery")) == 0
    config = open_run(tmp_path / "run").task.config
    assert config.action == "additive" and config.convergence.patience == 12 and not config.recovery


def test_what_it_needs_and_refuses(folder: Path, tmp_path: Path, refused) -> None:
    out = str(tmp_path / "out")
    refused("train", "perpetual", "-o", out, words=("needs --library",))
    refused("train", "perpetual", "x.bvh", "-o", out, words=("not from single clips",))
    empty, lonely = tmp_path / "empty", tmp_path / "lonely"
    empty.mkdir()
    lonely.mkdir()
    put(lonely, "stand.txt", deepmimic(16))
    refused(*command(empty, tmp_path / "out"), words=("no motion file",))
    refused(*command(tmp_path / "absent", tmp_path / "out"), words=("no such",))
    refused(*command(lonely, tmp_path / "out"), words=("at least 2 clips", "poise imitate"))
    for more, words in (
        (("--method", "deepmimic"), "has no --method"),
        (("--help-limit", "5"), "has no --help-limit"),
        (("--max-primitives", "0"), "--max-primitives must"),
        (("--goal", "keypoints", "--action", "additive"), "of which keypoints tell nothing"),
        (("--minutes", "0"), "--minutes must be above 0"),
        (("--hold-out", "nobody"), "fits no clip"),
        (("--single", "--no-progressive"), "only one of single"),
        (("--library-fps", "walk"), "needs REGEX=VALUE"),
        (("--library-fps", "walk=fast"), "frames per second above 0, got 'fast'"),
        (("--library-fps", "(=30"), "no regular expression"),
        (("--library-skeleton", "walk=none.asf"), "none.asf: there is no such file"),
        (("--onto", "nothing.bvh"), "nothing.bvh"),
        (("--fps", "60"), "Use --library-fps"),
        (("--swap-sides",), "--swap-sides is about a single clip"),
    ):
        refused(*command(folder, tmp_path / "out", *more), words=(words,))


def test_it_trains_in_one_process(
    folder: Path, tmp_path: Path, refused, monkeypatch: pytest.MonkeyPatch
) -> None:
    sizes = {"WORLD_SIZE": "2", "LOCAL_WORLD_SIZE": "2", "RANK": "0"}
    for name, value in ({"TORCHELASTIC_RUN_ID": "x"} | sizes).items():
        monkeypatch.setenv(name, value)
    refused(*command(folder, tmp_path / "out"), words=("in one process", "without torchrun"))
