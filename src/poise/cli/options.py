"""Options that several verbs share, where a verb writes, and a folder as input."""

from __future__ import annotations

import contextlib
import math
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias, TypeVar

from tyro.conf import UseAppendAction, arg

from poise.cli.console import INTERRUPTED, LOST, REFUSED, Answer, document, failure, say, table, tell
from poise.cli.recipe_options import base_of, configured, derived, stated
from poise.errors import PoiseError

if TYPE_CHECKING:
    from poise.body import BodyConfig
    from poise.learn import Until
    from poise.motion import Clip
    from poise.plan import LookaheadConfig

    Chosen: TypeAlias = Any
else:
    Chosen = derived(
        "residual-force", "", "method", "help_limit", "help_start", "reward", "seed", "expert",
        num_envs="envs",
    )  # fmt: skip
T = TypeVar("T")

#: A switch; its help states no default, which the sentence tells.
Flag = Annotated[bool, arg(help_behavior_hint="")]


def _option(help: str, metavar: str | None = None, **how: Any) -> Any:
    return arg(help=help, metavar=metavar, **{"help_behavior_hint": "", **how})


#: Options that several verbs have, with what their help says.
Json = Annotated[bool, _option("Print one JSON document and nothing else on stdout, see docs/cli.md.")]
Force = Annotated[bool, _option("Write over files that are there.")]
OpenPage = Annotated[bool, _option("Open the page in the browser.")]
_OUT = """The folder of the results; or the file of the motion (.bvh, .glb, .npz, ...), and the rest goes
into a folder of its name."""
Out = Annotated[Path, arg(help=" ".join(_OUT.split()), aliases=["-o"], metavar="DIR|FILE")]
_FEET = "Leave feet as simulated; by default standing feet are held to the spot in the written motion."
HoldFeet = Annotated[bool, _option(_FEET)]
_POLICY = """A policy file, the folder of a run of poise train perpetual, or keypoints, the policy that
comes along and is told places alone; by default the one for rotations that comes with Poise."""
PolicyFile = Annotated[Path | None, _option(" ".join(_POLICY.split()), "FILE|RUN")]
Threads = Annotated[int, arg(metavar="N", help="Cores; 0 is all.")]
Budget = Annotated[float | None, arg(metavar="STEPS", help_behavior_hint="")]
_PLACE = """A clip that walks in place is simulated with the travel that its feet tell. auto writes it in
place again, a loop as a loop; travel writes it with its travel; keep simulates it as it is."""
InPlaceMode = Annotated[Literal["auto", "keep", "travel"], arg(help=" ".join(_PLACE.split()))]
Device = Annotated[str, arg(metavar="cpu|cuda")]
#: `formats.guess.UPS`; stated here since motion is imported only when a verb reads.
Up = Literal["Y", "Z", "X", "-Y", "-Z", "-X"]
Rule = Literal["phc", "phc_strict", "any_25cm", "rfc_height", "s2h_root"]


#: Units that --unit knows by name, in metres.
UNITS = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}


