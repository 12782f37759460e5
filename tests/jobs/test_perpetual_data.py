"""A folder of motion becomes a library on one skeleton, with a word on every file."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from poise.body import BodyConfig
from poise.formats import write_clip
from poise.jobs.library import folder as perpetual_data
from poise.jobs.library.clips import LibraryConfig, LibraryReport
from poise.jobs.library.files import content_key, is_motion, motion_files_of, subject_of
from poise.jobs.library.folder import library_of, split
from poise.kinematics import Kinematics, fit_humanoid
from poise.kinematics.coords import clip_to_qpos
from poise.kinematics.feet import stance_heights
from poise.motion import Clip, shifted
from poise.motion.smoothing import white_mm
from refusals import refused
from toy_human import human, swing, trembling


def write(folder: Path, name: str, clip: Clip) -> Path:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    write_clip(clip.replaced(name=path.stem), path)
    return path


def held(seconds: float = 4.0, start: int = 30, stop: int = 75) -> Clip:
    clip = swing(seconds=seconds)
    offset = np.zeros((clip.frames, 3))
    offset[start:stop, 2] = 0.6
    # 9 m/s on the way.
    offset[[start, stop - 1], 2] = 0.3
    return shifted(clip, offset)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two performers of one hierarchy, one clip that is held up, and files of no use."""
    root = tmp_path / "cmu"
    write(root, "02/02_01.bvh", swing(seconds=2.0, fps=60.0))
    write(root, "02/02_02.bvh", swing(seconds=3.0, speed=0.5))
    write(root, "07/07_01.bvh", swing(seconds=2.0, scale=1.2))
    write(root, "07/07_02.bvh", held())
    write(root, "07/07_03.bvh", swing(seconds=0.2))
    write(root, "07/swimming.bvh", swing(seconds=2.0))
    (root / "07/07_04.bvh").write_text("HIERARCHY\nROOT")
    (root / "readme.txt").write_text("no motion")
    return root


def test_what_becomes_of_each_file(folder: Path) -> None:
    library, report = library_of(folder)
    fates = {c.name: (c.state, c.rule) for c in report.clips}
    assert fates == {
        "cmu-02-02_01": ("kept", ""),
        "cmu-02-02_02": ("kept", ""),
        "cmu-07-07_01": ("kept", ""),
        "cmu-07-07_02": ("cut", "held"),
        "cmu-07-07_03": ("left out", "short"),
        "cmu-07-07_04": ("left out", "unreadable"),
        "cmu-07-swimming": ("left out", "word"),
    }
    assert library.names == ("cmu-02-02_01", "cmu-02-02_02", "cmu-07-07_01", "cmu-07-07_02")
    assert {c.fps for c in library} == {30.0}
    skeleton = library.clips[0].skeleton
    assert all(np.array_equal(c.skeleton.offsets, skeleton.offsets) for c in library)
    # The bones with the most seconds; the larger performer came onto them at a smaller scale.
    for name, offset in zip(skeleton.names, skeleton.offsets, strict=True):
        np.testing.assert_allclose(offset, human().offsets[human().index(name)], atol=1e-6)
    big = report.of("cmu-07-07_01")
    assert big.retargeted and big.scale == pytest.approx(1 / 1.2, abs=1e-3)
    cut = report.of("cmu-07-07_02")
    assert cut.kept_s[0] == pytest.approx(2.6, abs=0.05) and cut.kept_s[1] == pytest.approx(4.0)
    assert cut.frames == library.clips[3].frames
    assert cut.sentence().startswith("cmu-07-07_02: cut to 2.6 to 4.0 s of 4.0 s, since for 1.5 s")
    assert "up to 0.59 m above" in cut.sentence()
    text = "\n".join(report.sentences())
    assert "4 of 7 clips" in text and "its name says 'swimming'" in text and "fewer than 10" in text
    assert report.subjects == ("cmu 02", "cmu 07")


