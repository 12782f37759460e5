"""Runs `poise` in a process of its own, and says what came of it."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

#: The variable that names the command where it is not found by itself; it may hold options.
VARIABLE = "POISE_COMMAND"
#: Exit code of a motion that was lost: its files are written all the same.
LOST = 3


def command() -> list[str]:
    """The words that start Poise."""
    named = os.environ.get(VARIABLE)
    if named:
        return [named] if Path(named).is_file() else shlex.split(named, posix=os.name != "nt")
    found = shutil.which("poise")
    if found is None:
        raise RuntimeError(f"The command poise was not found: set {VARIABLE} to its path")
    return [found]


def answer_of(words: Sequence[str]) -> dict[str, Any]:
    """The answer of a verb, as docs/cli.md has it. A lost motion is one; a refusal is raised.

    ComfyUI's cancel button ends the process.
    """
    with (
        tempfile.TemporaryFile("w+", encoding="utf-8") as out,
        tempfile.TemporaryFile("w+", encoding="utf-8") as err,
    ):
        process = subprocess.Popen([*command(), *words, "--json"], stdout=out, stderr=err)
        try:
            while process.poll() is None:
                _stop_if_cancelled()
                try:
                    process.wait(0.2)
                except subprocess.TimeoutExpired:
                    continue
        finally:
            if process.poll() is None:
                process.terminate()
                process.wait()
        out.seek(0)
        err.seek(0)
        try:
            answer = json.loads(out.read())
        except ValueError:
            lines = err.read().strip().splitlines()
            text = lines[-1] if lines else f"poise ended with code {process.returncode}"
            raise RuntimeError(text) from None
    if process.returncode not in (0, LOST):
        error = answer.get("error") or {}
        where = f"{error['where']}: " if error.get("where") else ""
        said = [f"{where}{error.get('what') or 'poise failed'}", error.get("hint")]
        raise RuntimeError(". ".join(str(s) for s in said if s))
    return answer


def begin(words: Sequence[str]) -> None:
    """Starts a verb that goes on by itself."""
    subprocess.Popen([*command(), *words], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def _stop_if_cancelled() -> None:
    try:
        from comfy.model_management import throw_exception_if_processing_interrupted
    except ImportError:
        return
    throw_exception_if_processing_interrupted()


def given(motion: str) -> Path:
    """A motion's path as it was given, or below ComfyUI's folders of inputs and outputs."""
    path = Path(motion.strip().strip('"')).expanduser()
    if path.is_absolute() or path.exists():
        return path
    for folder in _folders():
        if (folder / path).exists():
            return folder / path
    return path


def fresh(motion: Path, verb: str, suffix: str) -> Path:
    """A file in the folder of outputs that is not there yet."""
    folder = _folders()[0] / "poise"
    folder.mkdir(parents=True, exist_ok=True)
    number = 1
    while True:
        path = folder / f"{motion.stem}_{verb}_{number:05d}{suffix}"
        if not path.exists() and not path.with_suffix("").exists():
            return path
        number += 1


def _folders() -> tuple[Path, Path]:
    """ComfyUI's folders of outputs and inputs; without ComfyUI the present one."""
    try:
        import folder_paths
    except ImportError:
        return Path("output"), Path("input")
    return Path(folder_paths.get_output_directory()), Path(folder_paths.get_input_directory())
