"""The tutorial notebooks run: their code from top to bottom, and one of them in a kernel of its own."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import pytest
import torch

from sparing import spare

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))
#: What a notebook needs beside Poise.
NEEDS = {"04_rsl_rl.ipynb": ("rsl_rl", "tensordict")}


def _cells(notebook: Path) -> list[str]:
    cells = json.loads(notebook.read_text("utf-8"))["cells"]
    return ["".join(c["source"]) for c in cells if c["cell_type"] == "code"]


def test_there_are_notebooks() -> None:
    assert len(NOTEBOOKS) >= 5


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.name)
def test_notebooks_hold_no_outputs(notebook: Path) -> None:
    """Outputs would tell figures twice, and of another version."""
    cells = json.loads(notebook.read_text("utf-8"))["cells"]
    code = [c for c in cells if c["cell_type"] == "code"]
    assert code and all(c["outputs"] == [] and c["execution_count"] is None for c in code)


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.name)
def test_notebooks_run(notebook: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in NEEDS.get(notebook.name, ()):
        pytest.importorskip(module)
    monkeypatch.chdir(tmp_path)
    spare(monkeypatch)
    names = {"__name__": "notebook"}
    with torch.random.fork_rng():
        for number, code in enumerate(_cells(notebook)):
            exec(compile(code, f"{notebook.name}[{number}]", "exec", dont_inherit=True), names)


def test_a_notebook_runs_in_a_kernel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if any(importlib.util.find_spec(name) is None for name in ("nbclient", "nbformat", "ipykernel")):
        pytest.skip("nbclient is not installed: pip install 'poise-motion[docs]'")
    import nbformat
    from nbclient import NotebookClient

    monkeypatch.setenv("PYTHONPATH", str(ROOT / "src"))
    notebook = nbformat.read(ROOT / "docs" / "notebooks" / "02_your_own_reward.ipynb", as_version=4)
    nbformat.validate(notebook)
    resources = {"metadata": {"path": str(tmp_path)}}
    NotebookClient(notebook, timeout=280, kernel_name="python3", resources=resources).execute()
