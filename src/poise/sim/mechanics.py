"""Jacobians, inertia, the step map and differences of positions of many worlds at once."""

# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# pyright: reportUnknownVariableType=false
from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
import torch
from torch import Tensor

from poise.errors import PoiseError
from poise.motion.rotations import quat_conj, quat_mul, quat_to_rotvec, rotvec_to_quat
from poise.sim.backend import Backend


class Mechanics:
    """What moves when something pushes, for the worlds of a backend as they stand.

    Made before stepping, since it binds fields of the state. Coordinates are MuJoCo's: rows of `qvel`.

    Args:
        backend: the worlds; all have one model, but for expanded fields.
        inertia: whether `inertia` and `solve` are asked for, which every physics step pays for.
    """

    def __init__(self, backend: Backend, inertia: bool = True):
        self.backend, model, here = backend, backend.model, backend.device
        backend.state.bind(["cdof", "M"] if inertia else ["cdof"])
        if inertia and backend.state["M"].shape[1:] != (model.nC,):
            raise PoiseError(
                "this backend keeps its inertia in another form", "Mechanics", code="physics-unsupported"
            )
        self._moves = torch.from_numpy(_ancestors(model)).to(here)
        # (-[arm] 1) `(3, 6)` as one row: what is fixed in it, and what the arm adds.
        fixed, cross = np.zeros((3, 6)), np.zeros((3, 3, 6))
        fixed[:, 3:] = np.eye(3)
        for k in range(3):
            cross[k, :, :3] = np.cross(np.eye(3), np.eye(3)[k]).T
        numbers = (torch.from_numpy(x).to(backend.state["cdof"]) for x in (fixed.ravel(), cross))
        self._fixed, self._cross = next(numbers), next(numbers).flatten(1)
        self._root = torch.from_numpy(model.body_rootid.astype(np.int64)).to(here)
        rows = np.repeat(np.arange(model.nv), model.M_rownnz)
        places = [rows, model.M_colind[: model.nC]]
        self._at = [torch.from_numpy(p.astype(np.int64)).to(here) for p in places]

    def jacobian(self, body: int | Sequence[int] | Tensor, point_w: Tensor) -> tuple[Tensor, Tensor]:
        """World Jacobians of body-fixed points, linear and rotational, `(N, K, 3, nv)` each.

        v(point) = J_p qvel, omega = J_r qvel. Without K for one body index.

        Args:
            body: one body, K bodies, or `(N, K)`, a different choice per world.
            point_w: `(N, 3)` m for one body, else `(N, K, 3)`.
        """
        linear, index = self.linear(body, point_w), self._index(body)
        turn = self.backend.state["cdof"][..., :3].unsqueeze(1).transpose(2, 3)
        turning = turn * self._moves[index].unsqueeze(2)
        return linear, turning[:, 0] if isinstance(body, int) else turning

    def linear(self, body: int | Sequence[int] | Tensor, point_w: Tensor) -> Tensor:
        """The linear one of `jacobian` alone."""
        state, n, single = self.backend.state, self.backend.num_envs, isinstance(body, int)
        index, point = self._index(body), point_w[:, None] if single else point_w
        if point.shape != (n, index.shape[1], 3):
            want = (n, 3) if single else (n, index.shape[1], 3)
            raise PoiseError(
                f"points must be {want}, got {tuple(point_w.shape)}", "jacobian", code="wrong-shape"
            )
        centre = state.subtree_com.gather(1, self._root[index][..., None].expand(-1, -1, 3))
        arm = point.to(centre) - centre
        # Each degree of freedom turns and moves the tree about its centre of mass, see `SimState.cvel`;
        # the point moves by move - arm x turn.
        cdof = state["cdof"].unsqueeze(1).transpose(2, 3)
        linear = (self._fixed + arm @ self._cross).unflatten(-1, (3, 6)) @ cdof
        linear = linear * self._moves[index].unsqueeze(2)
        return linear[:, 0] if single else linear

    def _index(self, body: int | Sequence[int] | Tensor) -> Tensor:
        """`(N, K)` bodies; K is 1 for one."""
        index = torch.as_tensor(body, dtype=torch.long, device=self.backend.device)
        index = (index.reshape(1) if isinstance(body, int) else index).expand(self.backend.num_envs, -1)
        if bool(((index < 0) | (index >= self.backend.model.nbody)).any()):
            most = self.backend.model.nbody - 1
            raise PoiseError(
                f"bodies must be in 0 to {most}, got {index.unique().tolist()}",
                "jacobian",
                code="index-outside",
            )
        return index

    def inertia(self) -> Tensor:
        """The joint-space inertia M, `(N, nv, nv)`."""
        nv = self.backend.model.nv
        rows, columns = self._at
        packed = self.backend.state["M"]
        out = packed.new_zeros(self.backend.num_envs, nv, nv)
        out[:, rows, columns] = packed
        out[:, columns, rows] = packed
        return out

    def solve(self, force: Tensor) -> Tensor:
        """M^-1 of generalized forces `(N, nv)` or `(N, nv, K)`: accelerations if nothing else acts."""
        nv = self.backend.model.nv
        if force.shape[:2] != (self.backend.num_envs, nv):
            want = f"({self.backend.num_envs}, {nv}, ...)"
            raise PoiseError(
                f"forces must be {want}, got {tuple(force.shape)}", "solve", code="wrong-shape"
            )
        factor = torch.linalg.cholesky(self.inertia())
        wide = force.to(factor) if force.dim() == 3 else force.to(factor)[..., None]
        out = torch.cholesky_solve(wide, factor)
        return out if force.dim() == 3 else out[..., 0]

    def step_map(self, force: Tensor) -> Tensor:
        """By how much generalized forces `(N, nv)`, held for one physics step, change `qvel` `(N, nv)`.

        It is the simulator's own, with what its integrator makes of stiffness and damping, and with
        limits and contacts. Two steps are made and taken back, at the cost of about ten. Under "euler",
        with nothing touched, it is h (M + h D)^-1 f with the time step h and the joints' damping D.
        """
        backend, applied = self.backend, self.backend.drive.qfrc_applied
        if force.shape != applied.shape:
            want = tuple(applied.shape)
            raise PoiseError(
                f"forces must be {want}, got {tuple(force.shape)}", "step_map", code="wrong-shape"
            )
        before, reached = backend.snapshot(), list[Tensor]()
        for extra in (None, force):
            if extra is not None:
                applied.add_(extra.to(applied))
            backend.step(1)
            reached.append(backend.state.qvel.clone())
            backend.restore(before)
        return reached[1] - reached[0]


