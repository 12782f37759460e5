"""Every `poise` command line of the README and the docs is run, with short settings.

A page has a folder of its own, in which its commands run one after another. A command that ran for
another page, on the same input, is not run again: what it wrote is copied.
"""

from __future__ import annotations

import hashlib
import json
import re
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from poise.cli.main import main
from poise.formats import read_clip, write_clip
from poise.jobs.endless.endless_training import Endless
from poise.learn.cvae import CVAEConfig
from poise.motion import Clip, trim
from poise.recipes import ResidualForce
from poise.settings import to_toml
from test_docs import WALK, _commands
from toy_policy import toy_run

#: What needs a machine of its own: a GPU, a Ray cluster; and fleets, which have their own tests.
ELSEWHERE = ("--device cuda", "--address", "poise fleet")
#: Exit codes of a command that did what it says: done, or done but a motion was lost.
DONE = (0, 3)
TINY = ("--iterations", "2", "--envs", "16", "--threads", "1")
#: Frames of the motions; the docs name frame 60.
FRAMES = 64
#: Roles that the docs map, as the embedded walk calls them.
ROLES = {"left_foot": "LeftFoot"}
#: `track walk.bvh -o tracked` and what every such command gets.
_PLAIN = ["track", "walk.bvh", "-o", "tracked", "--characters", "8", "--threads", "1", "--budget", "40"]
#: Keypoints of a file, and the joints of the embedded walk that they are.
POINTS = {
    f"{side[0]}{name}": side + joint
    for side in ("Left", "Right")
    for name, joint in (
        ("Hip", "UpLeg"), ("Knee", "Leg"), ("Ankle", "Foot"), ("BigToe", "Toe"),
        ("Shoulder", "Arm"), ("Elbow", "ForeArm"), ("Wrist", "Hand"),
    )
} | {"Neck": "Neck", "Head": "Head"}  # fmt: skip


def _shortened(line: str) -> list[str]:
    """The arguments of a command line that does the same with less of everything."""
    line = line.split("|")[0].replace("/shared/", "shared/").replace(" --open", "")
    # One clip, whatever a page calls it, so that what one page did serves another.
    line = re.sub(r"\bmine\.bvh", "walk.bvh", line)
    line = re.sub(r"--minutes \d+|--seeds \S+", "", line)
    line = re.sub(r"--learn \d+", "--learn 0.02", line)
    line = re.sub(r"(=\d+),[\d,]+", r"\1", line)
    line = re.sub(r"--budget \d+", "--budget 40", line)
    argv = shlex.split(line, comments=True)[1:]
    if argv[0] == "track":
        for option, value in (("--characters", "8"), ("--threads", "1"), ("--budget", "40")):
            argv += [] if option in argv else [option, value]
        # One command looks ahead, that with no options; so do those about what lookahead alone knows.
        if len(argv) > len(_PLAIN) and not {"--range", "--learn"} & {*argv}:
            argv += [] if "--controller" in argv else ["--controller", "policy"]
    if argv[0] == "imitate" and "--print-config" not in argv:
        argv += [*TINY, "--no-expert"]
        if "--resume" in argv:
            argv[argv.index("--iterations") + 1] = "3"
    if argv[:2] == ["train", "perpetual"]:
        argv += [*TINY, "--no-expert", "--single", "--no-style", "--no-recovery"]
    if argv[:2] == ["play", "compliant"]:
        argv += ["--count", "1", "--duration", "1", "--threads", "1"]
    if argv[0] == "push" and "--controller" not in argv:
        argv += ["--controller", "policy"]
    if argv[0] == "complete":
        argv += ["--adapt", "0", "--budget", "40", "--threads", "1"]
        argv += ["--controller", "policy"]
    if argv[:2] == ["train", "inbetween"]:
        argv += ["--iterations", "1", "--threads", "1"]
    if argv[0] == "live":
        if "--seconds" in argv:
            at = argv.index("--seconds")
            del argv[at : at + 2]
        argv += ["--seconds", "3" if "--record" in argv else "0.4", "--port", "0"]
    if argv[0] == "open":
        argv += ["--seconds", "0.5", "--port", "0", "--no-browser"]
    if argv[:2] in (["train", "compliant"], ["train", "dual-policy"]):
        argv += ["--iterations", "1", "--envs", "8", "--ppo.horizon", "4", "--threads", "1"]
    if argv[:2] == ["train", "endless"]:
        argv += ["--iterations", "2", "--threads", "1", "--config", "endless.toml"]
    if argv[0] == "dream":
        argv += ["--seconds", "0.4", "--controller", "policy", "--threads", "1"]
    if "--preset" in argv:
        argv += ["--ppo.horizon", "8"]
    return argv


def _points(walk: Clip) -> np.ndarray:
    """`(T, K, 3)` m, Y up."""
    joints = walk.skeleton.names
    at = walk.world()[0][:, [joints.index(name) for name in POINTS.values()]]
    return at[..., [1, 2, 0]]


