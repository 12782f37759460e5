"""The help that the characters of an environment have left, while they learn."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from poise.control import HelpSchedule
from poise.env.events import Event, StepOutcome
from poise.env.goal import Goal, Group
from poise.errors import PoiseError

#: How much older episodes count, at each decision, against the ones since the last.
KEPT = 0.8
#: Ended episodes, older ones counted by `KEPT`, from which on a group's success is known. Five are what
#: such a memory holds of one episode per decision. The standard error of a share of fewer is wider than
#: the 0.2 between the shares from which `SuccessHelp` lowers and under which it raises: chance would
#: push the help down and up. Nor are there many more: 512 characters on 100 clips end about one episode
#: of each between two decisions.
EPISODES = 5.0


class HelpBudget(Event):
    """Scales the residual force's limits by what a schedule decides from the episodes' outcomes.

    With several groups, which are clips or motion bins, each has a scale of its own, decided from the
    outcomes of its own episodes: as soon as it knows `EPISODES` of them, while groups with fewer go on
    collecting (a schedule of time alone, such as `LinearHelp`, lowers them all the same). One group is
    all worlds, and is decided every time.

    scale: float32, multiplied with the limits, where the worlds are: 0-dimensional for one group, else
        `(G,)`. now: a Python number, which need not wait for a GPU: the largest scale of any group in
        use, so that 0 means that no group is helped. Without a schedule they stay as they are set.
    by: whether all worlds have one share of help left, or each "clip" or motion "bin" its own.
    """

    def __init__(
        self,
        schedule: HelpSchedule | None = None,
        device: torch.device | str = "cpu",
        groups: int = 1,
        by: Group = "all",
    ):
        if groups < 1:
            raise PoiseError(
                f"help needs at least 1 group, got {groups}", "HelpBudget", code="out-of-range"
            )
        self.schedule, self.groups, self.steps, self.now = schedule, groups, 0, 1.0
        self.by: Group = by
        self.scale = torch.ones(() if groups == 1 else (groups,), device=device)
        # The same on the CPU, where decisions are made.
        self._scales, self._used = np.ones(groups, np.float32), np.ones(groups, bool)
        # Ended and failed episodes of each group; of several where the worlds are, to wait for no GPU.
        where = "cpu" if groups == 1 else device
        self._counts = torch.zeros(2, groups, dtype=torch.float64, device=where)

    def set(self, scale: float | Tensor | np.ndarray) -> None:
        """Takes a scale into use, in [0, 1]: one for all groups, or `(G,)`.

        Raises:
            PoiseError: scales of another number of groups.
        """
        given = scale.detach().cpu().numpy() if isinstance(scale, Tensor) else np.asarray(scale)
        if given.ndim and given.shape != (self.groups,):
            raise PoiseError(
                f"{self.groups} groups need as many scales of help, got {given.shape}",
                code="count-differs",
            )
        self._scales = np.broadcast_to(given, (self.groups,)).astype(np.float32)
        self._look()
        if self.groups == 1:
            self.scale.fill_(self.now)
        else:
            self.scale.copy_(torch.from_numpy(self._scales))

    def cap(self, most: float) -> None:
        """No group has more than this scale from now on, until its failures raise it again."""
        if float(self._scales.max()) > most:
            self.set(np.minimum(self._scales, most))

    def use(self, used: Tensor) -> None:
        """Which groups `(G,)` bool take part; what the others have left does not count in `now`."""
        if self.groups > 1:
            self._used = used.cpu().numpy().astype(bool)
            self._look()

    def _look(self) -> None:
        self.now = float(self._scales[self._used].max(initial=0.0))

    @property
    def left(self) -> float | Tensor:
        """What `set` takes: the scale of all, or a copy of those of the groups, `(G,)` on the CPU; 0.0
        where no group in use is helped."""
        return self.now if self.groups == 1 or self.now == 0.0 else torch.tensor(self._scales)

    def group(self, goal: Goal) -> Tensor | None:
        """`(N,)` the group that each world belongs to in the present step; None where all are one."""
        return None if self.groups == 1 else goal.clips.group(self.by)

    def at(self, group: Tensor | None) -> Tensor:
        """The scale of worlds that belong to `group (N,)`: `(N,)`, or 0-dimensional for one group."""
        return self.scale if group is None else self.scale[group]

    def limit(self, most: float, group: Tensor | None) -> float | Tensor:
        """What is left of a limit: a number, or for worlds of different groups `(N,)`."""
        return self.now * most if group is None or self.now == 0.0 else self.at(group) * most

    @property
    def success(self) -> float:
        """Share of recent episodes that did not fail; NaN before the first has ended."""
        ended, failed = self._counts.sum(1).tolist()
        return 1.0 - failed / ended if ended else float("nan")

    def count(self, outcome: StepOutcome) -> None:
        if self.schedule is None:
            return
        if self.by == "bin":
            self.add(*outcome.bins)
        else:
            ids, group = outcome.ids, self.group(outcome.goal)
            failed = outcome.ends[0, ids].double()
            self.add(ids if group is None else group[ids], torch.ones_like(failed), failed)

    def add(self, group: Tensor, ended: Tensor, failed: Tensor) -> None:
        """One control step in which `ended (n,)` outcomes of `group (n,)`, 1 or 0 each, became known,
        `failed (n,)` of them failures.

        Nothing here waits for a GPU if there are several groups, but for a decision now and then.
        """
        if self.schedule is None:
            return
        if self.groups == 1:
            self._counts.numpy()[:, 0] += int(ended.sum()), int(failed.sum())
        elif len(group):
            # Ones are added, so that their order, which a GPU does not keep, makes no difference.
            self._counts.index_add_(1, group, torch.stack((ended, failed)))
        self._tick(self.schedule)

    def _tick(self, schedule: HelpSchedule) -> None:
        self.steps += 1
        if self.steps % schedule.every:
            return
        ended, failed = self._counts.cpu().numpy()
        known = ended >= EPISODES if self.groups > 1 else ended > 0
        success = np.full(self.groups, np.nan)
        np.divide(failed, ended, out=success, where=known)
        given = zip(self._scales.tolist(), (1.0 - success).tolist(), strict=True)
        self.set(np.array([schedule.scale(scale, self.steps, share) for scale, share in given]))
        self._counts *= torch.as_tensor(np.where(known, KEPT, 1.0)).to(self._counts.device)

    def state(self) -> dict[str, Tensor]:
        """Under "help", float64 `(4)`: `now`, steps, ended and failed episodes of all; and with G groups
        their scales, ended and failed, `(4 + 3 G)`."""
        counts = self._counts.cpu()
        head = torch.tensor((self.now, self.steps, *counts.sum(1).tolist()), dtype=torch.float64)
        if self.groups == 1:
            return {"help": head}
        return {"help": torch.cat((head, torch.tensor(self._scales).double(), counts.flatten()))}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Goes on from `state()`; from that of one group with its scale for all, which then know no
        episodes yet, and from that of groups as one group with the most that any has left.

        Raises:
            PoiseError: the state is that of another number of groups.
        """
        saved = state["help"]
        now, steps, *totals = saved[:4].tolist()
        own, self.steps = saved[4:].cpu().double(), int(steps)
        if self.groups == 1:
            self.set(now)
            self._counts.copy_(torch.tensor(totals, dtype=torch.float64)[:, None])
        elif not len(own):
            self.set(now)
            self._counts.zero_()
        elif len(own) != 3 * self.groups:
            what = f"the state is that of help for {len(own) // 3} groups, and there are {self.groups}"
            raise PoiseError(what, code="state-differs")
        else:
            own = own.reshape(3, self.groups)
            self.set(own[0])
            self._counts.copy_(own[1:])


def scale_in(state: Mapping[str, Tensor]) -> float:
    """The scale of the help in a trainer's saved state, of the clip that has most; 1 where none was
    saved."""
    found = state.get("env/help")
    return 1.0 if found is None else float(found[0])