def _ancestors(model: mujoco.MjModel) -> np.ndarray:
    """`(nbody, nv)` bool, whether a degree of freedom moves a body."""
    out = np.zeros((model.nbody, model.nv), dtype=bool)
    for body in range(1, model.nbody):
        out[body] = out[model.body_parentid[body]]
        start = model.body_dofadr[body]
        if start >= 0:
            out[body, start : start + model.body_dofnum[body]] = True
    return out


def difference(to: Tensor, since: Tensor) -> Tensor:
    """`(N, nv)` from the positions `since (N, nq)` to `to`, as MuJoCo's `mj_differentiatePos` in 1 s.

    World metres, then radians in the axes of `since`, then hinges; a free root comes first.
    """
    turn = quat_to_rotvec(quat_mul(quat_conj(since[:, 3:7]), to[:, 3:7]))
    return torch.cat((to[:, :3] - since[:, :3], turn, to[:, 7:] - since[:, 7:]), 1)


def displaced(qpos: Tensor, by: Tensor) -> Tensor:
    """The positions `(N, nq)` that lie `by (N, nv)` from `qpos`: the inverse of `difference`."""
    turned = quat_mul(qpos[:, 3:7], rotvec_to_quat(by[:, 3:6]))
    return torch.cat((qpos[:, :3] + by[:, :3], turned, qpos[:, 7:] + by[:, 6:]), 1)
