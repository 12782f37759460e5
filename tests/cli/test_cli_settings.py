"""Options that are derived from a recipe's dataclass: the same fields, types and defaults, one truth."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_type_hints

import pytest
from tiny_clips import deepmimic, put

from poise import settings
from poise.cli import imitate, train
from poise.cli.main import main
from poise.cli.parse import parse
from poise.cli.recipe_options import SOURCES, configured, dotted, stated
from poise.formats import read_clip
from poise.jobs.endless.endless_training import Endless
from poise.jobs.inbetween.inbetween_settings import Inbetween
from poise.jobs.presets import preset_of
from poise.papers.compliant.imitation_controller import CompliantImitation
from poise.papers.compliant.scene_training import Compliant
from poise.papers.perpetual.ablations import StagedPerpetual
from poise.papers.perpetual.trajopt import TrajOptConfig
from poise.papers.residual_force.dual_policy import DualPolicy
from poise.recipes import ResidualForce
from poise.settings import imported
from refusals import refused

KINDS: dict[str, Any] = {
    "residual-force": ResidualForce,
    "perpetual": StagedPerpetual,
    "inbetween": Inbetween,
    "endless": Endless,
    "compliant": Compliant,
    "compliant-imitation": CompliantImitation,
    "dual-policy": DualPolicy,
}


def imitates(*argv: str) -> ResidualForce:
    return imitate.config_of(parse(imitate.Options, ["a.bvh", "-o", "o", *argv], "poise"))


def trains(*argv: str) -> Any:
    return train.config_of(parse(train.Options, [*argv, "-o", "o"], "poise train"))


@pytest.mark.parametrize(
    ("group", "recipe"),
    [(imitate.Chosen, "residual-force"), (train.Network, "inbetween"), (train.Primitives, "perpetual")],
)
def test_options_are_those_of_the_class(group: type, recipe: str) -> None:
    kind = KINDS[recipe]
    assert imported(SOURCES[recipe]) is kind
    types, plain = settings.types_of(kind), kind()
    hints = get_type_hints(group, include_extras=True)
    own = {name for name in hints if name in types} - {"noise", "style", "teacher"}
    assert len(own) >= 2
    for name in own:
        option, told = hints[name].__origin__, hints[name].__metadata__[0]
        if option is bool:
            assert getattr(group(), name) is getattr(plain, name), name
        else:
            assert option in (types[name], types[name] | None), name
            assert told.help_behavior_hint == f"(default: {getattr(plain, name)})"
            assert getattr(group(), name) is None


def test_options_need_neither_torch_nor_mujoco() -> None:
    code = (
        "import sys\n"
        "from importlib import import_module\n"
        "from poise.cli.main import VERBS\n"
        "for verb in (*VERBS, 'play_compliant'):\n"
        "    import_module(f'poise.cli.{verb}')\n"
        "print({'torch', 'mujoco', 'numpy', 'scipy'} & {*sys.modules})"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


def test_parts_are_made_when_they_are_needed() -> None:
    @dataclass(frozen=True)
    class Whole:
        part_: Any = settings.part("poise.papers.perpetual.trajopt:TrajOptConfig", iterations=7)
        none: Any = settings.part("poise.papers.perpetual.trajopt:TrajOptConfig", made=False)

    assert Whole() == Whole(TrajOptConfig(iterations=7), None)
    assert Whole().part_ is not Whole().part_


def test_every_derived_option_has_a_help_text() -> None:
    for group in (imitate.Chosen, train.Network, train.Primitives):
        for hint in get_type_hints(group, include_extras=True).values():
            told = hint.__metadata__[0]
            assert getattr(told, "help", None) is None or len(told.help) > 12


def test_python_and_the_command_line_have_the_same_defaults() -> None:
    assert imitates() == ResidualForce() and trains("residual-force") == ResidualForce()
    assert trains("perpetual") == StagedPerpetual() and trains("inbetween") == Inbetween()
    assert trains("endless") == Endless()
    assert trains("compliant-imitation") == CompliantImitation()
    paper = trains("compliant-imitation", "--preset", "paper", "--action", "additive")
    assert paper == CompliantImitation.paper(action="additive")
    assert trains("perpetual", "--action", "additive") == StagedPerpetual.additive()


def test_what_is_stated_reaches_the_settings() -> None:
    made = imitates(
        "--method", "deepmimic", "--envs", "64", "--no-expert", "--mass", "50", "--set", "lfoot.kp=400",
        "--ppo.policy-lr", "1e-4", "--set", "horizon=99", "--sim.rate_hz=120",
    )  # fmt: skip
    plain = ResidualForce()
    assert made == replace(
        plain,
        method="deepmimic", num_envs=64, expert=False, horizon=99,
        body=replace(plain.body, mass_kg=50.0, overrides=(("lfoot.kp", 400.0),)),
        ppo=replace(plain.ppo, policy_lr=1e-4), sim=replace(plain.sim, rate_hz=120),
    )  # fmt: skip
    made = trains("perpetual", "--paths", "11", "--no-style", "--no-recovery-clips", "--single")
    plain = StagedPerpetual()
    assert made == replace(
        plain, single=True, help_start=0.0, trajopt=TrajOptConfig(iterations=11), style=None,
        recovering=replace(plain.recovering, demonstrations=0),
    )  # fmt: skip
    assert trains("perpetual", "--noise", "0.25", "0.5").noise == (0.25, 0.5)
    made = trains("inbetween", "--net", "transformer", "--dropout", "0.15", "--seed", "3")
    assert made.between_training.dropout == 0.15 and made.seed == 3


def test_presets_and_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    stand = put(tmp_path, "stand.txt", deepmimic())
    train_it = ("residual-force", str(stand), "--preset", "paper")
    assert trains(*train_it) == preset_of("residual-force", "paper", read_clip(stand))
    for recipe, name in (("perpetual", "paper"), ("perpetual", "fast"), ("inbetween", "code")):
        assert trains(recipe, "--preset", name) == preset_of(recipe, name)
    with refused("unknown-preset"):
        trains("perpetual", "--preset", "papr")
    for verb, argv in (("imitate", []), ("train", ["perpetual"]), ("train", ["inbetween"])):
        assert main([verb, *argv, "--print-config", "--seed", "7"]) == 0
        said = capsys.readouterr()
        (path := tmp_path / "c.toml").write_text(said.out)
        found = (imitates if verb == "imitate" else trains)(*argv, "--config", str(path))
        assert found == replace(KINDS[argv[0] if argv else "residual-force"](), seed=7)
    path.write_text("sead = 3\n")
    with refused("unknown-setting", says="sead"):
        imitates("--config", str(path))
    with refused("option-conflict"):
        imitates("--config", str(path), "--preset", "paper")


def test_settings_of_another_recipe_are_refused() -> None:
    for argv, option in (
        (("perpetual", "--method", "deepmimic"), "--method"),
        (("perpetual", "--dropout", "0.1"), "--dropout"),
        (("inbetween", "--single"), "--single"),
        (("inbetween", "--envs", "4"), "--envs"),
        (("inbetween", "--mass", "60"), "--mass"),
        (("residual-force", "a.bvh", "--from", "x"), "--from"),
    ):
        with refused("option-not-applicable", says=(argv[0], option)):
            trains(*argv)
    for name, what in (
        ("ppo.polcy_lr=1", ("unknown-setting", "policy_lr")),
        ("ppo.gamma=high", ("wrong-type", "high")),
        ("horizn=99", ("unknown-setting", "horizon")),
    ):
        with refused(*what):
            imitates("--set", name)


def test_dotted_options_are_settings() -> None:
    assert dotted(["--a.b-c", "3", "x.y", "--d.e=4"]) == ["--set", "a.b-c=3", "x.y", "--set", "d.e=4"]
    with refused("option-malformed"):
        dotted(["--a.b"])
    settings, other = stated(("ppo.policy-lr=1e-4", "lfoot.kp=3", "action=absolute"), ResidualForce)
    assert settings == {"ppo.policy_lr": 1e-4, "action": "absolute"} and other == ["lfoot.kp=3"]
    assert configured(plain := StagedPerpetual(style=None), {}) is plain
