"""The nodes for ComfyUI, called as it calls them; ComfyUI itself is not needed."""

from __future__ import annotations

import importlib.util
import json
import sys
import time
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from poise.formats import read_clip

FOLDER = Path(__file__).resolve().parents[2] / "integrations" / "comfyui" / "poise_nodes"
WALK = Path(str(files("poise") / "data/walk.bvh"))

#: Stands in for the command: keeps its words, writes what -o names, answers what it is told to.
FAKE = """
import json, pathlib, sys
words = sys.argv[1:]
here = pathlib.Path(__file__).parent
(here / "words.json").write_text(json.dumps(words))
plan = json.loads((here / "plan.json").read_text())
if "-o" in words:
    pathlib.Path(words[words.index("-o") + 1]).write_text("motion")
print(plan["stdout"] if "stdout" in plan else json.dumps(plan["answer"]))
print("the last line", file=sys.stderr)
sys.exit(plan["code"])
"""


@pytest.fixture()
def nodes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """The package as ComfyUI loads it, with its folders below `tmp_path`."""
    spec = importlib.util.spec_from_file_location(
        "poise_nodes", FOLDER / "__init__.py", submodule_search_locations=[str(FOLDER)]
    )
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "poise_nodes", module)
    out, given = tmp_path / "output", tmp_path / "input"
    given.mkdir()
    folders = SimpleNamespace(get_output_directory=lambda: out, get_input_directory=lambda: given)
    monkeypatch.setitem(sys.modules, "folder_paths", folders)
    spec.loader.exec_module(module)
    yield module
    for name in [n for n in sys.modules if n.startswith("poise_nodes")]:
        sys.modules.pop(name)


def plan(folder: Path, monkeypatch: pytest.MonkeyPatch, code: int = 0, **what: Any) -> None:
    """Sets what the command will answer."""
    script = folder / "a command.py"
    script.write_text(FAKE, encoding="utf-8")
    (folder / "plan.json").write_text(json.dumps({"code": code, **what}))
    monkeypatch.setenv("POISE_COMMAND", f'"{sys.executable}" "{script}"')


def words(folder: Path) -> list[str]:
    return json.loads((folder / "words.json").read_text())


def test_nodes_are_declared_as_comfyui_wants_them(nodes: ModuleType) -> None:
    assert set(nodes.NODE_CLASS_MAPPINGS) == set(nodes.NODE_DISPLAY_NAME_MAPPINGS)
    for node in nodes.NODE_CLASS_MAPPINGS.values():
        inputs = node.INPUT_TYPES()
        assert set(inputs) <= {"required", "optional"} and node.CATEGORY == "Poise" and node.__doc__
        assert len(node.RETURN_TYPES) == len(node.RETURN_NAMES)
        asked = node.run.__code__.co_varnames[1 : node.run.__code__.co_argcount]
        assert [*inputs["required"], *inputs.get("optional", {})] == list(asked)


