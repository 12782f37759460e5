"""When in each period a control step begins: soon after what it is about has come."""

from __future__ import annotations

from collections import deque

import numpy as np

#: Packets by which it is known when they come; s after them at which a step begins; s by which one step
#: is moved at most; s that must be gained for it to be moved.
SEEN, MARGIN_S, MOVES_S, GAINS_S = 64, 0.003, 0.0005, 0.002


class Phase:
    """Sources have clocks of their own. A packet that comes just after a step began waits a whole period
    for the next one; one that comes before it does not wait at all.

    Steps are moved, by no more than `MOVES_S` each, to where 95 % of the packets wait the least. Packets
    that come at any time, as those of many sources, leave them where they are.

    Args:
        period_s: s between steps.
    """

    def __init__(self, period_s: float):
        self.period_s = period_s
        self._came: deque[float] = deque(maxlen=SEEN)

    def add(self, arrived_s: list[float]) -> None:
        """When packets came, by the loop's clock."""
        self._came += arrived_s

    def shift(self, due_s: float) -> float:
        """s by which a step that is due at `due_s` is to come later; less than 0 for sooner."""
        if len(self._came) < SEEN:
            return 0.0
        period = self.period_s
        phases = (np.array(self._came) - due_s) % period
        starts = np.append((phases + MARGIN_S) % period, 0.0)
        # What comes less than a margin before a step might as well come after it.
        waits = np.percentile((starts[:, None] - phases - MARGIN_S / 2) % period, 95, axis=1)
        best = int(waits.argmin())
        if waits[best] > waits[-1] - GAINS_S:
            return 0.0
        # The shorter way round.
        way = (float(starts[best]) + period / 2) % period - period / 2
        return float(np.clip(way, -MOVES_S, MOVES_S))
