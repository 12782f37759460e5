"""On which bodies of the characters the touches and links of a scene act."""

from __future__ import annotations

from typing import NamedTuple

from poise.errors import PoiseError, did_you_mean
from poise.sim import CharacterRows, SceneSim, Touch


class End(NamedTuple):
    """A touch or a link on one body of a character.

    Attributes:
        name: of the touch or link.
        link: whether it is a link.
        character: which of the rows' characters.
        body: the row of MuJoCo's bodies, of a character alone.
        sign: of the measured force, as that body feels it.
    """

    name: str
    link: bool
    character: int
    body: int
    sign: float


def ends_on(sim: SceneSim, rows: CharacterRows, name: str) -> list[End]:
    """Where a touch or a measured link acts on the characters of some rows.

    Raises:
        PoiseError: there is none, it is on a whole character, or on none of these.
    """
    scene = sim.scene.scene
    touch = next((t for t in scene.touches if t.name == name), None)
    link = next((x for x in scene.links if x.name == name), None)
    if touch is None and link is None:
        known = [x.name for x in (*scene.touches, *scene.links)]
        raise PoiseError(f"there is no touch or link '{name}'", "InScene", did_you_mean(name, known))
    found: list[End] = []
    for body, sign in _ends(sim, name, touch):
        for k, place in enumerate(rows.places):
            if touch is not None and body == place.name:
                hint = "Touch its bodies one by one, see poise.env.events.touches_of"
                raise PoiseError(f"touch '{name}' does not say which body is touched", "InScene", hint)
            if body in _bodies(sim, place.bodies):
                row = sim.scene.model.body(body).id - place.bodies.start + 1
                found.append(End(name, touch is None, k, row, sign))
    if not found:
        raise PoiseError(f"'{name}' acts on none of these characters' bodies", "InScene")
    return found


def _ends(sim: SceneSim, name: str, touch: Touch | None) -> list[tuple[str, float]]:
    """The bodies of a touch or link, and the sign of the force on each."""
    if touch is not None:
        # What is measured is what `a` exerts on `b`, or on whatever it touches.
        return [(touch.a, -1.0), *([(touch.b, 1.0)] if touch.b else [])]
    sim.link(name)
    link = next(x for x in sim.scene.scene.links if x.name == name)
    return [(link.a, -1.0), (link.b, 1.0)]


def _bodies(sim: SceneSim, rows: slice) -> list[str]:
    return [sim.scene.model.body(i).name for i in range(rows.start, rows.stop)]


def touches_of(name: str, thing: str, bodies: tuple[str, ...], prefix: str = "") -> tuple[Touch, ...]:
    """A touch of `thing` with each of a character's bodies, NAME:BODY, so that it is known which one
    is touched: `Scene(touches=touches_of("hit", "ball", humanoid.bodies))`.

    prefix: what the character's bodies are called by, "anna/".
    """
    return tuple(Touch(f"{name}:{body}", thing, prefix + body) for body in bodies)
