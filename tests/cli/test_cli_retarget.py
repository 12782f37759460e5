"""`poise retarget`: files in, a file on the other skeleton out, mistakes in one sentence."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from tiny_clips import bvh, put

from poise.body import BodyConfig
from poise.cli.main import main
from poise.cli.retarget import pairs
from poise.formats import read_clip, write_bvh, write_clip
from poise.jobs.library.clips import target_of
from poise.motion import Clip, Skeleton
from refusals import refused
from toy_human import human, swing


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    """A walk, and the file of a bigger body with other names of joints."""
    clip = swing(seconds=1.0, speed=1.0)
    here, there = tmp_path / "walk.bvh", tmp_path / "big.bvh"
    write_clip(clip, here)
    names = {"LeftArm": "LeftUpperArm", "RightArm": "RightUpperArm", "Hips": "pelvis", "Neck": "neck_01"}
    big = human(1.1)
    skeleton = Skeleton(tuple(names.get(n, n) for n in big.names), big.parents, big.offsets, big.ends)
    still = np.zeros((3, len(big), 4))
    still[..., 0] = 1.0
    write_clip(Clip(skeleton, np.tile((0.0, 0.0, 1.0), (3, 1)), still, 30.0), there)
    return here, there


def test_a_clip_goes_onto_the_skeleton_of_another_file(files, tmp_path: Path, capsys) -> None:
    out = tmp_path / "out.bvh"
    assert main(["retarget", str(files[0]), "--onto", str(files[1]), "-o", str(out)]) == 0
    said = capsys.readouterr().out
    assert "LeftUpperArm" in said and "the name 'LeftUpLeg' says so" in said
    assert "Steps are scaled by" in said and "31 frames at 30 fps, 19 joints" in said
    made, source, target = (read_clip(p) for p in (out, *files))
    assert made.skeleton.names == target.skeleton.names
    np.testing.assert_allclose(made.skeleton.offsets, target.skeleton.offsets, atol=1e-6)
    assert made.frames == source.frames
    # What was written is what was made: thighs point where they pointed.
    for side in ("Left", "Right"):
        lines = [
            c.positions()[:, c.skeleton.index(f"{side}Leg")]
            - c.positions()[:, c.skeleton.index(f"{side}UpLeg")]
            for c in (made, source)
        ]
        units = [v / np.linalg.norm(v, axis=-1, keepdims=True) for v in lines]
        assert np.degrees(np.arccos(np.clip((units[0] * units[1]).sum(-1), -1, 1))).max() < 3.0


def test_a_clip_goes_onto_an_asf_skeleton(files, tmp_path: Path, data_dir: Path, capsys) -> None:
    rig, made = data_dir / "cmu_amc/02/02.asf", []
    for k, onto in enumerate((rig, rig.with_name("02_01.amc"))):
        out = tmp_path / f"{k}.bvh"
        assert main(["retarget", str(files[0]), "--onto", str(onto), "-o", str(out)]) == 0
        made.append(read_clip(out))
    assert "lfemur" in made[0].skeleton.names and made[0].skeleton.names == made[1].skeleton.names
    np.testing.assert_allclose(made[0].positions(), made[1].positions(), atol=1e-4)
    target = target_of(rig, [], BodyConfig())
    assert target.skeleton.names == made[0].skeleton.names and target.example is not None
    broken = put(tmp_path, "broken.asf", ":version 1.10\n")
    capsys.readouterr()
    argv = ["retarget", str(files[0]), "--onto", str(broken), "-o", str(tmp_path / "x.bvh")]
    assert main(argv) == 2 and str(broken) in capsys.readouterr().err


def test_the_report_can_be_json_alone(files, tmp_path: Path, capsys) -> None:
    out = tmp_path / "out.bvh"
    argv = ["retarget", str(files[0]), "--onto", str(files[1]), "-o", str(out), "--json"]
    assert main(argv) == 0
    facts = json.loads(capsys.readouterr().out)["result"]
    assert facts["scale"] == pytest.approx(1.1, abs=0.03)
    assert {"direction_deg", "slide_mm_s", "depth_max_mm", "end_percent", "mapping"} <= set(facts)


def test_hands_stay_where_they_are_if_asked(files, tmp_path: Path, capsys, refused) -> None:
    # Legs of the source's size and arms a fifth longer: hands end elsewhere, or elbows bend.
    rig = human()
    arms = [k for k, n in enumerate(rig.names) if n.endswith(("ForeArm", "Hand"))]
    offsets = np.array(rig.offsets)
    offsets[arms] *= 1.2
    still = np.zeros((3, len(rig), 4))
    still[..., 0] = 1.0
    onto = tmp_path / "long.bvh"
    skeleton = Skeleton(rig.names, rig.parents, offsets, rig.ends)
    write_clip(Clip(skeleton, np.tile((0.0, 0.0, 1.0), (3, 1)), still, 30.0), onto)
    far, facts = {}, {}
    source = read_clip(files[0])
    for how in ("direction", "place"):
        out = tmp_path / f"{how}.bvh"
        argv = ["retarget", *map(str, (files[0], "--onto", onto, "-o", out)), "--hands", how, "--json"]
        assert main(argv) == 0
        facts[how] = json.loads(capsys.readouterr().out)["result"]
        joint = source.skeleton.index("LeftHand")
        gap = read_clip(out).positions()[:, joint] - source.positions()[:, joint]
        far[how] = float(np.linalg.norm(gap, axis=-1).mean())
    assert far["direction"] > 0.09 and far["place"] < 0.015
    assert facts["direction"]["hands_percent"] is None and facts["place"]["hands_percent"][0] < 1.0
    refused(*argv[:4], "-o", tmp_path / "x.bvh", "--hands", "floor", words=("--hands",))


def test_pairs_by_hand(files, tmp_path: Path, capsys, refused) -> None:
    here, there = files
    out = tmp_path / "out.bvh"
    line = ["retarget", here, "--onto", there, "-o", out]
    assert main([*map(str, line), "--map", "LeftArm=LeftUpperArm", "--map", "Head=Head"]) == 0
    capsys.readouterr()
    out.unlink()
    refused(*line, "--map", "LeftArm=LeftUperArm", words=("Did you mean 'LeftUpperArm'",))
    refused(*line, "--map", "LeftArm", words=("--map needs JOINT=JOINT, got 'LeftArm'",))
    turned = ("--map", "LeftUpLeg=LeftLeg", "--map", "LeftLeg=LeftUpLeg")
    refused(*line, *turned, words=("turns the hierarchy round",))
    assert pairs(("a=b", "c = d")) == {"a": "b", "c": "d"}


def test_a_joint_is_moved_by_one_alone() -> None:
    with refused("joint-mapped-twice", says=("a", "b", "c")):
        pairs(("a=b", "a=c"))


def test_mistakes_are_told_in_one_sentence(files, tmp_path: Path, refused) -> None:
    here, there = files
    out = tmp_path / "out.bvh"
    line = ("retarget", here, "--onto", there, "-o")
    refused("retarget", here, "--onto", tmp_path / "none.bvh", "-o", out)
    refused(*line, tmp_path / "out.xyz", words=("cannot be written as",))
    refused(*line, there, words=("written over",))
    refused("retarget", here, "-o", out, words=("--onto",))
    legless = put(tmp_path, "legless.bvh", bvh())
    words = ("no joint was found for left_thigh", "left_foot=LeftFoot", "--map")
    refused("retarget", here, "--onto", legless, "-o", out, words=words)


def test_bandais_root_survives_the_file(data_dir, tmp_path: Path, capsys) -> None:
    source = data_dir / "cmu_amc/02/02_03.amc"
    target = data_dir / "other/bandai_bvh/dataset-2_walk_active_005.bvh"
    out = tmp_path / "out.bvh"
    assert main(["retarget", str(source), "--onto", str(target), "-o", str(out)]) == 0
    made = read_clip(out)
    from poise.kinematics import retarget

    wanted, _ = retarget(read_clip(source), read_clip(target))
    assert np.abs(made.positions() - wanted.positions()).max() < 1e-3


def test_the_units_of_both_files_are_told(files, tmp_path: Path, capsys) -> None:
    """A wrong unit of either file would change the steps, so both are said."""
    source, target = (read_clip(f) for f in files)
    write_bvh(source, files[0], unit_m=0.1)
    write_bvh(target, files[1], unit_m=0.0254)
    out = tmp_path / "out.bvh"
    assert main(["retarget", str(files[0]), "--onto", str(files[1]), "-o", str(out)]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "The file states no unit: decimetres taken" in said
    assert "big.bvh: The file states no unit: inches taken" in said
