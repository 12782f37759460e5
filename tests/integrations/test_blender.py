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

from poise.motion import Clip
from poise.motion.io import read_clip, write_clip
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


def test_an_action_goes_out_and_comes_back_within_a_millimetre(tmp_path: Path) -> None:
    python, out = _blender(), tmp_path / "told.json"
    # A wrapper, since the other Python's environment is not this one's.
    poise = tmp_path / "poise.py"
    poise.write_text(
        f"import sys\nsys.path[:0] = {sys.path!r}\nfrom poise.cli.main import main\nmain()\n"
    )
    line = [python, str(SESSION), str(ADDON), str(out), sys.executable, str(poise)]
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    done = subprocess.run(
        line, capture_output=True, text=True, timeout=240, env=environment, check=False
    )
    assert done.returncode == 0 and out.exists(), done.stdout[-2000:] + done.stderr[-2000:]
    told = json.loads(out.read_text(encoding="utf-8"))
    before = np.array(told["before"])
    clip = read_clip(out.with_suffix(".bvh"), unit_m=1.0, up_axis="Z")
    assert np.abs(_in_order(clip, told["names"]) - before).max() < 1e-3
    assert np.abs(np.array(told["again"]) - before).max() < 1e-3
    assert told["ended"] == ["FINISHED"], told["told"]
    assert "faults before" in told["told"] and told["action"] == "there doctor"
    assert told["range"] == [5.0, 64.0] and np.abs(np.array(told["after"]) - before).max() < 1.0
    assert "was not found" in told["refused"] and told["kept"] == told["action"]
