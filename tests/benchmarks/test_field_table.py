"""The field's table: hand-computed figures, a naive twin, JSON and Markdown."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from field.card import FIGURES, FieldTable, markdown, read_field_table, write_field_table
from field.paper import PHC_RECOVERY, PHC_ROWS, paper_rows
from field.sources import source_of, source_table
from field.table import field_table

from poise.score.rollouts import RolloutSet
from refusals import refused


def rollouts(
    pos: torch.Tensor, ref: torch.Tensor, lengths: list[int], clips: list[str], **more
) -> RolloutSet:
    """Episodes of one clip each, in the order given; padding is NaN."""
    episodes, frames, bodies, _ = pos.shape
    alive = torch.arange(frames) < torch.tensor(lengths)[:, None]
    pos = torch.where(alive[..., None, None], pos, torch.nan)
    quat = torch.tensor([1.0, 0, 0, 0]).expand(episodes, frames, bodies, 4)
    zero = torch.zeros(episodes, frames, 1, 3)
    names = tuple(dict.fromkeys(clips))
    values = {
        "reached_end": torch.ones(episodes, dtype=torch.bool),
        "start": torch.zeros(episodes, dtype=torch.long),
        "fps": 30.0,
    }
    return RolloutSet(
        pos=pos, quat=quat, ref_pos=ref, ref_quat=quat, alive=alive, lengths=torch.tensor(lengths),
        force=zero, torque=zero, point_vel=zero, ang_vel=zero, mass=50.0, limit_n=0.0, limit_nm=0.0,
        clip=torch.tensor([names.index(c) for c in clips]), clip_names=names, **(values | more),
    )  # fmt: skip


def still(frames: list[int]) -> tuple[torch.Tensor, torch.Tensor]:
    ref = torch.zeros(len(frames), max(frames), 3, 3, dtype=torch.float64)
    ref[:, :, 1, 2], ref[:, :, 2, 0] = 0.5, 0.3
    return ref.clone(), ref


def test_by_hand() -> None:
    pos, ref = still([11, 5])
    # Clip "a": one of three bodies, not the root, is 30 mm off. Clip "b": all are 60 mm off.
    pos[0, 1:, 1, 0] += 0.03
    pos[1, 1:, :, 1] += 0.06
    table = field_table(rollouts(pos, ref, [11, 5], ["a", "b"]), method="m", data="d")
    assert (table.succ, table.episodes, table.frames, table.failed) == (1.0, 2, 14, ())
    by_frame, by_clip = table.views["all_frame"], table.views["all_clip"]
    assert by_frame.g_mpjpe == pytest.approx((10 * 10 + 4 * 60) / 14)
    assert by_clip.g_mpjpe == pytest.approx((10 + 60) / 2)
    assert by_frame.mpjpe == pytest.approx(10 * 10 / 14)
    assert by_clip.mpjpe == pytest.approx(5.0)
    # A whole body that is moved is nothing to Procrustes, nor to speeds.
    assert table.clips[0].clip == "b" and table.clips[0].errors.pa_mpjpe == pytest.approx(0, abs=1e-9)
    assert by_frame.vel == pytest.approx(0, abs=1e-9) and by_frame.acc == pytest.approx(0, abs=1e-9)
    assert table.views["succ_frame"] == by_frame and table.views["succ_clip"] == by_clip


def test_speeds_by_hand() -> None:
    pos, ref = still([6])
    # Steps of 9 mm per frame of one body in three: 3 mm/frame; no acceleration.
    pos[0, :, 1, 0] += 0.009 * torch.arange(6)
    errors = field_table(rollouts(pos, ref, [6], ["a"])).views["all_frame"]
    assert errors.vel == pytest.approx(3.0) and errors.acc == pytest.approx(0.0, abs=1e-9)
    # 0.5 a t^2 with 6 mm/frame^2: 2 mm/frame^2 on average; at 60 Hz a frame is half as long.
    pos, ref = still([6])
    pos[0, :, 1, 0] += 0.003 * torch.arange(6) ** 2
    assert field_table(rollouts(pos, ref, [6], ["a"])).views["all_frame"].acc == pytest.approx(2.0)
    fast = field_table(rollouts(pos, ref, [6], ["a"], fps=60.0)).views["all_frame"]
    assert fast.acc == pytest.approx(8.0)


def test_a_failed_clip_counts_up_to_its_failure() -> None:
    pos, ref = still([11, 11])
    pos[0, 1:, :, 0] += 0.01
    pos[1, 1:, :, 0] += 0.1
    pos[1, 4:, :, 0] += 0.7
    table = field_table(rollouts(pos, ref, [11, 11], ["good", "bad"]))
    assert table.succ == 0.5 and table.failed == ("bad",)
    bad = table.clips[0]
    assert (bad.clip, bad.failed, bad.frames) == ("bad", 1, 4)
    assert bad.first_fail_s == pytest.approx(4 / 30)
    assert bad.errors.g_mpjpe == pytest.approx((3 * 100 + 800) / 4)
    assert table.views["all_frame"].g_mpjpe == pytest.approx((10 * 10 + 3 * 100 + 800) / 14)
    assert table.views["all_clip"].g_mpjpe == pytest.approx((10 + 275) / 2)
    assert table.views["succ_frame"].g_mpjpe == table.views["succ_clip"].g_mpjpe == pytest.approx(10)


def naive(r: RolloutSet) -> dict[str, dict[str, float]]:
    """The same table in loops and NumPy, with a Procrustes of its own."""
    clips: dict[str, dict[str, list[float]]] = {}
    for e in range(len(r.pos)):
        p, q = r.pos[e].double().numpy(), r.ref_pos[e].double().numpy()
        last = int(r.lengths[e]) - 1
        won = True
        for t in range(last + 1):
            if not np.mean(np.linalg.norm(p[t] - q[t], axis=-1)) <= 0.5:
                last, won = t, False
                break
        entry = clips.setdefault(r.clip_name(int(r.clip[e])), {})
        for t in range(1, last + 1):
            x, y = p[t] - p[t].mean(0), q[t] - q[t].mean(0)
            u, s, vt = np.linalg.svd(x.T @ y)
            d = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
            fitted = x @ (u @ d @ vt) * np.trace(np.diag(s) @ d) / np.sum(x**2)
            found = {
                "g_mpjpe": p[t] - q[t],
                "mpjpe": (p[t] - p[t, 0]) - (q[t] - q[t, 0]),
                "pa_mpjpe": fitted - y,
            }
            if t >= 2:
                found["vel"] = (p[t] - p[t - 1]) - (q[t] - q[t - 1])
            if t >= 3:
                found["acc"] = (p[t] - 2 * p[t - 1] + p[t - 2]) - (q[t] - 2 * q[t - 1] + q[t - 2])
            for name, value in found.items():
                for key in (name, f"succ {name}") if won else (name,):
                    entry.setdefault(key, []).append(1000 * np.linalg.norm(value, axis=-1).mean())
    out: dict[str, dict[str, float]] = {}
    for view, prefix in (("all", ""), ("succ", "succ ")):
        lists = [{n: c.get(prefix + n, []) for n in FIGURES} for c in clips.values()]
        out[f"{view}_frame"] = {n: float(np.mean([x for c in lists for x in c[n]])) for n in FIGURES}
        out[f"{view}_clip"] = {
            n: float(np.mean([np.mean(c[n]) for c in lists if c[n]])) for n in FIGURES
        }
    return out


def noisy(seed: int = 0) -> RolloutSet:
    generator = torch.Generator().manual_seed(seed)
    shape = (5, 20, 4, 3)
    ref = torch.randn(shape, generator=generator, dtype=torch.float64).cumsum(1) * 0.02
    ref += torch.randn(5, 1, 4, 3, generator=generator, dtype=torch.float64)
    pos = ref + 0.05 * torch.randn(shape, generator=generator, dtype=torch.float64)
    pos[1, 12:] += 0.9
    pos[4, 6:] += 0.9
    return rollouts(pos, ref, [20, 18, 9, 20, 15], ["a", "a", "b", "c", "c"])


def test_naive_twin() -> None:
    r = noisy()
    table, twin = field_table(r), naive(r)
    assert table.succ == pytest.approx(0.6)
    for view, want in twin.items():
        for name in FIGURES:
            assert getattr(table.views[view], name) == pytest.approx(want[name], rel=1e-9), (view, name)


def test_in_parts_as_in_one() -> None:
    r = noisy()

    def part(rows: slice) -> RolloutSet:
        names = (
            "lengths",
            "reached_end",
            "clip",
            "start",
            "pos",
            "quat",
            "ref_pos",
            "ref_quat",
            "alive",
        )
        names += ("force", "torque", "point_vel", "ang_vel")
        return replace(r, **{n: getattr(r, n)[rows] for n in names})

    whole, parts = field_table(r), field_table(part(s) for s in (slice(0, 2), slice(2, 5)))
    assert whole == parts


def test_bodies_and_root() -> None:
    pos, ref = still([5])
    pos[0, 1:, 2] += 9.0
    r = rollouts(pos, ref, [5], ["a"], rule_bodies=(0, 1))
    assert field_table(r, bodies=(0, 1)).views["all_frame"].g_mpjpe == 0.0
    assert field_table(r, bodies=(0, 1)).succ == 1.0
    with refused("joint-missing"):
        field_table(r, bodies=(1, 2))


def test_a_state_that_blew_up() -> None:
    pos, ref = still([6])
    pos[0, 3:] = torch.inf
    table = field_table(rollouts(pos, ref, [6], ["a"]))
    assert table.succ == 0.0 and table.clips[0].frames == 2
    assert table.views["all_frame"].g_mpjpe == 0.0
    assert math.isnan(table.views["succ_frame"].g_mpjpe)


def test_json_and_back(tmp_path) -> None:
    table = field_table(noisy(), method="poise", data="library")
    path = write_field_table(table, tmp_path / "field.json")
    again = read_field_table(path)
    assert json.loads(path.read_text()) == table.to_dict()
    assert again.to_dict() == table.to_dict() and again.failed == table.failed == ("c", "a")
    assert isinstance(again, FieldTable)
    path.write_text("{}")
    with refused("wrong-file-kind"):
        read_field_table(path)


def test_markdown_beside_the_paper() -> None:
    table = field_table(noisy(), method="poise", data="library")
    lines = markdown(table, paper_rows("AMASS-Test"), worst=2).splitlines()
    assert lines[2].startswith("| poise | library | 3 | all clips, by frame | 60.0 |")
    assert (
        "| PHC (PHC table 1) | AMASS-Test | 140 | not stated | 96.4 | 47.4 | 30.9 | - | 6.8 | 9.1 |"
        in lines
    )
    assert any("swapped" in line for line in lines)
    assert "poise on library: 2 of 3 clips failed" in lines
    assert {line.count("|") for line in lines if line.startswith("|")} == {11, 10}
    assert [line.split(" | ")[0] for line in lines[-2:]] == ["| c", "| a"]


def test_the_papers_rows_are_whole() -> None:
    assert len(PHC_ROWS) == 17 and len(PHC_RECOVERY) == 6
    assert all(0 < r.succ <= 100 and r.clips in (11313, 140, 160) for r in PHC_ROWS)
    assert [r.succ for r in paper_rows("AMASS-Train") if not r.help] == [98.9, 98.7, 84.5]


def test_what_cannot_be_tabulated() -> None:
    with refused("no-rollouts"):
        field_table([])
    pos, ref = still([5])
    two = [rollouts(pos, ref, [5], ["a"], fps=f) for f in (30.0, 60.0)]
    with refused("rate-differs"):
        field_table(two)
    with refused("unknown-choice"):
        field_table(two[0], rule="pch")


def test_errors_over_all_frames_stand_beside_those_until_the_failure() -> None:
    pos, ref = still([5])
    pos[0, 1:, :, 0] += 0.1
    pos[0, 3:, :, 0] += 0.5
    table = field_table(rollouts(pos, ref, [5], ["a"]))
    # 100, 100 and 600 mm; then one frame more of 600.
    assert table.succ == 0 and table.views["all_frame"].g_mpjpe == pytest.approx(800 / 3)
    assert table.views["uncut_frame"].g_mpjpe == pytest.approx(1400 / 4)
    # Tables of before know nothing of it.
    data = table.to_dict()
    del data["views"]["uncut_frame"], data["views"]["uncut_clip"]
    old = FieldTable.from_dict(data)
    assert "uncut_frame" not in old.views and "after failures" not in markdown(old)


@pytest.mark.parametrize(
    ("name", "source"),
    [
        ("cmu_expmaps-train_walking_13_extra", "CMU, walks published for prediction"),
        ("cmu_expmaps-test_running_1", "CMU, runs, jumps and ball games published for prediction"),
        ("deepmimic-humanoid3d_dance_a", "DeepMimic"),
        ("bandai_bvh-dataset_2_walk_active_015", "Bandai"),
        ("held_out-cmu_amc-rfc-05_06", "CMU, dances"),
        ("cmu_amc-02-02_05", "CMU, other"),
    ],
)
def test_clips_have_a_source(name: str, source: str) -> None:
    assert source_of(name) == source


def test_a_table_by_source() -> None:
    pos, ref = still([5, 5, 5])
    pos[0, 1:, :, 0] += 0.01
    pos[1, 1:, :, 0] += 0.03
    pos[2, 1:, :, 0] += 0.6
    names = ["deepmimic-a", "deepmimic-b", "bandai-c"]
    lines = source_table([field_table(rollouts(pos, ref, [5, 5, 5], names))]).splitlines()
    assert lines[2].startswith("|  |  | DeepMimic | 2 | 100.0 | 20.0 |")
    assert lines[3].startswith("|  |  | Bandai | 1 | 0.0 | 600.0 |")
