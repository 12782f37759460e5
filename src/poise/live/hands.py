"""What pushes characters in a live world: a hand that drags a body, and blows. Compliance feels both."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from poise.env.goals.goal import Goal
from poise.env.plugins import Felt, Plugin
from poise.sim import Backend, Drive

#: N/m and N s/m of the hand that drags a body, and N that it exerts at most.
PULL, DAMP, MOST_N = 400.0, 40.0, 500.0
#: N s and s of a blow; it fells a walking character in 10 of 12 tries.
BLOW_NS, BLOW_S = 150.0, 0.1


class Hands(Plugin):
    """One hand and one blow on each of K characters; their forces are held for a control step."""

    def __init__(self, goal: Goal, backend: Backend):
        self._backend, self._rate_hz = backend, goal.rate_hz
        self._chest = goal.humanoid.rows_of("spine")[-1] + 1
        k = backend.num_envs
        self._body = torch.zeros(k, 2, dtype=torch.long)
        self._point, self._force = (torch.zeros(k, 2, 3, dtype=torch.float64) for _ in range(2))
        self.pulls = dict[int, tuple[int, Tensor, Tensor]]()
        self._blows = dict[int, tuple[Tensor, int]]()

    def pull(self, character: int, body: int, point: np.ndarray, to: np.ndarray) -> None:
        """A hand holds a body at `point (3)` m in its frame and draws it to `to (3)` m in the world."""
        double = torch.float64
        self.pulls[character] = body, torch.tensor(point, dtype=double), torch.tensor(to, dtype=double)

    def let_go(self, character: int) -> None:
        """The hand lets go."""
        self.pulls.pop(character, None)

    def blow(self, character: int, direction: np.ndarray) -> None:
        """A blow on the chest along `direction (3)`, `BLOW_NS` N s."""
        force = torch.tensor(direction / max(float(np.linalg.norm(direction)), 1e-9)) * BLOW_NS / BLOW_S
        self._blows[character] = force, max(1, round(BLOW_S * self._rate_hz))

    def push(self, drive: Drive) -> None:
        """Adds what pulls and strikes."""
        self._force.zero_()
        state = self._backend.state
        for k, (body, point, to) in self.pulls.items():
            pos, quat = state.xpos[k, body + 1].double(), state.xquat[k, body + 1].double()
            vec, w = quat[1:], quat[0]
            t = 2.0 * torch.linalg.cross(vec, point)
            held = pos + point + w * t + torch.linalg.cross(vec, t)
            force = PULL * (to - held) - DAMP * state.qvel[k, :3].double()
            force = force * min(1.0, MOST_N / max(float(force.norm()), 1e-9))
            self._put(drive, k, 0, body + 1, held, force)
        for k, (force, left) in list(self._blows.items()):
            self._put(drive, k, 1, self._chest, state["xipos"][k, self._chest].double(), force)
            if left > 1:
                self._blows[k] = force, left - 1
            else:
                del self._blows[k]

    def felt(self) -> Felt:
        """The forces of this control step."""
        return Felt(self._body, self._point, self._force)

    def _put(self, drive: Drive, k: int, slot: int, row: int, at: Tensor, force: Tensor) -> None:
        arm = at - self._backend.state["xipos"][k, row].double()
        wrench = torch.cat((force, torch.linalg.cross(arm, force)))
        drive.xfrc_applied[k, row] += wrench.to(drive.xfrc_applied)
        self._body[k, slot], self._point[k, slot], self._force[k, slot] = row, at, force
