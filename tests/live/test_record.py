"""A recording is what was simulated, and survives the end of the process."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from poise.formats import read_clip
from poise.jobs.open import open_run
from poise.kinematics import clip_to_qpos
from poise.live.sinks import CharacterRecorder
from refusals import refused


def recorder(path: Path, count: int = 1) -> CharacterRecorder:
    t = open_run(None).tracker
    return CharacterRecorder(path, t.humanoid.table, t.example, count, 30.0)


@pytest.mark.parametrize("suffix", [".bvh", ".glb", ".csv"])
def test_a_recording_reads_back(tmp_path: Path, suffix: str) -> None:
    made = recorder(tmp_path / f"take{suffix}", 2)
    rng = np.random.default_rng(0)
    nq = open_run(None).tracker.humanoid.model.nq
    q = rng.normal(0, 0.1, (40, 2, nq))
    q[..., 3:7] = [1, 0, 0, 0]
    made.start()
    for row in q:
        made.write(row)
    paths = made.stop()
    assert [p.name for p in paths] == [f"take-1{suffix}", f"take-2{suffix}"]
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(p.name for p in paths)
    clip = read_clip(paths[1])
    assert clip.frames == 40 and clip.fps == pytest.approx(30)
    if suffix == ".csv":
        back = clip_to_qpos(clip, made.table)
        np.testing.assert_allclose(back[:, 7:], q[:, 1, 7:], atol=1e-6)
    # The next take gets another name, and one of no length leaves nothing.
    made.start()
    assert made.stop() == []
    made.start()
    for row in q[:5]:
        made.write(row)
    assert [p.name for p in made.stop()] == [f"take-1-take2{suffix}", f"take-2-take2{suffix}"]


def test_a_format_that_cannot_be_written_is_refused_at_once(tmp_path: Path) -> None:
    with refused("format-not-written"):
        recorder(tmp_path / "take.xyz")


_CRASH = """
import sys, time
import numpy as np
sys.path[:0] = {path!r}
from pathlib import Path
from test_record import recorder
made = recorder(Path({file!r}))
made.start()
q = np.zeros((1, made.example.skeleton and {nq}))
q[:, 3] = 1
began = time.monotonic()
for k in range(10_000):
    q[:, 0] = time.monotonic() - began
    made.write(q.copy())
    if k == 60:
        print("go", flush=True)
    time.sleep(1 / 30)
"""


def test_kill_9_loses_a_second_at_most(tmp_path: Path) -> None:
    file, nq = tmp_path / "take.bvh", open_run(None).tracker.humanoid.model.nq
    path = [str(Path(__file__).parent), str(Path(__file__).parents[1])]
    code = _CRASH.format(path=path, file=str(file), nq=nq)
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, env=dict(os.environ)
    ) as run:
        assert run.stdout is not None
        run.stdout.readline()
        time.sleep(0.5)
        run.send_signal(signal.SIGKILL)
        run.wait()
    clip = read_clip(tmp_path / "take.csv")
    # 61 frames were written before "go", and 0.5 s more.
    assert clip.frames >= 61 + 15 - 30
    assert not file.exists()
