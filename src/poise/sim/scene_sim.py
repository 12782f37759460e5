"""N worlds of a scene: its characters as rows of one backend, its props and links by name."""

# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# pyright: reportUnknownVariableType=false
from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import mujoco
import torch
from torch import Tensor

from poise.errors import PoiseError, did_you_mean
from poise.motion.rotations import quat_conj, quat_mul, quat_rotate
from poise.sim.backend import Backend, SimState
from poise.sim.drive import Drive
from poise.sim.links import FAR_M, ModelSlices
from poise.sim.make import make_backend
from poise.sim.scene import Scene, alone
from poise.sim.worlds import check_state, row_index

#: State fields with a row per body; those of degrees of freedom are told by how they begin.
_BODIES = ("xpos", "xquat", "xmat", "xipos", "ximat", "subtree_com", "cvel", "cfrc_ext", "xfrc_applied")
_DOFS = ("qvel", "qacc", "qfrc_", "cdof")
_CONTROLS = ("ctrl", "actuator_force")
_DRIVE = ("ctrl", "qfrc_applied", "xfrc_applied")
_OWN = ("qpos", "qvel", "qacc_warmstart", *_DRIVE)


class _Field:
    """One state field of K characters in N worlds as `(N K, ...)`: the worlds' own memory where its
    layout permits, else a copy."""

    def __init__(self, parts: Sequence[Tensor], above: bool = False, copied: bool = False):
        """parts: views `(N, ...)` of each character's rows. above: whether they begin with one that is
        not its own."""
        self.parts, self.first = parts, int(above)
        n, k, start = len(parts[0]), len(parts), parts[0]
        places = [p.storage_offset() for p in parts]
        steps = {b - a for a, b in pairwise(places)}
        if not copied and k == 1:
            self.out, self.copied = start, False
        elif not copied and n == 1 and len(steps) == 1:
            size, strides = (k, *start.shape[1:]), (steps.pop(), *start.stride()[1:])
            self.out, self.copied = start.as_strided(size, strides), False
        else:
            self.out, self.copied = torch.stack(list(parts), 1).flatten(0, 1), True

    def pull(self) -> None:
        """From the worlds."""
        if self.copied:
            for k, part in enumerate(self.parts):
                self.out[k :: len(self.parts)] = part

    def push(self) -> None:
        """To the worlds; the row above a character's bodies is not its own."""
        if self.copied:
            for k, part in enumerate(self.parts):
                part[:, self.first :] = self.out[k :: len(self.parts), self.first :]

    def put(self, rows: Tensor | None, value: Tensor | float) -> None:
        """Sets some rows, `(n, ...)`, here and in the worlds."""
        self.own[slice(None) if rows is None else rows] = value
        self.push()

    @property
    def own(self) -> Tensor:
        """What belongs to the characters alone."""
        return self.out[:, 1:] if self.first else self.out