def test_all_stand_on_the_floor_and_a_humanoid_takes_them(folder: Path) -> None:
    library, _ = library_of(folder)
    assert {c.skeleton.source.ground_m for c in library} == {0.0}
    _, motions, report = fit_humanoid(library)
    assert len(motions) == len(library)
    # Told that the floor is known, the fit moves no clip as a whole.
    assert [c.ground.lift_m for c in report.clips] == [0.0] * len(library)
    assert max(c.ground.clear_m.max() + c.ground.settle_m.max() for c in report.clips) < 0.03
    assert max(c.joint_error_mm for c in report.clips) < 1.0


def test_rules_can_be_overruled_and_patterns_left_out(folder: Path) -> None:
    config = LibraryConfig(keep=("07_02", "swim"), leave_out=("cmu 02",), min_frames=5)
    library, report = library_of(folder, config=config)
    assert library.names == ("cmu-07-07_01", "cmu-07-07_02", "cmu-07-07_03", "cmu-07-swimming")
    assert report.of("cmu-02-02_01").rule == "by hand"
    assert library.clips[1].frames == 121


def leaping(metres: float, frame: int) -> Clip:
    """From a frame on it is elsewhere."""
    clip = swing(seconds=4.0)
    offset = np.zeros((clip.frames, 3))
    offset[frame:, 0] = metres
    return shifted(clip, offset)


def test_a_clip_that_leaps_faster_than_people_run_is_cut_there(tmp_path: Path) -> None:
    root = tmp_path / "cmu"
    write(root, "09/09_01.bvh", leaping(2.0, 1))
    write(root, "09/09_02.bvh", leaping(2.0, 90))
    write(root, "09/09_03.bvh", leaping(0.4, 60))
    write(root, "09/09_04.bvh", leaping(2.0, 90).replaced(fps=120.0))
    library, report = library_of(root)
    # 0.4 m in 1/30 s are 12 m/s.
    fates = {c.name[-5:]: (c.state, c.rule, round(c.kept_s[0], 2), c.frames) for c in report.clips}
    assert fates == {
        "09_01": ("cut", "leap", 0.17, 116),
        "09_02": ("cut", "leap", 0.0, 86),
        "09_03": ("kept", "", 0.0, 121),
        "09_04": ("left out", "leap", 0.0, 0),
    }
    assert max(np.abs(np.diff(c.root_pos, axis=0)).max() for c in library) < 0.43
    assert "since its root leaps by 2.0" in report.of("cmu-09-09_02").sentence()
    kept, report = library_of(root, config=LibraryConfig(keep=("09_02",)))
    assert report.of("cmu-09-09_02").state == "kept" and kept.clips[1].frames == 121


def test_onto_a_skeleton_a_clip_or_a_file(folder: Path, tmp_path: Path) -> None:
    small = swing(scale=0.9)
    path = write(tmp_path, "target.npz", small)
    for onto in (small.skeleton, small, path):
        library, report = library_of(folder / "02", onto=onto)
        np.testing.assert_allclose(library.clips[0].skeleton.offsets, small.skeleton.offsets, atol=1e-9)
        assert report.clips[0].scale == pytest.approx(0.9, abs=1e-3)


def test_skeletons_keep_their_bones_on_the_joints_of_one(folder: Path) -> None:
    one, _ = library_of(folder)
    library, _ = library_of(folder, config=LibraryConfig(own_bones=True))
    assert library.names == one.names
    assert len({c.skeleton.names for c in library}) == 1
    assert len({c.skeleton.offsets.tobytes() for c in one}) == 1
    tall = library.clips[[n.startswith("cmu-07") for n in library.names].index(True)]
    low = library.clips[[n.startswith("cmu-02") for n in library.names].index(True)]
    np.testing.assert_allclose(tall.skeleton.offsets, 1.2 * low.skeleton.offsets, atol=1e-6)
    with refused("settings-conflict"):
        library_of(folder, human(), config=LibraryConfig(own_bones=True))


