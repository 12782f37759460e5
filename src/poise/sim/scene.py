"""The contents of one world: characters, props, links between them, and the floor.

scene = Scene(
    things=(Character(humanoid, "anna"), Door(), Ball(pos=(0, 0, 2))),
    links=(Link("grip", "door", "anna/left_hand", "ball"),),
    touches=(Touch("hit", "ball", "anna"),),
)
world = SceneSim(scene, num_envs=64)
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import mujoco
import numpy as np

from poise.body import Humanoid
from poise.body.humanoid import add_humanoid
from poise.errors import PoiseError, did_you_mean
from poise.formats.text import write_whole
from poise.settings import Length, validate
from poise.sim.backend import SimConfig
from poise.sim.floor import Floor, Plane
from poise.sim.links import Link, ModelSlices, place_of
from poise.sim.props import Prop

#: Things in one scene; more take minutes to compile and are a mistake.
MOST = 500
#: Impedance d of contacts between bodies of soft characters, see MuJoCo's `solimp`.
FLESH = 0.5
_BITS = ("FOUND", "FORCE", "TORQUE", "POS")
_DATA = sum(1 << int(getattr(mujoco.mjtConDataField, f"mjCONDATA_{bit}")) for bit in _BITS)
_NETFORCE = 3


@dataclass(frozen=True)
class Character:
    """A body in a scene. It stands at the origin until a state is written.

    Attributes:
        humanoid: its body.
        name: its bodies, joints and actuators are called NAME/..., or by their own names where it is "".
        soft: contacts between bodies of characters give way like flesh in its world, see `FLESH`.
    """

    humanoid: Humanoid
    name: str = ""
    soft: bool = False

    @property
    def prefix(self) -> str:
        """What its names begin with."""
        return f"{self.name}/" if self.name else ""


@dataclass(frozen=True)
class Touch:
    """Contact forces between two groups, which are then measured.

    Attributes:
        name: how the scene calls it.
        a: a character or prop with all its bodies, a body such as "anna/left_foot", or "floor"; the
            character without a name is "character".
        b: likewise; None for whatever touches `a`.
    """

    name: str
    a: str
    b: str | None = None


@dataclass(frozen=True)
class Scene:
    """One world's content.

    Attributes:
        things: characters and props; the order is that of the model's arrays.
        links: between bodies.
        touches: contact forces that are measured.
        floor: what they stand on; its friction is that of the first character.
        sim: physics settings.
    """

    things: Annotated[tuple[Character | Prop, ...], Length(0, MOST)]
    links: tuple[Link, ...] = ()
    touches: tuple[Touch, ...] = ()
    floor: Floor = field(default_factory=Plane)
    sim: SimConfig = field(default_factory=SimConfig)

    def __post_init__(self) -> None:
        validate(self)
        for what in ("things", "links", "touches"):
            names = [x.name for x in getattr(self, what)]
            twice = next((n for n in names if names.count(n) > 1), None)
            if twice is not None:
                raise PoiseError(
                    f"two of its {what} are called '{twice}'",
                    "Scene",
                    "Give each its name",
                    code="name-repeated",
                )

    @property
    def characters(self) -> tuple[Character, ...]:
        """Its characters, in order."""
        return tuple(t for t in self.things if isinstance(t, Character))

    @cached_property
    def spec(self) -> mujoco.MjSpec:
        """The description that is compiled."""
        spec = mujoco.MjSpec()
        spec.modelname = "poise"
        spec.compiler.degree, spec.compiler.autolimits = False, True
        characters = self.characters
        self.floor.add(spec, characters[0].humanoid.table.friction if characters else 1.0)
        for thing in self.things:
            if isinstance(thing, Character):
                add_humanoid(spec, thing.humanoid.table, thing.prefix)
            else:
                thing.add(spec)
        if any(c.soft for c in characters):
            _soften(spec, characters)
        known = [b.name for b in spec.bodies]
        for link in self.links:
            for body in (link.a, link.b):
                _check(body, known, f"Link '{link.name}'")
            link.add(spec, self._hooked(link))
        for touch in self.touches:
            self._sense(spec, touch, known)
        self.sim.apply(spec)
        return spec

    def compile(self) -> SceneModel:
        """The model and its index.

        Raises:
            PoiseError: what MuJoCo cannot compile, and links or touches of bodies that are not there.
        """
        try:
            model = self.spec.compile()
        except ValueError as problem:
            text = " ".join(str(problem).split()).removeprefix("Error: ")
            raise PoiseError(
                f"the scene cannot be compiled: {text}", "Scene", code="model-not-compiled"
            ) from None
        first = {t.name: self._first_body(t) for t in self.things}
        return SceneModel(
            self, model, {n: place_of(model, n, model.body(body).id) for n, body in first.items()}
        )

    def _hooked(self, link: Link) -> str | None:
        """The body of a measured link that is no character's, since a character keeps its own bodies."""
        if not link.measured:
            return None
        taken = {c.prefix + name for c in self.characters for name in c.humanoid.bodies}
        free = [body for body in (link.b, link.a) if body not in taken]
        if not free:
            raise PoiseError(
                "the force between two characters' bodies is not measured",
                f"Link '{link.name}'",
                "Put a prop between them, linked to both",
                code="force-not-measured",
            )
        return free[0]

    @staticmethod
    def _first_body(thing: Character | Prop) -> str:
        if isinstance(thing, Character):
            return thing.prefix + thing.humanoid.bodies[0]
        return thing.name

    def _sense(self, spec: mujoco.MjSpec, touch: Touch, bodies: list[str]) -> None:
        """Adds the sensor of a touch: the net force and torque about its point, in the world's axes."""
        ends: list[tuple[mujoco.mjtObj, str]] = []
        whole = {t.name or "character": self._first_body(t) for t in self.things}
        for name in (touch.a, touch.b):
            if name is None:
                continue
            if name == "floor":
                ends.append((mujoco.mjtObj.mjOBJ_BODY, "world"))
            elif name in whole:
                # A body with all below it.
                ends.append((mujoco.mjtObj.mjOBJ_XBODY, whole[name]))
            else:
                _check(name, [*whole, *bodies, "floor"], f"Touch '{touch.name}'")
                ends.append((mujoco.mjtObj.mjOBJ_BODY, name))
        sensor = spec.add_sensor(
            name=touch.name, type=mujoco.mjtSensor.mjSENS_CONTACT,
            objtype=ends[0][0], objname=ends[0][1], intprm=[_DATA, _NETFORCE, 1],
        )  # fmt: skip
        if len(ends) > 1:
            sensor.reftype, sensor.refname = ends[1]