class CharacterRows:
    """K characters of one body in each of N worlds as the rows of a `Backend`; row `n K + k` is the
    k-th character of world n.

    To an environment each row is a world with that character alone, but that it may meet what else is
    there. A reset of some rows leaves everything else as it is; `time` goes on. Row 0 of fields with a
    row per body is not the world's and not to be read.

    Args:
        world: the worlds with everything in them.
        places: of the K characters.
        model: of one of them alone.
        sim: the scene that they are of, if it is known.
        sole: whether there is no other character in the worlds, so that each row has a world of its own:
            its snapshots then hold the whole world, with its props and links.

    Attributes:
        world, places, model, sim: as given.
    """

    def __init__(
        self,
        world: Backend,
        places: Sequence[ModelSlices],
        model: mujoco.MjModel,
        sim: SceneSim | None = None,
        sole: bool = False,
    ):
        self.world, self.places, self.model, self.sim = world, tuple(places), model, sim
        self._sole = sole
        self.num_envs, self.device = world.num_envs * len(places), world.device
        self._fields: dict[str, _Field] = {}
        self._make(_OWN)
        self.state = SimState(self._views)
        self.drive = Drive(*(self._fields[name].out for name in _DRIVE))

    @property
    def sole(self) -> bool:
        """Whether each row has a world of its own, with which it is copied and restored."""
        return self._sole

    def write(self, rows: Tensor | None, qpos: Tensor, qvel: Tensor) -> None:
        """Sets characters down, with nothing that drives them; what else is in their worlds stays."""
        ids = None if rows is None else row_index(rows, self.num_envs)
        n = self.num_envs if ids is None else len(ids)
        check_state(self.model, n, qpos, qvel)
        if n == 0:
            return
        for name, value in (("qpos", qpos), ("qvel", qvel)):
            self._fields[name].put(ids, value.detach().to(self._fields[name].out))
        for name in ("qacc_warmstart", *_DRIVE):
            self._fields[name].put(ids, 0.0)
        self._forward(ids)

    def step(self, nstep: int = 1) -> None:
        """Physics steps of all worlds."""
        self.push()
        self.world.step(nstep)
        self.pull()

    def push(self) -> None:
        """Hands what drives the characters to the worlds, for a step that the caller makes."""
        for name in _DRIVE:
            self._fields[name].push()

    def pull(self) -> None:
        """Brings the rows up to date after a step, a reset or a `forward` of the worlds."""
        for name, field in self._fields.items():
            if name not in _DRIVE:
                field.pull()

    def forward(self, rows: Tensor | None = None) -> None:
        """Recomputes what follows from the state."""
        self._forward(None if rows is None else row_index(rows, self.num_envs))

    def snapshot(self, derived: bool = True, out: Tensor | None = None) -> Tensor:
        """`(N K, width)` of the characters alone: their states, what drives them, and with `derived` the
        other bound fields. Props, links and characters of other rows are not part of it, but of the
        snapshots of a `sole` character."""
        if self._sole:
            return self.world.snapshot(derived, out)
        names = self._names(derived)
        return torch.cat([self._fields[n].own.reshape(self.num_envs, -1) for n in names], 1, out=out)

    def restore(self, snapshot: Tensor, rows: Tensor | None = None) -> None:
        """Sets characters down as a snapshot has them."""
        if self._sole:
            self.world.restore(snapshot, rows)
            self.pull()
            return
        ids = None if rows is None else row_index(rows, self.num_envs)
        n = self.num_envs if ids is None else len(ids)
        sizes = {name: self._fields[name].own[0].numel() for name in self._names(True)}
        short = sum(sizes[name] for name in _OWN)
        if tuple(snapshot.shape) not in ((n, sum(sizes.values())), (n, short)):
            raise PoiseError(
                f"the snapshot has shape {tuple(snapshot.shape)}, not that of {n} characters",
                code="snapshot-differs",
            )
        derived = snapshot.shape[1] != short
        names = self._names(derived)
        for name, value in zip(names, snapshot.split([sizes[x] for x in names], 1), strict=True):
            like = self._fields[name].own
            self._fields[name].put(ids, value.reshape(n, *like.shape[1:]).to(like))
        if not derived:
            self._forward(ids)

    def expand(self, field: str) -> Tensor:
        """Model fields belong to whole worlds."""
        raise PoiseError(
            f"'{field}' belongs to the whole world",
            hint="Give the scene's characters bodies of their own",
            code="field-of-world",
        )

    def set_const(self, rows: Tensor | None = None) -> None:
        """Nothing was changed."""

    def contacts(self) -> Tensor:
        """Net contact force `(N K, nbody, 3)` N on each body, where the scene has such sensors."""
        whole = self.world.contacts()
        return _Field(
            [whole[:, p.bodies.start - 1 : p.bodies.stop] for p in self.places], copied=True
        ).out

    def unstable(self) -> Tensor:
        """`(N K,)` bool: characters of worlds that went bad since the last call."""
        return self.world.unstable().repeat_interleave(len(self.places))

    def get_model(self, env: int) -> mujoco.MjModel:
        """The model of all that is in the row's world."""
        return self.world.get_model(env // len(self.places))

    def get_data(self, env: int, data: mujoco.MjData | None = None) -> mujoco.MjData:
        """The state of all that is in the row's world."""
        return self.world.get_data(env // len(self.places), data)

    def close(self) -> None:
        """Frees the worlds."""
        self.world.close()

    def _forward(self, ids: Tensor | None) -> None:
        self.world.forward(None if ids is None else torch.unique(ids // len(self.places)))
        self.pull()

    def _names(self, derived: bool) -> list[str]:
        more = sorted(self._fields.keys() - {*_OWN, "time"}) if derived else []
        return [*_OWN, *more]

    def _views(self, names: list[str]) -> dict[str, Tensor]:
        self._make([n for n in names if n not in self._fields])
        return {name: self._fields[name].out for name in names}

    def _make(self, names: Sequence[str]) -> None:
        self.world.state.bind([n for n in names if n not in _DRIVE])
        for name in names:
            if name in _DRIVE:
                whole: Tensor = getattr(self.world.drive, name)
            else:
                whole = self.world.state[name]
            self._fields[name] = self._field(name, whole)

    def _field(self, name: str, whole: Tensor) -> _Field:
        if name == "time":
            return _Field([whole] * len(self.places), copied=len(self.places) > 1)
        if name in _BODIES:
            parts = [whole[:, p.bodies.start - 1 : p.bodies.stop] for p in self.places]
            # What others are driven by lies in the row above, which `Drive.clear` would clear.
            alone = len(self.places) == 1 and self.places[0].body == 1
            return _Field(parts, above=True, copied=name == "xfrc_applied" and not alone)
        if name == "qpos":
            return _Field([whole[:, p.qpos] for p in self.places])
        if name in _CONTROLS:
            return _Field([whole[:, p.controls] for p in self.places])
        if name == "M":
            model = self.world.model
            ends = [
                model.M_rowadr[p.dofs.stop - 1] + model.M_rownnz[p.dofs.stop - 1] for p in self.places
            ]
            begins = [model.M_rowadr[p.dofs.start] for p in self.places]
            # Trees do not meet in the inertia: what belongs to one lies side by side.
            spans = zip(begins, ends, strict=True)
            return _Field([whole[:, int(a) : int(b)] for a, b in spans])
        if name.startswith(_DOFS):
            return _Field([whole[:, p.dofs] for p in self.places])
        raise PoiseError(f"the state field '{name}' is not known per character", code="field-of-world")


#: m; things that begin deeper in one another are a mistake.
DEEP_M = 0.03


class Contact(NamedTuple):
    """What is measured of a `Touch`, in the last physics step.

    Attributes:
        contacts: `(N,)` how many.
        force: `(N, 3)` N that `a` exerts on `b`, world axes.
        torque: `(N, 3)` N m about `point`, world axes.
        point: `(N, 3)` m, where it acts: the contacts' places weighted by their forces.
    """

    contacts: Tensor
    force: Tensor
    torque: Tensor
    point: Tensor


class LinkForce(NamedTuple):
    """What a measured `Link` exerted on its body `b`, in the last physics step; 0 while it is off.

    Attributes:
        force: `(N, 3)` N, world axes.
        torque: `(N, 3)` N m about `point`, world axes.
        point: `(N, 3)` m.
    """

    force: Tensor
    torque: Tensor
    point: Tensor


class SceneSim:
    """`num_envs` worlds of one scene.

    Attributes:
        scene: compiled, with the places of its things.
        backend: all worlds with everything in them.
        link_data: `(N, L, 11)` of the links, how they hold; None without any.
    """

    def __init__(
        self, scene: Scene, num_envs: int, device: str | torch.device = "cpu", threads: int = 0
    ) -> None:
        self.scene = scene.compile()
        self.backend = make_backend(self.scene.model, num_envs, device, threads=threads)
        self.backend.state.bind(["qacc_warmstart"])
        self.link_data: Tensor | None = None
        if scene.links:
            self.backend.state.bind(["eq_active"])
            self.link_data = self.backend.expand("eq_data")
        if scene.touches or any(link.measured for link in scene.links):
            self.backend.state.bind(["sensordata"])
        if any(link.measured for link in scene.links):
            self.backend.state.bind(["site_xpos"])

    @property
    def num_envs(self) -> int:
        """The number of worlds N."""
        return self.backend.num_envs

    def characters(self, *names: str) -> CharacterRows:
        """Characters of one body as rows of a `Backend`, all for no names: row `n K + k` is the k-th
        of them in world n."""
        known = {c.name: c.humanoid for c in self.scene.scene.characters}
        for name in names:
            if name not in known:
                raise PoiseError(
                    f"there is no character '{name}' in the scene",
                    "Scene",
                    did_you_mean(name, list(known)),
                    code="unknown-thing",
                )
        chosen = names or tuple(known)
        bodies = {known[n].identity for n in chosen}
        if len(bodies) != 1:
            what = f"characters of {len(bodies)} bodies" if bodies else "a scene without characters"
            raise PoiseError(
                f"{what} cannot share rows",
                "Scene",
                "Ask for each body's characters by name",
                code="bodies-differ",
            )
        own = alone(known[chosen[0]], self.scene.scene.sim)
        places = [self.scene.place(n) for n in chosen]
        return CharacterRows(self.backend, places, own, self, len(known) == 1)

    def place(self, name: str, qpos: Tensor, qvel: Tensor, rows: Tensor | None = None) -> None:
        """Sets a thing down in worlds `rows (n,)`, all for None; everything else stays as it is.

        qpos, qvel: `(n, coordinates)` and `(n, dofs)`; a free joint as in `SimState`.
        """
        place, state = self.scene.place(name), self.backend.state
        to = slice(None) if rows is None else rows
        n = self.num_envs if rows is None else len(rows)
        wide = place.coordinates, place.dofs.stop - place.dofs.start
        if tuple(qpos.shape) != (n, wide[0]) or tuple(qvel.shape) != (n, wide[1]):
            raise PoiseError(
                f"'{name}' needs qpos ({n}, {wide[0]}) and qvel ({n}, {wide[1]}), got "
                f"{tuple(qpos.shape)} and {tuple(qvel.shape)}",
                code="wrong-shape",
            )
        if not bool(qpos.isfinite().all() and qvel.isfinite().all()):
            raise PoiseError(f"the state of '{name}' is not finite", "SceneSim.place", code="not-finite")
        state.qpos[to, place.qpos] = qpos.to(state.qpos)
        state.qvel[to, place.dofs] = qvel.to(state.qvel)
        self.backend.forward(rows)

    def switch(self, name: str, on: bool, rows: Tensor | None = None, at: Tensor | None = None) -> None:
        """Switches a link on or off in worlds `rows (n,)`, all for None.

        Switched on, a weld keeps its bodies as they are just now; a ball joint pulls `Link.at` to
        `Link.to`, or holds it where it is. at: `(n, 3)` in place of `Link.at`, where worlds differ.

        Raises:
            PoiseError: bodies that are farther apart than `FAR_M`.
        """
        links = {link.name: i for i, link in enumerate(self.scene.scene.links)}
        if name not in links:
            raise PoiseError(
                f"there is no link '{name}'",
                "Scene",
                did_you_mean(name, list(links)),
                code="unknown-link",
            )
        i, link = links[name], self.scene.scene.links[links[name]]
        model, state = self.scene.model, self.backend.state
        to = torch.arange(self.num_envs, device=self.backend.device) if rows is None else rows
        if on:
            a, b = (int(x[i]) for x in (model.eq_obj1id, model.eq_obj2id))
            pos_a, pos_b, quat_a, quat_b = (
                field[to, body].double() for field in (state.xpos, state.xquat) for body in (a, b)
            )
            point = (torch.tensor(link.at) if at is None else at).to(pos_a)
            held = pos_b + quat_rotate(quat_b, point.expand_as(pos_b))
            back = quat_conj(quat_a)
            seen = quat_rotate(back, held - pos_a)
            wanted = seen if link.to is None else torch.tensor(link.to).to(seen).expand_as(seen)
            gap = held - pos_a if link.kind == "weld" or link.to is None else seen - wanted
            far = gap.norm(dim=-1)
            if link.to is not None and float(far.max()) > FAR_M:
                self._too_far(link.name, float(far.max()))
            if link.to is None:
                self._near(link.name, a, b, to)
            assert self.link_data is not None
            data = self.link_data[to, i].double()
            if link.kind == "weld":
                # Anchor on b; then the anchor's place and b's turn as seen from a.
                data[:, :3] = point
                data[:, 3:6] = seen
                data[:, 6:10] = quat_mul(back, quat_b)
            else:
                data[:, :3], data[:, 3:6] = wanted, point
            self.link_data[to, i] = data.to(self.link_data)
        state["eq_active"][to, i] = on

    def link(self, name: str) -> LinkForce:
        """What a measured link exerts."""
        links = {link.name: link for link in self.scene.scene.links}
        if name not in links:
            raise PoiseError(
                f"there is no link '{name}'",
                "Scene",
                did_you_mean(name, list(links)),
                code="unknown-link",
            )
        link, model, state = links[name], self.scene.model, self.backend.state
        if not link.measured:
            raise PoiseError(
                f"the force of link '{name}' is not measured",
                hint="Link(measured=True)",
                code="force-not-measured",
            )
        body, site = model.body(link.hook).id, model.site(link.hook).id
        ends = [model.eq_obj1id, model.eq_obj2id]
        # The sensor has what the body exerts on the hook, so minus what the link does; and where the
        # hook is on `a`, `b` feels the opposite.
        sign = -1.0 if int(ends[1][list(links).index(name)]) == body else 1.0
        seen = [int(model.sensor(f"{link.hook} {kind}").adr[0]) for kind in ("force", "torque")]
        turn, data = state.xquat[:, body], state["sensordata"]
        force, torque = (sign * quat_rotate(turn, data[:, at : at + 3].to(turn)) for at in seen)
        return LinkForce(force, torque, state["site_xpos"][:, site])

    def touch(self, name: str) -> Contact:
        """What is measured of a touch."""
        known = [t.name for t in self.scene.scene.touches]
        if name not in known:
            raise PoiseError(
                f"there is no touch '{name}'", "Scene", did_you_mean(name, known), code="unknown-link"
            )
        sensor = self.scene.model.sensor(name)
        at, state = int(sensor.adr[0]), self.backend.state["sensordata"]
        count, force, torque, point = state[:, at : at + 10].split((1, 3, 3, 3), 1)
        return Contact(count.squeeze(1), force, torque, point)

    def check(self) -> None:
        """Raises where two things stand in one another in any world, or one in the floor."""
        model = self.scene.model
        for env in range(self.num_envs):
            data = self._data(env)
            for contact in data.contact[: data.ncon]:
                a, b = (int(model.body_rootid[model.geom_bodyid[g]]) for g in contact.geom)
                if a != b and contact.dist < -DEEP_M:
                    names = [self._thing(x) for x in (a, b)]
                    raise PoiseError(
                        f"{names[0]} and {names[1]} begin {-1000 * contact.dist:.0f} mm in one another",
                        f"world {env}", "Move one of them", code="bodies-overlap",
                    )  # fmt: skip

    def step(self, nstep: int = 1) -> None:
        """Physics steps of all worlds."""
        self.backend.step(nstep)

    def close(self) -> None:
        """Frees the worlds."""
        self.backend.close()

    def _data(self, env: int) -> mujoco.MjData:
        data = self.backend.get_data(env)
        mujoco.mj_forward(self.backend.get_model(env), data)
        return data

    def _solid(self, body: int) -> int:
        """The body that a link's hook is on, or the body itself."""
        hooks = {link.hook for link in self.scene.scene.links if link.measured}
        model = self.scene.model
        return int(model.body_parentid[body]) if model.body(body).name in hooks else body

    def _thing(self, root: int) -> str:
        for name, place in self.scene.places.items():
            if place.body == root:
                return f"'{name}'" if name else "the character"
        return "the floor"

    def _near(self, name: str, a: int, b: int, rows: Tensor) -> None:
        """Raises where two bodies' surfaces are farther apart than `FAR_M`."""
        model = self.scene.model
        geoms = [
            [
                g
                for g in range(model.ngeom)
                if model.geom_bodyid[g] == self._solid(body) and model.geom_contype[g]
            ]
            for body in (a, b)
        ]
        for env in rows.tolist():
            data, own = self._data(env), self.backend.get_model(env)
            gaps = (
                mujoco.mj_geomDistance(own, data, g, h, 1e3, None) for g in geoms[0] for h in geoms[1]
            )
            far = min(gaps, default=0.0)
            if far > FAR_M:
                self._too_far(name, far)

    @staticmethod
    def _too_far(name: str, far: float) -> None:
        raise PoiseError(
            f"the bodies of link '{name}' are {far:.2f} m apart, and {FAR_M} m is the most",
            hint="Bring them together before you switch it on",
            code="too-far",
        )