def test_the_second_run_takes_the_same_library_from_the_cache(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cache = tmp_path / "cache"
    first, report = library_of(folder, cache=cache)
    assert not report.cached and len(list(cache.iterdir())) == 1
    monkeypatch.setattr(perpetual_data, "read_all", None)
    again, cached = library_of(folder, cache=cache)
    assert cached.cached and cached.clips == report.clips and cached.onto == report.onto
    for a, b in zip(first, again, strict=True):
        assert (a.name, a.fps, a.cyclic, a.skeleton) == (b.name, b.fps, b.cyclic, b.skeleton)
        np.testing.assert_array_equal(a.root_pos, b.root_pos)
        np.testing.assert_array_equal(a.rot, b.rot)


def test_the_key_follows_content_names_and_settings(folder: Path) -> None:
    files = motion_files_of(folder)
    key = content_key(files, ["a"])
    assert key == content_key(motion_files_of(folder), ["a"])
    assert key != content_key(files, ["b"]) and key != content_key(files[1:], ["a"])
    data = files[0].path.read_bytes()
    files[0].path.write_bytes(data[:-3] + b"0\n")
    assert content_key(files, ["a"]) != key
    files[0].path.write_bytes(data)
    assert content_key(files, ["a"]) == key
    # The skeleton beside an AMC file is a part of it.
    (folder / "02/02.asf").write_text("x")
    assert content_key(files, ["a"]) != key


def test_a_report_survives_json(folder: Path) -> None:
    _, report = library_of(folder)
    assert LibraryReport.from_dict(json.loads(json.dumps(report.to_dict()))) == report


def test_whole_performers_are_held_out(folder: Path) -> None:
    library, _ = library_of(folder)
    train, test = split(library, ["cmu 02"])
    assert test.names == ("cmu-02-02_01", "cmu-02-02_02")
    assert train.names == ("cmu-07-07_01", "cmu-07-07_02")
    assert split(library, ["_01$"]).test.names == ("cmu-02-02_01", "cmu-07-07_01")
    # A subject is a whole word: "cmu 0" is none.
    with refused("pattern-fits-nothing", says=("cmu 0", "cmu 02, cmu 07")):
        split(library, ["cmu 0"])
    with refused("split-one-sided"):
        split(library, ["."])
    with refused("bad-regex"):
        split(library, ["("])


def test_names_and_subjects() -> None:
    assert subject_of("cmu_amc-02-02_01") == "cmu 02"
    assert subject_of("cmu_amc-usc-135_06_martialArts") == "cmu 135"
    assert subject_of("bvh-walk4_subject1") == "bvh subject 1"
    assert subject_of("deepmimic-long-walk") == "deepmimic-long"
    assert subject_of("walk") == "walk"


def test_equal_names_are_told_apart(tmp_path: Path) -> None:
    for name in ("a/walk.bvh", "a/walk.npz", "a/walk-1.npz"):
        write(tmp_path, name, swing())
    assert [f.name for f in motion_files_of(tmp_path / "a")] == ["a-walk", "a-walk-2", "a-walk_1"]


def test_only_motion_counts(tmp_path: Path) -> None:
    path = tmp_path / "notes.txt"
    path.write_text("hello")
    assert not is_motion(path)
    path.write_text('{"Loop": "wrap", "Frames": [[0.1]]}')
    assert is_motion(path)
    (tmp_path / "a.asf").write_text(":version 1.10")
    assert not is_motion(tmp_path / "a.asf")


def test_bad_input(tmp_path: Path) -> None:
    with refused("file-missing"):
        library_of(tmp_path / "nowhere")
    with refused("no-motion-files"):
        library_of(tmp_path)
    write(tmp_path, "x/short.bvh", swing(seconds=0.1))
    with refused("no-usable-files", says="1"):
        library_of(tmp_path / "x")
    write(tmp_path, "x/up.bvh", held(3.0, 20, 60))
    with refused("no-usable-files", says="2"):
        library_of(tmp_path / "x", config=LibraryConfig(min_cut_s=2.9))
    with refused("out-of-range", says="min_frames"):
        LibraryConfig(min_frames=1)


def test_a_body_of_ones_own(folder: Path) -> None:
    light, _ = library_of(folder / "02", body=BodyConfig(mass_kg=40.0))
    assert len(light) == 2


def test_real_clips(data_dir: Path, tmp_path: Path) -> None:
    asf = str(data_dir / "cmu_amc/rfc/08.asf")
    files = ["cmu_amc/02/02_01.amc", "cmu_amc/02/02_03.amc", "cmu_amc/rfc/90_11.amc"]
    files += ["cmu_bvh/ad/dance001.bvh", "deepmimic_txt/humanoid3d_crawl.txt"]
    files += ["deepmimic_txt/humanoid3d_backflip.txt", "deepmimic_txt/humanoid3d_getup_faceup.txt"]
    files += ["cmu_bvh/acrnn_salsa/12.bvh"]
    config = LibraryConfig(skeletons=(("90_", asf),))
    paths = [data_dir / f for f in files]
    onto = data_dir / "cmu_amc/02/02_01.amc"
    library, report = library_of(paths, onto=onto, config=config)
    assert report.count("left out") == 1
    # An AMC file states no rate: the likely one is taken. A BVH file does.
    hand, salsa = (next(c for c in report.clips if n in c.name) for n in ("90_11", "salsa"))
    assert hand.name.endswith("rfc-90_11") and hand.state == "kept"
    assert any("60 frames per second taken, not 120" in n for n in hand.notes)
    assert hand.seconds == pytest.approx(179 / 60, abs=0.04)
    assert salsa.name.endswith("salsa-12") and salsa.rule == "rate"
    assert "60 frames per second, not 120" in salsa.reason
    # Rolls, crawls, flips and getting up touch the floor or fall: nothing is cut.
    assert report.count("cut") == 0 and len(library) == 7
    assert split(library, ["cmu 02"]).test.names[0].endswith("cmu_amc-02-02_01")
    # A stated rate is obeyed, and the doubt told.
    stated = LibraryConfig(skeletons=(("90_", asf),), rates=(("90_11", 120.0),))
    (fast,), report = library_of(paths[2:3], onto=onto, config=stated)
    assert fast.seconds == pytest.approx(179 / 120, abs=0.04)
    assert any("60 frames per second, not 120" in n for n in report.clips[0].notes)


def test_feet_that_a_humanoid_turns_otherwise_stand_on_the_floor(data_dir: Path) -> None:
    # The skeleton's own feet point their toes down, which a rigid foot on two axes does not.
    paths = [data_dir / f"cmu_bvh/{name}.bvh" for name in ("acrnn_martial/04", "ad/frontkick001")]
    library, _ = library_of(paths, onto=data_dir / "cmu_amc/02/02_01.amc")
    body, motions, _ = fit_humanoid(library)
    for qpos in motions:
        pose = Kinematics(body.table)(qpos)
        heights = stance_heights(body.table, pose.pos, pose.quat, 30.0)
        assert len(heights) > 100 and abs(float(np.median(heights))) < 0.02


def test_feet_are_turned_only_where_motion_is_simulated(data_dir: Path) -> None:
    paths, onto = [data_dir / "cmu_amc/02/02_09.amc"], data_dir / "cmu_amc/02/02_01.amc"
    level, plain = (
        library_of(paths, onto=onto, config=LibraryConfig(level=x))[0].clips[0] for x in (True, False)
    )
    foot = plain.skeleton.index("lfoot")
    apart = np.abs((level.rot * plain.rot).sum(-1)).clip(max=1.0)
    # One turn for the whole clip, of the foot and of what must not follow it.
    assert np.degrees(2 * np.arccos(apart[:, foot])).min() > 3.0
    assert np.ptp(apart[:, foot]) < 1e-6
    others = [j for j in range(len(plain.skeleton)) if "foot" not in plain.skeleton.names[j]]
    others = [j for j in others if "toes" not in plain.skeleton.names[j]]
    np.testing.assert_allclose(apart[:, others], 1.0, atol=1e-9)


def test_a_partner_is_missed(data_dir: Path) -> None:
    path = data_dir / "cmu_bvh/acrnn_salsa/01.bvh"
    # Its file states 120 frames per second, at which it would be left out.
    config = LibraryConfig(rates=(("salsa", 60.0),))
    library, report = library_of([path], onto=data_dir / "cmu_amc/02/02_01.amc", config=config)
    assert [(c.state, c.rule) for c in report.clips] == [("cut", "leaning")]
    assert library.clips[0].seconds > 10.0


def test_every_clip_in_a_mirror_too(folder: Path) -> None:
    plain, _ = library_of(folder)
    both, report = library_of(folder, config=LibraryConfig(mirror=True))
    assert both.names == tuple(n for name in plain.names for n in (name, f"{name}-mirrored"))
    assert report.sentences()[0].startswith("4 of 7 clips")
    assert subject_of("cmu-02-02_01-mirrored") == "cmu 02"
    assert len(split(both, ["cmu 02"]).test) == 4
    body = fit_humanoid(both)[0]
    for clip, seen in zip(both.clips[::2], both.clips[1::2], strict=True):
        assert seen.skeleton.names == clip.skeleton.names and seen.frames == clip.frames
        left, right = (clip.skeleton.index(f"{s}Hand") for s in ("Left", "Right"))
        apart = seen.positions()[:, left] - clip.positions()[:, right] * [1.0, -1.0, 1.0]
        assert np.linalg.norm(apart, axis=-1).max() < 0.02
        pose = Kinematics(body.table)(clip_to_qpos(seen, body.table))
        assert abs(float(stance_heights(body.table, pose.pos, pose.quat, seen.fps).mean())) < 0.02


def test_clips_taken_backwards(folder: Path) -> None:
    library, _ = library_of(folder, config=LibraryConfig(mirror=True, backwards=("02_02", "cmu 07")))
    named = {c.name: c for c in library}
    back = [n for n in library.names if n.endswith("-backwards")]
    assert [subject_of(n) for n in back] == ["cmu 02"] * 2 + ["cmu 07"] * 4
    for name in back:
        there = named[name.removesuffix("-backwards")]
        np.testing.assert_array_equal(named[name].rot, there.rot[::-1])
        np.testing.assert_allclose(named[name].positions(), there.positions()[::-1], atol=1e-12)


def test_onto_a_body_that_is_there_already(folder: Path) -> None:
    from poise.jobs.library.clips import Target

    clip = swing(seconds=2.0, scale=1.1)
    body = fit_humanoid(clip)[0]
    target = Target(body.skeleton, clip, body.table, "the policy's body")
    library, report = library_of(folder, target, cache=folder.parent / "cache")
    assert all(np.array_equal(c.skeleton.offsets, clip.skeleton.offsets) for c in library)
    assert report.onto == "the policy's body"
    again, told = library_of(folder, target, cache=folder.parent / "cache")
    assert told.cached and again.names == library.names
    heavier = replace(target, table=body.table.overridden({"thigh.mass": 9.0}))
    assert not library_of(folder, heavier, cache=folder.parent / "cache")[1].cached
    # Going on with a library, a body only widens its ranges and lets more pairs pass.
    grown = fit_humanoid(library, table=body.table)[0].table
    assert [r.geoms for r in grown.rows] == [r.geoms for r in body.table.rows]
    for new, old in zip(grown.rows, body.table.rows, strict=True):
        assert all(a <= c and b >= d for (a, b), (c, d) in zip(new.ranges, old.ranges, strict=True))


def test_noise_of_a_file_is_taken_off_once(tmp_path: Path) -> None:
    for k in range(2):
        write(tmp_path, f"02/02_0{k}.bvh", trembling(swing(4.0, speed=0.5), seed=k))
    library, report = library_of(tmp_path, human(1.1))
    for note in report.clips:
        (told,) = (s for s in note.repairs if "trembles" in s)
        assert "mm from frame to frame: the tremble is taken off." in told
    # Who learns from it does not judge again, and so changes nothing.
    assert all(c.skeleton.source.raw for c in library)
    assert not any(c.clean.noise for c in fit_humanoid(library)[2].clips)
    assert all(white_mm(c.positions(), c.fps) < 3.0 for c in library)