@dataclass(frozen=True)
class Reading:
    """How a motion file is read; all of it is guessed or read from the file by default."""

    skeleton: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """The ASF skeleton of an AMC motion."""
    fps: Annotated[float | None, arg(metavar="F", help_behavior_hint="")] = None
    """Frames per second."""
    unit: Annotated[str | None, arg(metavar="METRES", help_behavior_hint="")] = None
    """Metres in one unit of the file, 0.01 for example; or m, dm, cm, mm, in, ft."""
    up: Annotated[Up | None, arg(metavar="Y|Z|X|-Y|-Z|-X", help_behavior_hint="")] = None
    """The axis of the file that points up: Y, Z or X, with - where it points down."""
    take: Annotated[str | None, arg(metavar="NAME|N", help_behavior_hint="")] = None
    """Which animation of a file that holds several (glTF, USD; by default the longest), or which of its
    people (TRC, C3D, CSV, arrays; by default the first)."""
    ground: Annotated[str | None, arg(metavar="METRES|auto", help_behavior_hint="")] = None
    """The floor's height, which becomes 0; auto takes the one that the soles tell."""
    swap_sides: Flag = False
    """Exchange the names of left and right joints."""
    allow_pickle: Flag = False
    """Read pickled files (AIST++ .pkl, poselib .npy) as plain arrays; no code of theirs runs."""

    smooth: Annotated[float | None, arg(metavar="HZ", help_behavior_hint="")] = None
    """Cut-off of a low-pass on keypoints (TRC, C3D, CSV), in place of what their noise asks for."""
    raw: Flag = False
    """Follow the motion as the file has it: no tremble is taken off, of joints or of keypoints, and no
    joint that was lost is filled in."""

    def read(self, path: Path) -> Clip:
        """The clip in the file `path`."""
        from poise.formats import read_clip

        floor = self._floor()
        clip = read_clip(
            path,
            skeleton=self.skeleton,
            fps=self.fps,
            unit_m=self.unit_m(),
            up_axis=self.up,
            allow_pickle=self.allow_pickle,
            take=self.take,
            smooth_hz=self.smooth,
            raw=self.raw,
        )
        if clip.skeleton.source.rates:
            from poise.kinematics.rate import settled

            clip = settled(clip)
        if self.swap_sides or self.ground is not None:
            from poise.kinematics import anatomy_of, grounded, support_of, swap_sides

            clip = swap_sides(clip) if self.swap_sides else clip
            if self.ground is not None:
                support = support_of(clip, anatomy_of(clip)) if floor is None else None
                clip = grounded(clip, support, floor)
        return clip

    def unit_m(self) -> float | None:
        """Metres in one unit of the file, None where nothing is stated."""
        if self.unit is None or self.unit in UNITS:
            return UNITS.get(self.unit or "")
        try:
            return float(self.unit)
        except ValueError:
            hint = f"Known names: {', '.join(UNITS)}"
            raise PoiseError(
                f"--unit needs metres or a name, got '{self.unit}'", hint=hint, code="unit-unknown"
            ) from None

    def _floor(self) -> float | None:
        """The stated height of the floor in m, None where it is to be guessed or stays."""
        if self.ground is None or self.ground == "auto":
            return None
        try:
            height = float(self.ground)
        except ValueError:
            height = math.nan
        if not abs(height) < 1000.0:
            raise PoiseError(
                f"--ground needs a height in metres or auto, got '{self.ground}'",
                code="option-malformed",
            )
        return height


Texts: TypeAlias = UseAppendAction[tuple[str, ...]]


@dataclass(frozen=True)
class Directing:
    """A director's wishes for a motion, and how well it is looked for."""

    weight: Annotated[Texts, arg(metavar="PART=FACTOR[:A-B]")] = ()
    """Parts that lookahead minds more than the rest, such as hands=3, or head=2:10-40 in frames."""
    pin: Annotated[Texts, arg(metavar="LIMB:A-B")] = ()
    """Hands or feet that stay where they are in frames A to B, such as left_foot:12-40."""
    touch: Annotated[Texts, arg(metavar="LIMB:FRAME:X,Y,Z")] = ()
    """Points that hands or feet reach, in m, Z up, such as right_hand:50:0.3,0.2,1.1."""
    push: Annotated[Texts, arg(metavar="FRAME:PART=NEWTONS[:SECONDS[:X,Y,Z]]")] = ()
    """Pushes that begin at a frame, such as 30:hand=150, or 30:chest=200:0.3:0,1,0: parts and directions
    as of poise push, to which the character gives way."""
    stiffness: Annotated[Texts, arg(metavar="FRAME=N/M")] = ()
    """From a frame on, give way to pushes as a spring of so many newtons per metre: 30=200."""
    held: Annotated[Texts, arg(metavar="A-B:HAND=KG[:SIZE]")] = ()
    """A thing that a hand holds from frame A to B, such as 30-60:right_hand=2.5, a cube of 0.2 m or SIZE
    that touches nothing."""
    span: Annotated[str | None, arg(name="range", metavar="A-B", help_behavior_hint="")] = None
    """Simulate only A to B anew, in s, such as 2.0-3.5; the rest stays as --from has it."""
    earlier: Annotated[Path | None, arg(name="from", metavar="RESULT", help_behavior_hint="")] = None
    """The folder of an earlier result of the same motion, for --range."""
    budget: Budget = None
    """Simulated control steps of lookahead for each that is made, by default 192, or 768 for keyframes.
    More are nearer and cleaner, and take longer."""

    def values(self) -> dict[str, Any]:
        """The wishes, as settings of `TrackConfig`.

        Raises:
            PoiseError: words that make no sense.
        """
        from poise.jobs.track.direction import direction_of
        from poise.jobs.track.simulation import retake_of

        return {
            "direction": direction_of(
                self.weight, self.pin, self.touch, self.push, self.stiffness, self.held
            ),
            "retake": retake_of(self.span, self.earlier),
            "lookahead": lookahead_of(self.budget),
        }


