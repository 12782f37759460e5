"""The structure of the source: no import cycle, also not inside functions; what nothing in it uses has a
reason to be there; worlds and clips are no persons; what users import is checked strictly."""

from __future__ import annotations

import ast
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
import structure

from poise import __file__ as package

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "src"
#: Modules that are public wherever they are imported.
ALWAYS = ("__init__.py", "errors.py", "settings.py", "version.py")

#: Public names that nothing in `src` reaches, and why they stand there.
EXPLAINED = {
    "twins in tests and benchmarks": (
        "control/pd.py:stable_pd_torque", "sim/backend.py:body_angular_velocity_w",
        "sim/backend.py:body_linear_velocity_w", "sim/backend.py:body_com_velocity_w",
        "metrics/tracking_errors.py:mpjpe_pa",
    ),
    "figures of the benchmarks": (
        "jobs/track/noise.py:robustness",
        "jobs/tracker.py:Tracker.with_damping",
        "papers/compliant/figures.py:throws",
    ),
    "analytic inverse kinematics, which keyframes will need": (
        "kinematics/ik.py:clip_ik",
        "kinematics/ik.py:polish",
    ),
    "for users of the library": (
        "jobs/imitate.py:imitate", "score/card.py:read_score", "env/faces.py:GymVectorEnv",
        "env/faces.py:GymEnv", "env/faces.py:RslRlVecEnv",
        "formats/smpl.py:smpl_skeleton", "sim/worlds.py:add_contact_sensors",
        "sim/guard.py:replay_dump", "sim/floor.py:HeightField", "sim/floor.py:Steps",
        "sim/props.py:Lift",
        "papers/compliant/opponents.py:Teams", "papers/compliant/scene_training.py:save_learned",
    ),
    "called by the libraries that they belong to": (
        "env/faces.py:GymVectorEnv.close_extras", "formats/pickles.py:_Machine.find_class",
    ),
}  # fmt: skip


@pytest.fixture(scope="module")
def found() -> dict:
    return structure.structure(structure.Path(package).parent)


def test_no_module_imports_itself_over_others(found: dict) -> None:
    assert found["cycles_at_the_top"] == [] and found["cycles"] == []


def test_what_nothing_uses_is_explained(found: dict) -> None:
    unused = {name for names in found["unused"].values() for name in names}
    explained = [name for names in EXPLAINED.values() for name in names]
    assert sorted(unused - set(explained)) == []
    # What is used again needs no reason any more.
    assert sorted(set(explained) - unused) == []


def test_worlds_and_clips_are_no_persons(found: dict) -> None:
    assert found["who_whose"] == 0, found["persons"]


def test_public_modules_are_checked_strictly() -> None:
    """What users import, by the documents and by `import poise`, is in the list of strict modules."""
    imports = re.compile(r"^ *(from poise[.\w]* import (?:\([^)]*\)|.*))$", re.MULTILINE)
    pages = [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]
    lines = [line for page in pages for line in imports.findall(page.read_text("utf-8"))]
    face = (SOURCE / "poise" / "__init__.py").read_text("utf-8")
    names = [name for text in (face, *lines) for name in _imported(text)]
    public = {_defining(module, name) for module, name, _ in names}
    public |= {SOURCE / "poise" / name for name in ALWAYS}
    checked = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["pyright"]["strict"]
    assert all((ROOT / file).is_file() for file in checked)
    assert sorted({file.relative_to(ROOT).as_posix() for file in public} - {*checked}) == []


def _imported(text: str) -> Iterator[tuple[str, str, str]]:
    """(module, its name there, its name here) of each name that a text imports from Poise."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "poise":
            yield from ((node.module or "", a.name, a.asname or a.name) for a in node.names)


def _defining(module: str, name: str) -> Path:
    """The file that defines a name which a module may only hand on; that of a module is itself."""
    place = SOURCE.joinpath(*module.split("."))
    file = place / "__init__.py" if place.is_dir() else place.with_suffix(".py")
    for source, there, here in _imported(file.read_text("utf-8")):
        if here == name:
            return _defining(source, there)
    inner = [place / name / "__init__.py", place / f"{name}.py"]
    return next((f for f in inner if f.is_file()), file)
