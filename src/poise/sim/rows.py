"""Characters of many worlds as the rows of one backend, whatever else stands in the worlds."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

import mujoco
import torch
from torch import Tensor

from poise.errors import PoiseError
from poise.sim.backend import Backend, SimState
from poise.sim.drive import Drive
from poise.sim.links import Place
from poise.sim.worlds import check_state, row_index

if TYPE_CHECKING:
    from poise.sim.scene_sim import SceneSim

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
        places: Sequence[Place],
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
                f"the snapshot has shape {tuple(snapshot.shape)}, not that of {n} characters"
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
        raise PoiseError(f"the state field '{name}' is not known per character")