def lookahead_of(budget: float | None) -> LookaheadConfig:
    """Lookahead with so many simulated control steps for each that is made."""
    check_range("budget", budget, 1, 1_000_000)
    from poise.plan import LookaheadConfig

    return LookaheadConfig() if budget is None else LookaheadConfig().with_budget(budget)


@dataclass(frozen=True)
class Body:
    """What may be stated about the body that is made."""

    mass: Annotated[float | None, arg(metavar="KG", help_behavior_hint="")] = None
    """Total mass; by default that of body mass index 22 at the clip's height."""
    body: Annotated[Path | None, arg(metavar="FILE.xml", help_behavior_hint="")] = None
    """A body of your own in MJCF in place of a generated one; the clip is retargeted onto it."""
    set: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="NAME=VALUE")] = ()
    """One value of the body, such as lfoot.kp=400, or a setting of the recipe, such as ppo.gamma=0.97,
    which can also be written as --ppo.gamma 0.97."""

    def values(self, overrides: Sequence[str]) -> dict[str, Any]:
        """What is stated, by the name of the setting. overrides: the values of the body in `set`."""
        own = None if self.body is None else str(self.body)
        all_of_them = [list(override(text)) for text in overrides]
        said = {"mass_kg": self.mass, "mjcf": own, "overrides": all_of_them or None}
        return {f"body.{name}": value for name, value in said.items() if value is not None}

    def config(self) -> BodyConfig:
        """The settings of the body generator."""
        from poise.body import BodyConfig

        values = self.values(self.set)
        return configured(BodyConfig(), {k.partition(".")[2]: v for k, v in values.items()})


def check_range(name: str, value: float | None, low: float, high: float = 2**31 - 1) -> None:
    """Refuses an option --`name` that does not lie in `low` to `high`; None was not given."""
    if value is not None and not low <= value <= high:
        where = f"be at least {low:g}" if high == 2**31 - 1 else f"lie in {low:g} to {high:g}"
        raise PoiseError(f"--{name} must {where}, got {value}", code="out-of-range")


def check_device(name: str) -> None:
    """Refuses a device on which nothing could run, before anything is read or made."""
    if name != "cpu":
        from poise.sim import check_device

        check_device(name)


def override(text: str) -> tuple[str, float]:
    """("lfoot.kp", 400.0) from "lfoot.kp=400"."""
    name, equals, value = text.partition("=")
    hint = "Write for example --set lfoot.kp=400"
    if not equals or not name.strip():
        raise PoiseError(f"--set needs NAME=VALUE, got '{text}'", hint=hint, code="option-malformed")
    try:
        number = float(value)
    except ValueError:
        raise PoiseError(
            f"--set {name.strip()} needs a number, got '{value}'", hint=hint, code="option-malformed"
        ) from None
    return name.strip(), number


@dataclass(frozen=True)
class Training:
    """How long is trained, where, and by which settings."""

    minutes: Annotated[float, arg(metavar="M")] = 10.0
    """Training time in minutes, counted over all resumed runs."""
    threads: Annotated[int, arg(metavar="N")] = 0
    """Threads of the physics; 0 takes every core."""
    device: Device = "cpu"
    """Where it runs: cpu, or cuda for an NVIDIA GPU (needs poise-motion[gpu])."""
    iterations: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Stop after so many iterations as well, and plan by them, not by the clock; for tests."""
    resume: Flag = False
    """Go on with the run that is in the folder."""
    preset: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="")] = None
    """Settings to begin with in place of the recipe's defaults: paper, code or fast."""
    config: Annotated[Path | None, arg(metavar="FILE.toml", help_behavior_hint="")] = None
    """A file of settings, as --print-config prints them."""
    print_config: Flag = False
    """Print all settings as TOML and do nothing."""

    @property
    def by_clip(self) -> bool:
        """Whether the settings depend on the clip, see `base_of`."""
        return self.preset is not None and self.config is None and not self.print_config

    def until(self) -> Until:
        """When the training ends."""
        from poise.learn import Until

        return Until(minutes=self.minutes, iterations=self.iterations)

    def check(self, chosen: Any) -> None:
        """Refuses numbers that make no sense, before anything is read or made."""
        if not (self.minutes > 0 and math.isfinite(self.minutes)):
            raise PoiseError(f"--minutes must be above 0, got {self.minutes:g}", code="out-of-range")
        for name, value in (("limit", chosen.help_limit), ("start", chosen.help_start)):
            if value is not None and not (value >= 0 and math.isfinite(value)):
                raise PoiseError(
                    f"--help-{name} must be a number of at least 0 newtons, got {value:g}",
                    code="out-of-range",
                )
        check_range("envs", chosen.num_envs, 1)
        check_range("seed", chosen.seed, 0)
        check_range("threads", self.threads, 0)
        check_range("iterations", self.iterations, 1)
        check_device(self.device)

    def settings(
        self, recipe: str, default: T, body: Body, values: Mapping[str, Any], clip: Clip | None = None
    ) -> T:
        """The settings of a run: `default`, a preset or a file, then what the command line states.

        clip: see `base_of`.
        """
        verb = "imitate" if recipe == "residual-force" else f"train {recipe}"
        base = base_of(recipe, default, self.preset, self.config, verb, clip)
        more, overrides = stated(body.set, type(base))
        return configured(base, {**body.values(overrides), **values, **more})