def _write_trc(path: Path, walk: Clip) -> None:
    points, rate = _points(walk), f"{walk.fps:g}"
    words = (
        "DataRate CameraRate NumFrames NumMarkers Units OrigDataRate OrigDataStartFrame OrigNumFrames"
    )
    head = words.replace(" ", "\t")
    stated = (rate, rate, str(walk.frames), str(len(POINTS)), "m", rate, "1", str(walk.frames))
    lines = [f"PathFileType\t4\t(X/Y/Z)\t{path.name}", head, "\t".join(stated)]
    lines += ["Frame#\tTime\t" + "\t\t\t".join(POINTS) + "\t\t", "\t\t" + "X1\tY1\tZ1\t" * len(POINTS)]
    lines += [
        "\t".join([str(t + 1), f"{t / walk.fps:.6f}", *(f"{v:.6f}" for v in row.ravel())])
        for t, row in enumerate(points)
    ]
    path.write_text("\n".join(lines) + "\n")


def _write_c3d(path: Path, walk: Clip) -> None:
    file = pytest.importorskip("ezc3d").c3d()
    points, point = _points(walk), file["parameters"]["POINT"]
    point["RATE"]["value"], point["UNITS"]["value"] = [walk.fps], ["m"]
    point["LABELS"]["value"] = tuple(POINTS)
    data = np.ones((4, len(POINTS), walk.frames))
    data[:3] = points.transpose(2, 1, 0)
    file["data"]["points"] = data
    file.write(str(path))


def _provide(path: Path, bones: dict[str, str]) -> None:
    """Makes an input that a command line names: of the kind that its name says. bones: other names for
    joints of the walk."""
    walk = trim(read_clip(WALK), 0, FRAMES)
    names = tuple(bones.get(name, name) for name in walk.skeleton.names)
    walk = walk.replaced(skeleton=replace(walk.skeleton, names=names))
    if path.name == "clips":
        path.mkdir()
        for name in ("one", "two"):
            write_clip(walk, path / f"{name}.bvh")
    elif path.name == "run":
        toy_run(path)
    elif path.name == "endless.toml":
        path.write_text(to_toml(Endless(CVAEConfig(past=10, future=12, hidden=16))))
    elif path.suffix == ".toml":
        path.write_text(to_toml(ResidualForce(seed=1)))
    elif path.name == "chair.json":
        path.write_text('{"size": [0.4, 0.4, 0.4], "pos": [0.0, 3.0, 0.2]}')
    elif path.suffix == ".trc":
        _write_trc(path, walk)
    elif path.suffix == ".c3d":
        _write_c3d(path, walk)
    elif path.suffix in (".bvh", ".glb"):
        write_clip(walk, path)


@pytest.fixture(scope="module")
def ran() -> dict[tuple[str, ...], tuple[Path, dict[str, str]]]:
    """Of every command that was run: the folder, and the sizes of the inputs that it found there."""
    return {}


@pytest.mark.timeout(300)
@pytest.mark.parametrize("page", sorted({page for page, _ in _commands()}))
def test_commands_run(
    page: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    ran: dict[tuple[str, ...], tuple[Path, dict[str, str]]],
) -> None:
    monkeypatch.chdir(tmp_path)
    for line in (line for of, line in _commands() if of == page):
        if any(words in line for words in ELSEWHERE):
            continue
        argv = _shortened(line)
        made = {argv[i + 1] for i, word in enumerate(argv) if word == "-o"}
        made |= {argv[2]} if argv[0] == "convert" else set()
        # The maps of the page are of this rig.
        maps = [argv[i + 1].split("=") for i, word in enumerate(argv) if word == "--map"]
        bones = {ROLES.get(of, of): bone for of, bone in maps}
        for word in argv[1:]:
            path = Path(word)
            stale = bool(bones) and path.stem == "rig"
            if _is_input(word) and word not in made and (stale or not path.exists()):
                _provide(path, bones if stale else {})
        inputs = {word: _state(Path(word)) for word in argv[1:] if word not in made}
        folder, before = ran.get(tuple(argv), (tmp_path, {}))
        if before == inputs and made and not any(Path(out).exists() for out in made):
            for out in made:
                for path in (folder / out, (folder / out).with_suffix("")):
                    if path.is_dir():
                        shutil.copytree(path, tmp_path / path.name, dirs_exist_ok=True)
                    elif path.exists():
                        shutil.copy(path, tmp_path / path.name)
            continue
        capsys.readouterr()
        code = main(argv)
        said = capsys.readouterr()
        assert code in DONE, f"{line}\n{said.err}"
        assert all(Path(out).exists() for out in made), line
        if "--json" in argv:
            assert json.loads(said.out)["result"]["outcome"] in ("tracked", "lost"), line
        ran[tuple(argv)] = (tmp_path, inputs)


def _state(path: Path) -> str:
    """What an input is: the digest of a file, the names below a folder, "" for what is neither."""
    if path.is_file():
        return hashlib.sha256(path.read_bytes()).hexdigest()
    return " ".join(sorted(p.name for p in path.rglob("*"))) if path.is_dir() else ""


def _is_input(word: str) -> bool:
    known = (".bvh", ".glb", ".trc", ".c3d", ".toml")
    return Path(word).suffix in known or word.rstrip("/") in ("clips", "run", "chair.json")
