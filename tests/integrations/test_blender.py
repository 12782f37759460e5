"""The Blender add-on: motion goes out and comes back within a millimetre.

What needs Blender runs in a Python that has `bpy`: this one, or the one that POISE_BPY_PYTHON names.
"""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from poise.formats import read_clip, write_clip
from poise.motion import Clip
from toy_human import swing

ROOT = Path(__file__).resolve().parents[2]
ADDON = ROOT / "integrations" / "blender"
SESSION = Path(__file__).with_name("blender_session.py")


def _exchange():
    """The module that needs no Blender."""
    spec = importlib.util.spec_from_file_location("exchange", ADDON / "poise_blender" / "bvh.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["exchange"] = module
    spec.loader.exec_module(module)
    return module


def _places(motion) -> np.ndarray:
    turns, heads = motion.turns.copy(), motion.places.copy()
    for j, p in enumerate(motion.parents):
        if p >= 0:
            turns[:, j] = turns[:, p] @ motion.turns[:, j]
            heads[:, j] = heads[:, p] + np.einsum("tab,tb->ta", turns[:, p], motion.places[:, j])
    return heads


def _in_order(clip: Clip, names: list[str]) -> np.ndarray:
    return clip.positions()[:, [clip.skeleton.names.index(n) for n in names]]


def test_exchange_reads_what_poise_writes_and_poise_reads_what_it_writes(
    tmp_path: Path,
) -> None:
    exchange, walk_clip = _exchange(), swing()
    write_clip(walk_clip, tmp_path / "poise.bvh")
    motion = exchange.read(tmp_path / "poise.bvh")
    exchange.write(motion, tmp_path / "blender.bvh")
    again = exchange.read(tmp_path / "blender.bvh")
    np.testing.assert_allclose(_places(again), _places(motion), atol=1e-4)
    read = read_clip(tmp_path / "blender.bvh", unit_m=0.01, up_axis="Y")
    there = _in_order(read, list(walk_clip.skeleton.names))
    np.testing.assert_allclose(there, walk_clip.positions(), atol=1e-3)


def test_no_file_that_is_not_a_motion_is_read(tmp_path: Path) -> None:
    (tmp_path / "x.bvh").write_text("HIERARCHY\n")
    with pytest.raises(ValueError, match="holds no motion"):
        _exchange().read(tmp_path / "x.bvh")


def test_nothing_of_poise_is_imported_inside_blender() -> None:
    for file in (ADDON / "poise_blender").glob("*.py"):
        text = file.read_text(encoding="utf-8")
        assert "import poise" not in text and "from poise" not in text, file.name


def _blender() -> str:
    named = os.environ.get("POISE_BPY_PYTHON")
    if named is None and importlib.util.find_spec("bpy") is None:
        pytest.skip("needs bpy, or POISE_BPY_PYTHON")
    return named or sys.executable


def _session(tmp_path: Path, verbs: str, seconds: float) -> dict:
    """What Blender shows before and after; the command's results are kept as VERB.bvh."""
    python, out = _blender(), tmp_path / "told.json"
    # A wrapper, since the other Python's environment is not this one's.
    poise = tmp_path / "poise.py"
    poise.write_text(
        f"import shutil, sys\nsys.path[:0] = {sys.path!r}\nfrom poise.cli.main import main\n"
        "code = main()\nout = sys.argv[sys.argv.index('-o') + 1]\n"
        f"shutil.copy(out, {str(tmp_path)!r} + '/' + sys.argv[1] + '.bvh')\nsys.exit(code)\n"
    )
    line = [python, str(SESSION), str(ADDON), str(out), verbs, sys.executable, str(poise)]
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    done = subprocess.run(
        line, capture_output=True, text=True, timeout=seconds, env=environment, check=False
    )
    assert done.returncode == 0 and out.exists(), done.stdout[-2000:] + done.stderr[-2000:]
    return json.loads(out.read_text(encoding="utf-8"))


def test_an_action_goes_out_and_comes_back_within_a_millimetre(tmp_path: Path) -> None:
    told = _session(tmp_path, "doctor", 240)
    before, doctor = np.array(told["before"]), told["doctor"]
    clip = read_clip(tmp_path / "told.bvh", unit_m=1.0, up_axis="Z")
    assert np.abs(_in_order(clip, told["names"]) - before).max() < 1e-3
    assert np.abs(np.array(told["again"]) - before).max() < 1e-3
    assert doctor["ended"] == ["FINISHED"], doctor["told"]
    assert "faults before" in doctor["told"] and doctor["action"] == "there doctor"
    assert doctor["range"] == [5.0, 64.0]
    assert np.abs(np.array(doctor["after"]) - before).max() < 1.0
    assert "was not found" in told["refused"] and told["kept"] == doctor["action"]


@pytest.mark.timeout(1500)
def test_what_a_body_did_comes_back_as_a_new_action(tmp_path: Path) -> None:
    """Track and complete: Blender shows what Poise wrote, within a millimetre, about where it was."""
    told = _session(tmp_path, "track,complete", 1200)
    before = np.array(told["before"])
    for verb in ("track", "complete"):
        did = told[verb]
        assert did["ended"] == ["FINISHED"] and did["action"] == f"{told['start']} {verb}", did["told"]
        written = _in_order(read_clip(tmp_path / f"{verb}.bvh", unit_m=1.0, up_axis="Z"), told["names"])
        shown = np.array(did["after"])[: len(written)]
        assert did["range"][0] == 5.0 and np.abs(shown - written).max() < 1e-3
        # The body begins as the action does, at its height.
        assert np.abs(shown[0] - before[0]).mean() < 0.1
