"""N worlds of a scene: its characters as rows, its props and links by name."""

# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# pyright: reportUnknownVariableType=false
from __future__ import annotations

from typing import NamedTuple

import mujoco
import torch
from torch import Tensor

from poise.errors import PoiseError, did_you_mean
from poise.motion.rotations import quat_conj, quat_mul, quat_rotate
from poise.sim.links import FAR_M
from poise.sim.make import make_backend
from poise.sim.rows import CharacterRows
from poise.sim.scene import Scene, alone

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


class Pull(NamedTuple):
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
                )
        chosen = names or tuple(known)
        bodies = {known[n].identity for n in chosen}
        if len(bodies) != 1:
            what = f"characters of {len(bodies)} bodies" if bodies else "a scene without characters"
            raise PoiseError(
                f"{what} cannot share rows", "Scene", "Ask for each body's characters by name"
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
                f"{tuple(qpos.shape)} and {tuple(qvel.shape)}"
            )
        if not bool(qpos.isfinite().all() and qvel.isfinite().all()):
            raise PoiseError(f"the state of '{name}' is not finite", "SceneSim.place")
        state.qpos[to, place.qpos] = qpos.to(state.qpos)
        state.qvel[to, place.dofs] = qvel.to(state.qvel)
        self.backend.forward(rows)

    def switch(self, name: str, on: bool, rows: Tensor | None = None) -> None:
        """Switches a link on or off in worlds `rows (n,)`, all for None.

        Switched on, a weld keeps its bodies as they are just now; a ball joint pulls `Link.at` to
        `Link.to`, or holds it where it is.

        Raises:
            PoiseError: bodies that are farther apart than `FAR_M`.
        """
        links = {link.name: i for i, link in enumerate(self.scene.scene.links)}
        if name not in links:
            raise PoiseError(f"there is no link '{name}'", "Scene", did_you_mean(name, list(links)))
        i, link = links[name], self.scene.scene.links[links[name]]
        model, state = self.scene.model, self.backend.state
        to = torch.arange(self.num_envs, device=self.backend.device) if rows is None else rows
        if on:
            a, b = (int(x[i]) for x in (model.eq_obj1id, model.eq_obj2id))
            pos_a, pos_b, quat_a, quat_b = (
                field[to, body].double() for field in (state.xpos, state.xquat) for body in (a, b)
            )
            at = torch.tensor(link.at).to(pos_a)
            held = pos_b + quat_rotate(quat_b, at.expand_as(pos_b))
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
                data[:, :3] = at
                data[:, 3:6] = seen
                data[:, 6:10] = quat_mul(back, quat_b)
            else:
                data[:, :3], data[:, 3:6] = wanted, at
            self.link_data[to, i] = data.to(self.link_data)
        state["eq_active"][to, i] = on

    def link(self, name: str) -> Pull:
        """What a measured link exerts."""
        links = {link.name: link for link in self.scene.scene.links}
        if name not in links:
            raise PoiseError(f"there is no link '{name}'", "Scene", did_you_mean(name, list(links)))
        link, model, state = links[name], self.scene.model, self.backend.state
        if not link.measured:
            raise PoiseError(f"the force of link '{name}' is not measured", hint="Link(measured=True)")
        body, site = model.body(link.hook).id, model.site(link.hook).id
        ends = [model.eq_obj1id, model.eq_obj2id]
        # The sensor has what the body exerts on the hook, so minus what the link does; and where the
        # hook is on `a`, `b` feels the opposite.
        sign = -1.0 if int(ends[1][list(links).index(name)]) == body else 1.0
        seen = [int(model.sensor(f"{link.hook} {kind}").adr[0]) for kind in ("force", "torque")]
        turn, data = state.xquat[:, body], state["sensordata"]
        force, torque = (sign * quat_rotate(turn, data[:, at : at + 3].to(turn)) for at in seen)
        return Pull(force, torque, state["site_xpos"][:, site])

    def touch(self, name: str) -> Contact:
        """What is measured of a touch."""
        known = [t.name for t in self.scene.scene.touches]
        if name not in known:
            raise PoiseError(f"there is no touch '{name}'", "Scene", did_you_mean(name, known))
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
                        f"world {env}", "Move one of them",
                    )  # fmt: skip

    def step(self, nstep: int = 1) -> None:
        """Physics steps of all worlds."""
        self.backend.step(nstep)

    def close(self) -> None:
        """Frees the worlds."""
        self.backend.close()

    def _data(self, env: int) -> mujoco.MjData:
        data = self.backend.get_data(env)
        mujoco.mj_forward(self.scene.model, data)
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
            data = self._data(env)
            gaps = (
                mujoco.mj_geomDistance(model, data, g, h, 1e3, None) for g in geoms[0] for h in geoms[1]
            )
            far = min(gaps, default=0.0)
            if far > FAR_M:
                self._too_far(name, far)

    @staticmethod
    def _too_far(name: str, far: float) -> None:
        raise PoiseError(
            f"the bodies of link '{name}' are {far:.2f} m apart, and {FAR_M} m is the most",
            hint="Bring them together before you switch it on",
        )
