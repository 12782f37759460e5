"""Libraries of clips: sampling by time, weights, one hierarchy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from poise.errors import PoiseError
from poise.motion import ClipLibrary
from toy_human import human, swing


def test_one_clip_is_a_library_of_one():
    library = ClipLibrary.of(swing())
    assert len(library) == 1 and library.names == ("swing",) and library.seconds == pytest.approx(1.0)
    assert [c.name for c in library] == ["swing"]


def test_sampling_follows_duration_and_stays_inside():
    library = ClipLibrary.of([swing(3.0), swing(1.0, name="short")])
    which, time = library.sample(20_000, np.random.default_rng(0))
    assert np.mean(which == 0) == pytest.approx(0.75, abs=0.01)
    assert time.min() >= 0 and time[which == 1].max() <= 1.0 < time[which == 0].max() <= 3.0
    # Uniform in the clip: mean and spread of a uniform number.
    long = time[which == 0] / 3.0
    assert long.mean() == pytest.approx(0.5, abs=0.01) and long.std() == pytest.approx(
        12**-0.5, abs=0.01
    )


def test_the_same_seed_draws_the_same():
    library = ClipLibrary.of([swing(1.0), swing(2.0, name="b")])
    a, b, c = (library.sample(50, np.random.default_rng(s)) for s in (1, 1, 2))
    assert np.array_equal(a[0], b[0]) and np.array_equal(a[1], b[1])
    assert not np.array_equal(a[1], c[1])


def test_weights_rule_where_stated():
    library = ClipLibrary((swing(3.0), swing(1.0, name="b")), (0.0, 2.0))
    assert set(library.sample(100, np.random.default_rng(0))[0]) == {1}


def test_bone_lengths_may_differ_but_hierarchies_not():
    ClipLibrary((swing(), swing(scale=1.2, name="tall")))
    skeleton = human()
    renamed = replace(skeleton, names=("pelvis", *skeleton.names[1:]))
    with pytest.raises(PoiseError, match="odd: its joints differ from those of 'swing'"):
        ClipLibrary((swing(), swing(name="odd").replaced(skeleton=renamed)))
    with pytest.raises(PoiseError, match="at least one clip"):
        ClipLibrary(())


@pytest.mark.parametrize("weights", [(1.0,), (1.0, -1.0), (0.0, 0.0), (1.0, 1.0, 1.0)])
def test_wrong_weights_are_told(weights):
    with pytest.raises(PoiseError, match="a library of 2 clips needs as many weights"):
        ClipLibrary((swing(), swing(name="b")), weights)