def printed(config: Any) -> Answer:
    """What --print-config answers."""
    from poise.settings import to_data, to_toml

    sys.stdout.write(to_toml(config))
    return Answer(to_data(config))


def places(out: Path) -> tuple[Path, Path | None]:
    """The folder of the results, and the file of the motion where `out` names one.

    `out` names a file where its suffix is one of a motion format or looks like a file's; run_v1.0 is a
    folder, and so is what is there as one.

    Raises:
        PoiseError: a format that cannot be written.
    """
    from poise.formats import check_writable, names_file

    if not names_file(out) or out.is_dir():
        return out, None
    check_writable(out)
    return out.with_suffix(""), out


def clips_in(given: Sequence[Path], out: Path | None = None) -> list[tuple[str, Path]]:
    """Every motion file in files and folders, with a name of its own; results below `out` are none.

    Raises:
        PoiseError: no such file, or no motion in it.
    """
    from poise.jobs.library.files import is_motion, refuse_without_motion

    found: list[tuple[str, Path]] = []
    for path in given:
        if not path.exists():
            raise PoiseError(
                "there is no such file or folder",
                path,
                "Give a folder of motion files",
                code="file-missing",
            )
        root = path.absolute()
        files = [root] if path.is_file() else sorted(f for f in root.rglob("*") if is_motion(f))
        base = root.parent if path.is_file() else root
        found += [
            ("-".join(f.relative_to(base).with_suffix("").parts), f)
            for f in files
            if out is None or not f.is_relative_to(out)
        ]
    if not found:
        refuse_without_motion(given)
    seen: dict[str, int] = {}
    named = []
    for name, path in found:
        seen[name] = seen.get(name, 0) + 1
        named.append((name if seen[name] == 1 else f"{name}-{seen[name]}", path))
    return named


def each(
    verb: str, given: Sequence[Path], out: Path | None, one: Callable[[Path, str], Answer]
) -> Answer:
    """Runs `one(file, name)` for every motion file in `given`, and shows the table.

    Exit code 1 if a file met a fault of Poise, else 2 if any was refused, else 3 if any motion was lost.
    """
    files = clips_in(given, None if out is None else out.absolute())
    done, rows, problems = [], [], []
    for k, (name, path) in enumerate(files):
        began, problem = time.monotonic(), None
        with Path(os.devnull).open("w") as nowhere, contextlib.redirect_stdout(nowhere):
            try:
                answer = one(path, name)
            except (KeyboardInterrupt, Exception) as failed:
                code, problem = failure(failed)
                answer = Answer(exit_code=code, outcome="refused" if code == REFUSED else "failed")
                problems.append(str(problem))
        if answer.exit_code == INTERRUPTED:
            tell(f"Stopped; {k} of {len(files)} files are done.")
            break
        seconds = time.monotonic() - began
        tell(f"{k + 1} of {len(files)}  {name}: {answer.outcome}", "dim")
        figure = "-" if answer.error_mm is None else f"{answer.error_mm:.0f}"
        rows.append((name, answer.outcome, figure, f"{seconds:.1f}"))
        done.append({**document(verb, [path], answer, problem), "seconds": seconds})
    tracked = verb == "track"
    columns = ("file", "outcome", *(("error mm",) if tracked else ()), "seconds")
    table("", columns, rows if tracked else [(r[0], r[1], r[3]) for r in rows], left=2)
    for sentence in problems:
        say(sentence)
    codes = {d["exit_code"] for d in done}
    code = next((c for c in (1, REFUSED, LOST) if c in codes), 0)
    code = code if len(done) == len(files) else INTERRUPTED
    return Answer({"files": done}, {} if out is None else {"folder": out}, exit_code=code)