def test_tracking_gives_paths_and_says_a_loss(
    nodes: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    answer = {"outputs": {"report": "r.html"}, "result": {"sentence": "Lost at 1.0 s."}}
    plan(tmp_path, monkeypatch, code=3, answer=answer)
    (tmp_path / "input/a dance.bvh").write_text("x")
    node = nodes.NODE_CLASS_MAPPINGS["PoiseTrack"]()
    motion, report, told = node.run("a dance.bvh", fps=59.94, controller="policy", seed=7, format=".glb")
    assert (report, told) == ("r.html", "Lost at 1.0 s.")
    assert Path(motion) == tmp_path / "output/poise/a dance_track_00001.glb" and Path(motion).exists()
    assert words(tmp_path) == [
        "track", str(tmp_path / "input/a dance.bvh"), "-o", motion, "--controller", "policy",
        "--seed", "7", "--fps", "59.94", "--json",
    ]  # fmt: skip
    # Another run writes beside it.
    assert node.run("a dance.bvh")[0].endswith("_00001.bvh")
    assert node.run("a dance.bvh")[0].endswith("_00002.bvh")
    complete = nodes.NODE_CLASS_MAPPINGS["PoiseComplete"]()
    complete.run("a dance.bvh", " 0, 30 60")
    assert words(tmp_path)[2:4] == ["--keyframes", "0,30,60"] and "--fps" not in words(tmp_path)


def test_a_motion_is_opened_on_the_page(
    nodes: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan(tmp_path, monkeypatch, answer={})
    (tmp_path / "input/run.bvh").write_text("x")
    path = tmp_path / "input/run.bvh"
    assert nodes.NODE_CLASS_MAPPINGS["PoiseOpen"]().run("run.bvh", fps=24.0) == (str(path),)
    end = time.monotonic() + 30
    while not (tmp_path / "words.json").exists() and time.monotonic() < end:
        time.sleep(0.05)
    project = str(tmp_path / "output/poise/run_open_00001.project")
    assert words(tmp_path) == [
        *("open", str(path), "--project", project, "--port", "0", "--once", "--fps", "24"),
    ]


def test_what_is_refused_is_an_error_in_a_sentence(
    nodes: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    node = nodes.NODE_CLASS_MAPPINGS["PoiseConvert"]()
    error = {"what": "no such file", "where": "x.bvh", "hint": "Check the path"}
    plan(tmp_path, monkeypatch, code=2, answer={"error": error})
    with pytest.raises(RuntimeError, match=r"x.bvh: no such file\. Check the path"):
        node.run("x.bvh", ".glb")
    plan(tmp_path, monkeypatch, code=1, stdout="no JSON")
    with pytest.raises(RuntimeError, match="the last line"):
        node.run("x.bvh", ".glb")
    monkeypatch.delenv("POISE_COMMAND")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(RuntimeError, match="set POISE_COMMAND"):
        node.run("x.bvh", ".glb")


def test_a_file_that_changed_is_read_anew(nodes: ModuleType, tmp_path: Path) -> None:
    node = nodes.NODE_CLASS_MAPPINGS["PoiseInfo"]
    (tmp_path / "a.bvh").write_text("one")
    before = node.IS_CHANGED(motion=str(tmp_path / "a.bvh"), fps=0.0)
    (tmp_path / "a.bvh").write_text("three")
    assert node.IS_CHANGED(motion=str(tmp_path / "a.bvh"), fps=0.0) != before
    assert node.IS_CHANGED(motion="none.bvh") == ""


def test_smpl_parameters_become_a_file_that_poise_reads(nodes: ModuleType) -> None:
    node = nodes.NODE_CLASS_MAPPINGS["PoiseFromSMPL"]()
    rng = np.random.default_rng(0)
    import torch

    parts: dict[str, Any] = {
        "global_orient": torch.tensor(rng.normal(size=(12, 3)) * 0.05 + [np.pi / 2, 0, 0]),
        "body_pose": rng.normal(size=(12, 21, 3)) * 0.05,
        "transl": np.zeros((12, 3)),
        "betas": torch.zeros(12, 10),
    }
    for given in ({"global": parts, "incam": {}}, parts):
        (path,) = node.run(given, 25.0)
        clip = read_clip(path)
        assert (clip.frames, clip.fps, len(clip.skeleton)) == (12, 25.0, 22)
    with pytest.raises(RuntimeError, match="lack body_pose, transl"):
        node.run({"global_orient": parts["global_orient"]}, 25.0)


def test_the_doctor_for_real(nodes: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    poise = tmp_path / "poise.py"
    poise.write_text(
        f"import sys\nsys.path[:0] = {sys.path!r}\nfrom poise.cli.main import main\nsys.exit(main())\n"
    )
    monkeypatch.setenv("POISE_COMMAND", f'"{sys.executable}" "{poise}"')
    motion, told = nodes.NODE_CLASS_MAPPINGS["PoiseDoctor"]().run(str(WALK), rest_pose=True)
    assert told == "0 faults before, 0 after"
    assert read_clip(motion).frames == read_clip(WALK).frames
