"""A project: a folder with motions, how each was made, and what was shown last. It opens again."""

from __future__ import annotations

import json
import re
import secrets
import threading
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from poise.errors import PoiseError

FILE = "project.json"
#: Version of the file; motions of a project at most; letters of a name.
VERSION, MOST, LETTERS = 1, 2000, 120
#: Bytes of a file that is dropped on the page.
LARGEST = 1 << 30


@dataclass(frozen=True)
class ProjectTake:
    """A motion of a project; nothing writes over it.

    Attributes:
        id: its name in paths and messages.
        name: for people.
        file: where it lies; relative to the project where it is inside.
        parent: the take that it was made of, "" for a file that came in.
        action: what made it, and `line` the command line.
        reading: how its file is read, by the names of the command line's options; empty guesses.
        result: the folder of a simulation's results, "" without one.
        says: what there is to say of it: the sentences of the score and the like.
        moment: the frame that it is about, such as that of a push; None without.
        hidden: whether it is left out of the list.
    """

    id: str
    name: str
    file: str
    parent: str = ""
    action: str = ""
    line: str = ""
    reading: dict[str, Any] = field(default_factory=dict[str, Any])
    result: str = ""
    says: tuple[str, ...] = ()
    moment: int | None = None
    hidden: bool = False


class Project:
    """Motions in a folder, kept in its `project.json` at each change.

    Raises:
        PoiseError: the folder cannot be made, or its file is none of a project.
    """

    def __init__(self, folder: Path):
        self.folder = folder.absolute()
        self.current = ""
        self.takes: dict[str, ProjectTake] = {}
        self._lock = threading.Lock()
        for name in ("files", "takes", "exports"):
            try:
                (self.folder / name).mkdir(parents=True, exist_ok=True)
            except OSError as problem:
                why = f"cannot be made ({(problem.strerror or '').lower()})"
                raise PoiseError(why, folder, "Choose another folder", code="cannot-write") from None
        if (self.folder / FILE).exists():
            self._open()

    def _open(self) -> None:
        path = self.folder / FILE
        try:
            held = json.loads(path.read_text(encoding="utf-8"))
            known = ProjectTake.__dataclass_fields__
            rows = [{k: v for k, v in row.items() if k in known} for row in held["takes"]]
            takes = [ProjectTake(**{**row, "says": tuple(row.get("says", ()))}) for row in rows]
        except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
            hint = "Choose another folder, or put its project.json aside"
            raise PoiseError("is no project of Poise", path, hint, code="not-a-project") from None
        self.takes = {t.id: t for t in takes if re.fullmatch(r"[0-9a-z]{1,16}", str(t.id))}
        self.current = held.get("current", "") if held.get("current", "") in self.takes else ""

    def save(self) -> None:
        """Writes the file, whole or not at all."""
        with self._lock:
            held = {
                "poise": VERSION,
                "current": self.current,
                "takes": [asdict(t) for t in self.takes.values()],
            }
            write_json(self.folder / FILE, held)

    def path(self, take: ProjectTake) -> Path:
        """The path of its file."""
        return self.folder / take.file

    def room(self, take: ProjectTake) -> Path:
        """The folder of what is known about it, which can be made again."""
        return self.folder / "takes" / take.id

    def add(self, name: str, path: Path, **more: Any) -> ProjectTake:
        """A new take, of a file that stays where it is.

        Raises:
            PoiseError: there are too many.
        """
        if len(self.takes) >= MOST:
            what = f"a project holds {MOST} motions at most"
            raise PoiseError(what, self.folder, "Begin another", code="over-limit")
        path = path.absolute()
        inside = path.relative_to(self.folder) if path.is_relative_to(self.folder) else path
        number = secrets.token_hex(4)
        take = ProjectTake(number, self._free(name), inside.as_posix(), **more)
        self.takes[number] = take
        self.room(take).mkdir(parents=True, exist_ok=True)
        return take

    def _free(self, name: str) -> str:
        """The name, with a number where there is one of that name."""
        name = clean_name(name) or "motion"
        held = {t.name for t in self.takes.values()}
        tried = (f"{name} {k}" for k in range(2, MOST + 2))
        return name if name not in held else next(n for n in tried if n not in held)

    def change(self, number: str, **changes: Any) -> ProjectTake:
        """The take with changes."""
        take = self.takes[number] = replace(self.takes[number], **changes)
        return take

    def of_path(self, path: Path) -> ProjectTake | None:
        """The take that came from a file."""
        same = (t for t in self.takes.values() if not t.parent and self.path(t) == path.absolute())
        return next(same, None)

    def free_file(self, folder: str, name: str) -> Path:
        """A file in a folder of the project that is not there yet, named so or with a number."""
        stem, dot, suffix = safe_file(name).rpartition(".")
        stem, suffix = (stem, dot + suffix) if stem else (suffix, "")
        for more in ("", *(f"-{k}" for k in range(2, 10_000))):
            path = self.folder / folder / f"{stem}{more}{suffix}"
            if not path.exists():
                return path
        raise PoiseError("holds too many files of that name", stem, code="over-limit")


def write_json(path: Path, held: Any) -> None:
    """Writes a file whole or not at all. The formats' own writer is not used, since importing it takes
    longer than all else before the page is there."""
    beside = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    beside.write_text(json.dumps(held, indent=1) + "\n", encoding="utf-8")
    beside.replace(path)


def clean_name(text: str) -> str:
    """A name without control characters, not too long."""
    return "".join(c for c in text if c.isprintable())[:LETTERS].strip()


def safe_file(name: str) -> str:
    """A name as a file may bear it anywhere: no folder, no sign that a shell or a system reads."""
    last = re.split(r"[/\\]", name)[-1]
    kept = re.sub(r"[^\w.+()\[\] -]", "_", clean_name(last), flags=re.ASCII).strip(" .")
    return kept or "motion"
