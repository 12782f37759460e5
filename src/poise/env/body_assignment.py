"""Characters of several bodies in one batch: a world takes the body that its clip is for.

All bodies have the same joints, hinges and shapes; lengths, sizes, masses and strengths differ. What
differs between their compiled models becomes a field of each world, so that the worlds are stepped
together as ever, and a new episode only copies the numbers of its body.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
import torch
from mujoco.batch import MODEL_FIELDS
from torch import Tensor

from poise.body import Humanoid
from poise.env.frame import Observable
from poise.env.plugins import Plugin
from poise.env.terms.phc_obs import shape_of
from poise.errors import PoiseError
from poise.sim import Backend, alone


def differing(models: Sequence[mujoco.MjModel]) -> dict[str, np.ndarray]:
    """The model fields in which some model is unlike the first, each as `(S, ...)`.

    Physics settings (`opt`) are those of the first for all.

    Raises:
        PoiseError: the models have not the same structure.
    """
    out: dict[str, np.ndarray] = {}
    for name in sorted(MODEL_FIELDS):
        values = [getattr(m, name, None) for m in models if not name.startswith("opt.")]
        arrays = [v for v in values if isinstance(v, np.ndarray)]
        if not arrays or all(np.array_equal(a, arrays[0]) for a in arrays):
            continue
        if arrays[0].dtype.kind != "f" or any(a.shape != arrays[0].shape for a in arrays):
            raise PoiseError(
                f"the bodies differ in more than numbers: MuJoCo's '{name}' is not the same",
                hint="Give bodies with the same joints, hinges and kinds of shapes",
            )
        out[name] = np.stack(arrays)
    return out


class BodyAssignment(Plugin):
    """The bodies of a backend's worlds, as a plug-in.

    Attributes:
        body: `(N,)`, which body each world has.
        sizes: `(S, K)` float32 of the bodies, see `shape_of`.

    Args:
        backend: its model is that of the first body, which all worlds have at first.
        humanoids: S bodies.
    """

    def __init__(self, backend: Backend, humanoids: Sequence[Humanoid]):
        fields = differing([backend.model, *(alone(h) for h in humanoids[1:])])
        self._live = {name: backend.expand(name) for name in fields}
        self._values = {
            name: torch.from_numpy(fields[name]).to(live).view(len(humanoids), *live.shape[1:])
            for name, live in self._live.items()
        }
        self.sizes = torch.stack([shape_of(h) for h in humanoids]).to(backend.device)
        self.body = torch.zeros(backend.num_envs, dtype=torch.long, device=backend.device)

    @property
    def observables(self) -> Mapping[str, Observable]:
        """The sizes of each character's body."""
        return {"sizes": lambda frame: self.sizes.index_select(0, frame.place.body.long())}

    def assign(self, rows: Tensor | None, body: Tensor) -> None:
        old = self.body if rows is None else self.body[rows]
        changed = (body != old).nonzero().squeeze(-1)
        if not len(changed):
            return
        ids, new = changed if rows is None else rows[changed], body[changed]
        self.body[ids] = new
        for name, live in self._live.items():
            live[ids] = self._values[name].index_select(0, new)
