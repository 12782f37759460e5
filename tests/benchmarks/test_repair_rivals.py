"""The rivals of the repair do what is said of them."""

from __future__ import annotations

from importlib.resources import as_file, files

import numpy as np
from repair import dirty
from repair_rivals import foot_lock, standing

from poise.body import find_anatomy
from poise.formats import read_clip
from poise.motion.smoothing import find_runs


def test_a_foot_lock_keeps_feet_where_they_touch_down() -> None:
    with as_file(files("poise") / "data/walk.bvh") as path:
        walk = read_clip(path)
    broken = dirty(walk, "white", 25.0, 0)
    locked = foot_lock(broken, walk)
    assert locked is not None
    before, after = broken.positions(), locked.positions()
    foot = find_anatomy(walk.skeleton).of("foot", "left")[0]
    runs = find_runs(standing(walk.positions()[:, [foot]], walk.fps)[:, 0], 0)
    assert runs
    for first, last in runs:
        assert np.ptp(after[first : last + 2, foot], axis=0).max() < 0.01
        assert np.ptp(before[first : last + 2, foot], axis=0).max() > 0.02
    # All but the legs stays as it is.
    head = walk.skeleton.index("Head")
    np.testing.assert_allclose(after[:, head], before[:, head], atol=1e-12)
