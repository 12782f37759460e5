"""Files are read, mended, converted and retargeted where torch and MuJoCo are not installed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from poise.formats import read_clip, write_clip
from toy_human import human, swing

#: An environment without the packages that simulate and learn: each import of them fails.
ABSENT = """
import sys
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("torch", "mujoco", "gymnasium", "tensorboard", "safetensors"):
            raise ModuleNotFoundError(f"No module named '{name}'", name=name)
sys.meta_path.insert(0, Absent())
"""
RUN = ABSENT + "from poise.cli.main import main\nsys.exit(main(sys.argv[1:]))"


def run(*words: str | Path, code: str = RUN) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", code, *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, check=False, env={**os.environ})


@pytest.fixture
def walk(tmp_path: Path) -> Path:
    write_clip(swing(1.0, speed=1.0), tmp_path / "walk.bvh")
    return tmp_path / "walk.bvh"


def test_rooms_that_handle_files_import_no_torch() -> None:
    rooms = ["motion", "metrics", "formats", "body", "kinematics"]
    rooms += ["score.card", "score.thresholds", "score.report"]
    code = "import sys\n" + "".join(f"import poise.{room}\n" for room in rooms)
    heavy = ("torch", "mujoco", "gymnasium", "tensorboard", "safetensors", "tyro", "rich")
    code += f"import json; print(json.dumps([m for m in {heavy} if m in sys.modules]))"
    done = run(code=code)
    assert json.loads(done.stdout) == [], done.stderr
    face = run(code="import poise, sys; print('numpy' in sys.modules)")
    assert face.stdout.strip() == "False"


def test_info_and_doctor_of_a_file(walk: Path) -> None:
    done = run("info", walk, "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["result"]["frames"] == 31
    done = run("doctor", walk, "--fix", "-o", walk.with_name("mended.bvh"))
    assert done.returncode == 0 and read_clip(walk.with_name("mended.bvh")).frames == 31, done.stderr
    done = run("doctor", walk, "--rest-pose", "-o", walk.with_name("rest.bvh"))
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("suffix", [".glb", ".npz", ".bvh"])
def test_a_file_is_converted(walk: Path, suffix: str) -> None:
    out = walk.with_name(f"out{suffix}")
    done = run("convert", walk, out)
    assert done.returncode == 0, done.stderr
    assert np.allclose(read_clip(out).positions(), read_clip(walk).positions(), atol=1e-4)


def test_a_motion_is_moved_onto_another_skeleton(walk: Path) -> None:
    onto = walk.with_name("onto.bvh")
    other = human(1.2)
    rest = np.zeros((2, len(other), 4))
    rest[..., 0] = 1.0
    write_clip(swing().replaced(skeleton=other, root_pos=np.array([[0, 0, 1.1]] * 2), rot=rest), onto)
    done = run("retarget", walk, "--onto", onto, "-o", walk.with_name("made.bvh"))
    assert done.returncode == 0, done.stderr
    made = read_clip(walk.with_name("made.bvh"))
    assert made.frames == 31 and set(made.skeleton.names) == set(other.names)


@pytest.mark.parametrize("words", ["track CLIP -o OUT", "imitate CLIP -o OUT", "body CLIP", "eval OUT"])
def test_other_verbs_say_what_to_install(walk: Path, words: str) -> None:
    named = {"CLIP": str(walk), "OUT": str(walk.with_name("out"))}
    done = run(*(named.get(w, w) for w in words.split()))
    assert done.returncode == 2, done.stderr
    said = " ".join(done.stderr.split())
    assert "is not installed" in said and "pip install" in said and "Traceback" not in said
    assert not walk.with_name("out").exists()


def test_the_machine_is_examined_all_the_same() -> None:
    done = run("doctor")
    assert done.returncode == 1 and "pip install torch" in " ".join(done.stdout.split()), done.stderr
