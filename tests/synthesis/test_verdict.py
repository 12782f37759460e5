"""Filled gaps pass the doctor, are filled anew where they do not, and what stays bad is named."""

from __future__ import annotations

import numpy as np
import pytest
from test_inbetween_fill import model

from poise.kinematics.repair.faults import KINDS
from poise.motion import Clip
from poise.synthesis.filler import Filler, Filling, Gap
from poise.synthesis.keyframes import fill_keyframes
from poise.synthesis.limits import Feet
from poise.synthesis.rounds import JUDGED, GapFault, distance, judged, told, weight
from toy_human import swing


def teleported(clip: Clip, first: int, last: int) -> Clip:
    """The clip with its root 0.4 m aside in some frames."""
    root = np.array(clip.root_pos)
    root[first : last + 1, 1] += 0.4
    return clip.replaced(root_pos=root)


def test_a_fault_counts_to_the_gap_with_frames_in_it() -> None:
    clip, gaps = swing(4.0), [Gap(10, 50), Gap(50, 90)]
    clean = judged(clip, gaps)
    found = judged(teleported(clip, 60, 75), gaps, sample=2)
    assert all(k in KINDS for k in JUDGED)
    assert weight(found[gaps[1]]) > weight(clean.get(gaps[1], ()))
    jumps = [f for f in found[gaps[1]] if f.kind == "teleport"]
    assert [f.start for f in jumps] == [60, 76] and jumps[0].sample == 2
    assert not [f for f in found.get(gaps[0], ()) if f.kind == "teleport"]
    assert jumps[0].sentence() == "Hips: the root jumps (0.4 m), frames 60 to 60"
    assert jumps[0].to_dict()["unit"] == "m" and jumps[0].to_dict()["gap"] == [50, 90]


def test_the_sentence_names_each_fault_once_and_counts_the_rest() -> None:
    many = [GapFault("teleport", "Hips", k, k, 0.5, (0, 40)) for k in range(8)]
    said = told([*many, *many])
    assert said.count("the root jumps") == 6 and said.endswith("; and 2 more")
    assert weight(many) == (1, 8) and weight(()) == (0, 0)
    # A long way in few frames is worse than a short one in many.
    far, near = (GapFault("foot slide", "L", 0, n, cm, (0, 30)) for n, cm in ((9, 35.0), (20, 13.0)))
    assert weight([near]) < weight([far]) and distance([far, near, *many]) == 48.0


def test_a_gap_with_faults_is_filled_anew_and_one_without_is_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The first round of one gap is spoiled by a teleport; the second is kept, and keyframes stay."""
    calls: list[tuple[Gap, float]] = []
    fill = Filler.fill

    def spoiled(
        self: Filler,
        root: np.ndarray,
        rot: np.ndarray,
        gap: Gap,
        noise: object,
        most: float,
        ways: tuple[Feet, ...],
    ) -> None:
        fill(self, root, rot, gap, noise, most, ways)  # type: ignore[arg-type]
        calls.append((gap, most))
        if gap.a == 45 and most == 1.0:
            root[gap.a + 8 : gap.b - 8, 1] += 0.5

    clip = swing(4.0)
    plain = fill_keyframes(clip, (15, 45, 75), model(), Filling(rounds=1))
    monkeypatch.setattr(Filler, "fill", spoiled)
    named = fill_keyframes(clip, (15, 45, 75), model(), Filling(rounds=1))
    assert any(f.kind == "teleport" and f.gap == (45, 75) for f in named.faults)
    assert any("the root jumps" in w for w in named.warnings)
    assert not any(w.startswith("sample") for w in named.warnings)
    two = fill_keyframes(clip, (45, 75), model(), Filling(samples=2, rounds=1))
    assert [w[:10] for w in two.warnings if "the root jumps" in w] == ["sample 0: ", "sample 1: "]
    calls.clear()
    mended = fill_keyframes(clip, (15, 45, 75), model())
    assert not any(f.kind == "teleport" for f in mended.faults)
    assert calls[0][1] == 1.0 and (Gap(45, 75), 0.5) in calls
    keys = [15, 45, 75]
    np.testing.assert_allclose(mended.clips[0].positions()[keys], clip.positions()[keys], atol=1e-9)
    assert weight(mended.faults) <= weight(plain.faults) or not plain.faults
    for at in keys[1:2]:
        one, two = np.diff(mended.clips[0].root_pos[at - 1 : at + 2], axis=0)
        np.testing.assert_allclose(one, two, atol=1e-6)


def test_variants_are_drawn_anew_and_the_same_seed_gives_the_same() -> None:
    clip = swing(3.0)
    once = fill_keyframes(clip, (20, 60), model(), Filling(samples=3, seed=4))
    again = fill_keyframes(clip, (20, 60), model(), Filling(samples=3, seed=4))
    assert all(np.array_equal(a.rot, b.rot) for a, b in zip(once.clips, again.clips, strict=True))
    assert once.faults == again.faults
    assert {f.sample for f in once.faults} <= {0, 1, 2}
