"""`poise body`: the physical body that is made for a clip."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import OmitArgPrefixes, Positional, arg

from poise.cli.console import Answer, table
from poise.cli.options import Body, Force, Json, Reading
from poise.errors import PoiseError
from poise.jobs.keep import may_write

if TYPE_CHECKING:
    from poise.body import BodyConfig
    from poise.motion import Clip


def run(
    clip: Annotated[Positional[Path], arg(metavar="CLIP")],
    out: Annotated[Path | None, arg(aliases=["-o"], metavar="FILE.xml", help_behavior_hint="")] = None,
    force: Force = False,
    json: Json = False,
    body: OmitArgPrefixes[Body] = Body(),
    reading: OmitArgPrefixes[Reading] = Reading(),
) -> Answer:
    """Show the body that is made for a clip: masses, hinges, gains, torque limits.

    Args:
        clip: the motion file.
        out: write the body as MJCF, which MuJoCo loads: on a floor, with its servos, as it is simulated.
    """
    config = body.config()
    if out is not None:
        if out.suffix.lower() != ".xml":
            raise PoiseError(
                "a body is written as MJCF, in a file .xml", out, "Give -o FILE.xml", code="wrong-suffix"
            )
        own = () if body.body is None else (body.body,)
        may_write(out, force, clip, *own)
    from poise.kinematics import fit_humanoid
    from poise.sim.scene import write_mjcf

    motion = reading.read(clip)
    humanoid, _, report = fit_humanoid(motion, config)
    rows = humanoid.table.describe()
    title = (
        f"{motion.name}: {len(rows)} bodies, {len(humanoid.hinges)} hinges, "
        f"{humanoid.mass:.1f} kg, {humanoid.table.height_m:.2f} m"
    )
    columns = ("body", "part", "parent", "hinges", "shape", "kg", "kp", "kd", "N m", "range, degrees")
    table(title, columns, [_row(r) for r in rows], left=5)
    facts = {"height_m": humanoid.table.height_m, "mass_kg": humanoid.mass}
    facts |= {"hinges": len(humanoid.hinges), "bodies": rows}
    outputs = {} if out is None else {"body": write_mjcf(humanoid, out)}
    return Answer(
        facts, outputs, [*motion.skeleton.source.notes, *_made(motion, config), *report.sentences()]
    )


def _made(clip: Clip, config: BodyConfig) -> list[str]:
    """How the joints became bodies, in sentences."""
    from poise.body import find_anatomy, read_mjcf

    if config.mjcf is not None:
        return list(read_mjcf(config.mjcf, config.damping).notes)
    anatomy = find_anatomy(clip.skeleton, [clip])
    names = clip.skeleton.names
    riders = [f"{names[j]} on {names[on]}" for j, on in anatomy.riders(clip.skeleton).items()]
    more = f" and {len(riders) - 4} more" if len(riders) > 4 else ""
    rode = f"Without a body of their own, with their own channels kept: {', '.join(riders[:4])}{more}."
    return [*anatomy.evidence, *([rode] if riders else [])]


def _row(r: dict[str, Any]) -> list[str]:
    ranges = " ".join(f"{low}..{high}" for low, high in r["range_deg"])
    words = [r[k] for k in ("body", "part", "parent", "hinges", "shape")]
    figures = [f"{r['mass']:.2f}", *(f"{r[k]:g}" if r["hinges"] != "-" else "-" for k in _GAINS)]
    return [*words, *figures, ranges or "-"]


_GAINS = ("kp", "kd", "torque")