def alone(humanoid: Humanoid, sim: SimConfig | None = None) -> mujoco.MjModel:
    """The model of a world with a body and a plane floor, and nothing else."""
    return Scene((Character(humanoid),), sim=sim or SimConfig()).compile().model


def _soften(spec: mujoco.MjSpec, characters: tuple[Character, ...]) -> None:
    """Gives contacts between bodies of characters the impedance `FLESH`, also between those of one; all
    others keep their own.

    A limb that is wedged between two of another character has contacts that push against each other. The
    solver shares d / (1 - d) of what both ask for among them: 9 to 19 times with MuJoCo's d, up to
    200,000 N between two people, and once with a half.
    """
    for character in characters:
        for name in character.humanoid.bodies:
            for geom in spec.body(character.prefix + name).geoms:
                if geom.solmix != 1.0:
                    _keep(spec, geom)
                # Parameters of a pair are mixed by weight, and 0 against anything counts nothing.
                geom.solmix = 0.0
                geom.solimp[:2] = [FLESH, FLESH]


def _keep(spec: mujoco.MjSpec, soft: Any) -> None:
    """States how a geom that is soft by itself touches what the world stands on: as without `FLESH`."""
    for other in spec.worldbody.geoms:
        share = soft.solmix / (soft.solmix + other.solmix)
        pair = spec.add_pair(geomname1=soft.name, geomname2=other.name)
        pair.condim = max(soft.condim, other.condim)
        friction = [max(a, b) for a, b in zip(soft.friction, other.friction, strict=True)]
        pair.friction = [friction[0], friction[0], friction[1], friction[2], friction[2]]
        pair.solref = list(share * np.array(soft.solref) + (1 - share) * np.array(other.solref))
        pair.solimp = list(share * np.array(soft.solimp) + (1 - share) * np.array(other.solimp))


def _check(name: str, known: list[str], where: str) -> None:
    if name not in known:
        raise PoiseError(
            f"there is no body '{name}' in the scene",
            where,
            did_you_mean(name, known),
            code="unknown-body",
        )


@dataclass(frozen=True, eq=False)
class SceneModel:
    """A compiled scene.

    Attributes:
        scene: as it was described.
        model: of all things together.
        places: of each thing, by its name.
    """

    scene: Scene
    model: mujoco.MjModel
    places: Mapping[str, ModelSlices]

    def place(self, name: str) -> ModelSlices:
        """Where a thing stands in the model's arrays."""
        if name not in self.places:
            hint = did_you_mean(name, list(self.places))
            raise PoiseError(f"there is no '{name}' in the scene", "Scene", hint, code="unknown-thing")
        return self.places[name]


def mjcf_of(humanoid: Humanoid, sim: SimConfig | None = None) -> str:
    """A body as MJCF: on a floor, a position servo for every hinge, the settings of the physics.

    `ctrl` are target angles in rad; lengths are m, masses kg, the vertical is Z. MuJoCo writes numbers
    with six digits, so that the loaded model differs from the simulated one by 1e-6 of each.

    sim: the physics; by default those of the recipes. A control step is `sim.substeps` of MuJoCo's.
    """
    spec = Scene((Character(humanoid),), sim=sim or SimConfig()).spec
    # The text is complete only after the model was compiled.
    spec.compile()
    return spec.to_xml()


def write_mjcf(humanoid: Humanoid, path: str | Path, sim: SimConfig | None = None) -> Path:
    """Writes `mjcf_of` into a file, whole or not at all."""
    write_whole(Path(path), mjcf_of(humanoid, sim))
    return Path(path)
