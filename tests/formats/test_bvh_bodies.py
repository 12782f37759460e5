"""BVH files of two people, and BVH files without a frame, which are rigs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from handmade_rigs import bvh_of, walker

from poise.errors import PoiseError
from poise.formats import read_clip
from poise.formats.table import read_skeleton
from refusals import refused


@pytest.mark.parametrize("second", ["B_", ""])
def test_a_second_root_is_another_person(tmp_path: Path, second: str) -> None:
    """It may have the same names; the first of two equals is read, or the larger one."""
    a, b = walker(), walker(speed=2.0, prefix=second).with_joint("tail", f"{second}pelvis", (0, 0, -0.2))
    path = tmp_path / "a.bvh"
    for rigs in ((a, walker(prefix=second)), (a, b), (b, a)):
        path.write_text(bvh_of(*rigs))
        rig, other = sorted(rigs, key=lambda r: -len(r.names)) if b in rigs else rigs
        clip = read_clip(path)
        assert clip.skeleton.names == rig.names
        assert np.abs(clip.positions() - rig.world()).max() < 1e-4
        assert (
            f"The file holds 2 bodies: '{rig.names[0]}' ({len(rig.names)} joints) was read, and the "
            f"other one was left out: '{other.names[0]}' ({len(other.names)} joints); to read another, "
            "export it alone"
        ) in clip.skeleton.source.notes


def test_a_file_without_a_frame_is_a_rig(tmp_path: Path) -> None:
    rig = walker()
    head, motion = bvh_of(rig).split("MOTION")
    path = tmp_path / "a.bvh"
    frames = {
        "none": head + "MOTION\nFrames: 0\nFrame Time: 0.033333\n",
        "no motion": head,
        "one": head + "MOTION" + "\n".join(motion.splitlines()[:4]).replace("Frames: 31", "Frames: 1"),
    }
    for kind, text in frames.items():
        path.write_text(text)
        with pytest.raises(PoiseError):
            read_clip(path)
        clip = read_skeleton(path)
        assert clip.frames == 2 and clip.skeleton.names == rig.names
        if kind != "one":
            # All bones as they are written, none of them turned.
            straight = np.array([p[0] for p in rig.place])
            offsets = np.stack((straight[:, 0], -straight[:, 2], straight[:, 1]), -1)
            np.testing.assert_allclose(clip.skeleton.offsets[1:], offsets[1:], atol=1e-6)
            np.testing.assert_allclose(clip.rot[..., 0], 1.0)
        else:
            assert np.abs(clip.positions() - rig.world()[0]).max() < 1e-4
    path.write_text(frames["none"])
    with refused("no-frames"):
        read_clip(path)
