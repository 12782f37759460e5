"""`poise train`: a recipe on one clip or a library, without evaluation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import OmitArgPrefixes, Positional, arg

from poise.cli.console import Answer, say
from poise.cli.library_options import Library
from poise.cli.options import Body, Chosen, Json, Reading, Training, printed
from poise.cli.recipe_options import SOURCES, given
from poise.cli.train_inbetween import Network
from poise.cli.train_perpetual import BY_HAND, Primitives, goes_on, settings
from poise.cli.training import Shown, command_line, stopped
from poise.errors import PoiseError, did_you_mean
from poise.settings import imported

RECIPES = tuple(SOURCES)


#: How a single file is read, which is nothing for a folder, and what to do about it.
_OF_A_CLIP = (
    ("skeleton", "Use --library-skeleton REGEX=FILE.asf"),
    ("fps", "Use --library-fps REGEX=HZ"),
    *(
        (name, "Leave it out, or convert the files with poise convert first")
        for name in ("unit", "up", "take", "ground", "swap_sides", "allow_pickle", "smooth")
    ),
)


@dataclass(frozen=True)
class Options:
    """Train a recipe on one clip, on several clips of one skeleton or on a folder, and no more."""

    recipe: Annotated[Positional[str], arg(metavar="RECIPE")]
    """residual-force, inbetween, perpetual, endless, dual-policy, compliant, or compliant-imitation."""
    out: Annotated[Path, arg(aliases=["-o"], metavar="RUNDIR")]
    """The run folder, for poise eval and poise play."""
    clips: Annotated[
        Positional[tuple[Path, ...]], arg(metavar="CLIP ...", help_behavior_hint="(required)")
    ] = ()
    """Motion files. compliant: the scene: ball, door, throws, hands, trampoline, chicken. dual-policy:
    the kinematic policy that it follows, by default that of Poise."""
    json: Json = False
    training: OmitArgPrefixes[Training] = Training()
    recipe_settings: OmitArgPrefixes[Chosen] = field(default_factory=Chosen)
    library: OmitArgPrefixes[Library] = Library()
    network: OmitArgPrefixes[Network] = Network()
    primitives: OmitArgPrefixes[Primitives] = Primitives()
    body: OmitArgPrefixes[Body] = Body()
    reading: OmitArgPrefixes[Reading] = Reading()


def run(options: Options, argv: Sequence[str]) -> Answer:
    """Trains until the limit or Ctrl-C."""
    o = options
    if o.recipe not in RECIPES:
        raise PoiseError(
            f"there is no recipe '{o.recipe}'. {did_you_mean(o.recipe, RECIPES)}", code="unknown-recipe"
        )
    o.training.check(o.recipe_settings)
    config = config_of(o)
    if o.training.print_config:
        if o.recipe == "perpetual" and o.primitives.going_on is not None:
            config = goes_on(o, config)[1]
        return printed(config)
    again = command_line("train", argv)
    if o.recipe == "compliant":
        from poise.cli.train_compliant import run as compliant

        return compliant(config, o.out, o.training, o.primitives.going_on, again)
    if o.recipe == "dual-policy":
        from poise.cli.train_endless import control

        return control(config, o.clips, o.out, o.training, o.primitives.going_on, again)
    if o.recipe not in ("residual-force", "compliant-imitation"):
        _only_a_folder(o)
        from poise.cli.train_endless import run as endless
        from poise.cli.train_inbetween import run as inbetween
        from poise.cli.train_perpetual import run as perpetual

        if o.recipe == "endless":
            return endless(o.library, config, o.out, o.training, o.primitives.going_on, again)
        if o.recipe == "inbetween":
            return inbetween(o.library, config, o.out, o.training, again)
        return perpetual(o, config, again)
    clips = o.clips
    if o.recipe == "compliant-imitation" and o.library.library is not None:
        clips = (*clips, o.library.library)
    if not clips:
        raise PoiseError(
            "no clip was given",
            hint=f"Write poise train {o.recipe} CLIP -o RUNDIR",
            code="argument-missing",
        )
    if o.recipe == "compliant-imitation":
        from poise.cli.train_compliant import controller

        return controller(config, clips, o.reading, o.out, o.training, again)
    from poise.jobs.imitate import Job
    from poise.jobs.practice import Watching

    t = o.training
    with Shown(o.clips, o.reading, t, o.out, o.out) as shown:
        how = (t.threads, t.device, "auto", Watching(**shown.callbacks), True)
        result = Job(shown.read, o.out, config, t.until(), *how).learned()[1]
    if result.interrupted:
        return stopped(o.out, again)
    if result.last is None:
        say(f"{o.out} had reached its limit before; nothing was trained.")
    else:
        say(f"Trained {result.last.seconds:.0f} s, {result.last.samples:,} samples")
    return Answer(trained(result.last), {"run": o.out})


def trained(last: Any) -> dict[str, Any] | None:
    """What a training took, as JSON data; None where it had reached its limit before."""
    return None if last is None else {"seconds": last.seconds, "samples": last.samples}


def blank() -> Options:
    """The options of a command line that only prints its settings."""
    return Options("residual-force", Path())


def config_of(o: Options) -> Any:
    """The recipe's settings, as the command line states them; what belongs to another one is refused."""
    values = given(o.recipe_settings, o.network, o.primitives)
    default = imported(SOURCES[o.recipe])()
    known = {f.name for f in fields(default)} - ({"body"} if o.recipe == "dual-policy" else set[str]())
    own = {
        "inbetween": ("dropout",),
        "perpetual": BY_HAND,
        "endless": ("going_on",),
        "dual-policy": ("going_on", "set"),
        "compliant": ("going_on", "set"),
    }.get(o.recipe, ())
    for name in [*values, *(given(o.body) if "body" not in known else ())]:
        if name not in known and name not in own:
            option = {"num_envs": "envs", "going_on": "from"}.get(name, name.replace("_", "-"))
            raise PoiseError(
                f"the recipe {o.recipe} has no --{option}",
                hint="Leave it out",
                code="option-not-applicable",
            )
    if o.recipe == "perpetual":
        return settings(o.primitives, o.training, o.body, values)
    if o.recipe in ("endless", "dual-policy", "compliant"):
        values.pop("going_on", None)
    if o.recipe == "compliant" and o.clips:
        scene, *more = map(str, o.clips)
        if more:
            raise PoiseError(f"one scene is learned at a time, got {len(more) + 1}", code="over-limit")
        values["scene"] = scene
    if "dropout" in values:
        values["between_training.dropout"] = values.pop("dropout")
    t, clip = o.training, None
    if t.by_clip and o.clips and o.recipe not in ("compliant", "dual-policy"):
        clip = o.reading.read(o.clips[0])
    return t.settings(o.recipe, default, o.body, values, clip)


def _only_a_folder(o: Options) -> None:
    if o.clips:
        hint = f"Write poise train {o.recipe} --library DIR -o RUNDIR"
        raise PoiseError(
            f"the recipe {o.recipe} learns from a folder, not from single clips",
            hint=hint,
            code="folder-needed",
        )
    plain = Reading()
    for name, instead in _OF_A_CLIP:
        if getattr(o.reading, name) != getattr(plain, name):
            raise PoiseError(
                f"--{name.replace('_', '-')} is about a single clip",
                hint=instead,
                code="single-clip-only",
            )
