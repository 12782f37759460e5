"""Where a character is touched in an episode, and how hard: by the floor, a prop, or another one."""

from __future__ import annotations

import mujoco
import numpy as np

from poise.env import ImitationEnv

#: Forces below this are nothing to see, N.
LEAST_N = 1.0


class ContactForces:
    """An observer that keeps the contact forces on the character of one world, frame by frame.

    They are those of the state as it stands after each control step, of MuJoCo's own solver. Contacts of
    one body with one other are summed, at their mean place by force. What a character's own
    parts do to each other is left out.

    Attributes:
        frames: of each frame `(K, 6)`: points, m, and the forces there on the character, N, world axes.
    """

    def __init__(self, world: int = 0):
        self.world = world
        self.frames: list[np.ndarray] = []
        self._data: mujoco.MjData | None = None

    def see(self, env: ImitationEnv, step: int) -> bool:
        """Keeps the frame `step`; it never needs more of them."""
        model = env.backend.get_model(self.world)
        self._data = data = env.backend.get_data(self.world, self._data)
        mujoco.mj_forward(model, data)
        # The character's tree hangs on its first body; all else is the world.
        own = np.asarray(model.body_rootid) == 1
        sums: dict[tuple[int, int], np.ndarray] = {}
        force = np.zeros(6)
        for k in range(data.ncon):
            contact = data.contact[k]
            a, b = (int(model.geom_bodyid[g]) for g in contact.geom)
            if bool(own[a]) == bool(own[b]):
                continue
            mujoco.mj_contactForce(model, data, k, force)
            # Along the frame's first axis it pushes the second geom away from the first.
            push = contact.frame.reshape(3, 3).T @ force[:3] * (1.0 if own[b] else -1.0)
            size = float(np.linalg.norm(push))
            if size < LEAST_N:
                continue
            row = sums.setdefault((a, b), np.zeros(7))
            row += np.concatenate((contact.pos * size, push, [size]))
        rows = [np.concatenate((r[:3] / r[6], r[3:6])) for r in sums.values()]
        self.frames.append(np.array(rows).reshape(-1, 6))
        return True
