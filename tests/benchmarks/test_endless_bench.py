"""What the tables of predictions holds out, how far off futures are, what acts on a policy."""

from __future__ import annotations

import pytest
import torch

from benchmarks.suites import papers_prediction as data
from benchmarks.suites.papers_next_frames import NextFrame

methods = tables = data

CMU = data.LIBRARIES["CMU"]


def _clips() -> data.Clips:
    names = [f"cmu_bvh-acrnn_salsa-{k:02d}" for k in (1, 2, 3, 4, 5, 6, 16, 21)]
    names += ["cmu_amc-08-08_01", "cmu_amc-02-02_05", "cmu_amc-08-08_02"]
    long = [torch.rand(200, 9).double() for _ in names[:-1]]
    return data.Clips([*long, torch.rand(40, 9).double()], names)


def test_what_is_predicted_is_not_learned_from():
    clips = _clips()
    windows, learned = data.windows_of(clips, CMU)
    names = {clips.names[k] for k in learned}
    assert not names & {w.clip for w in windows}
    # A subject that Cross holds out has no clip left, however short; nor has a partner in a dance.
    assert not any("08_" in n for n in names)
    assert {w.clip for w in windows if w.cross} == {"cmu_amc-08-08_01"}
    dances = {w.clip for w in windows if w.kind == "dance"}
    assert dances == {"cmu_bvh-acrnn_salsa-01", "cmu_bvh-acrnn_salsa-06"}
    assert not names & {"cmu_bvh-acrnn_salsa-16", "cmu_bvh-acrnn_salsa-21"}
    assert all(len(w.past) == 30 and len(w.true) == 60 for w in windows)


def test_errors_are_distances_of_all_hinges():
    past, true = torch.zeros(30, 9).double(), torch.zeros(60, 9).double()
    windows = [data.Window(past, true, "dance", "a", False), data.Window(past, true, "walk", "b", True)]
    made = torch.zeros(4, 60, 9).double()
    # The root is not compared. One sample of the second window is off by 5 rad in its last frame.
    made[..., :7] = 9.0
    made[3, -1, 7:] = torch.tensor([3.0, 4.0])
    out = tables.figures(windows, tables.off(windows, made, 2))
    assert out["mix"]["mae"] == out["dance"]["fae"] == 0
    assert out["cross"]["mae"] == pytest.approx(5 / 60 / 2, abs=1e-3)
    assert out["cross"]["fae"] == 2.5 and out["cross"]["best_fae"] == 0
    assert tables.fallen(windows, made, 2) == 0
    made[2:, :, 2] = -0.5
    assert tables.fallen(windows, made, 2) == 0.5


def test_actions_are_added_to_those_of_the_policy_below():
    joints, more = torch.tensor([[1.0, 2.0]]), torch.tensor([[0.5, -0.5, 7.0]])
    assert methods.added(joints, more).tolist() == [[1.5, 1.5, 7.0]]


@pytest.mark.parametrize("name", methods.NETS)
def test_networks_go_on_from_a_past(name: str):
    net = NextFrame(12, methods.NETS[name], torch.Generator().manual_seed(0))
    assert net.continued(torch.zeros(2, 30, 12)).shape == (2, 60, 12)
