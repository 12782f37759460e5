"""The server of `poise open`: a page, its project, uploads, jobs and exports, on this machine alone."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import shlex
import shutil
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

from poise.errors import PoiseError
from poise.live.admission import VERSION, Bucket, Guard, parse
from poise.live.open.actions import (
    ACTIONS,
    EXPORTS,
    READING,
    Action,
    reading_of,
    reading_words,
    suffix_for,
    told,
    words_of,
)
from poise.live.open.answers import code_of, motion_of, problem_of, sentences
from poise.live.open.job_processes import DRAWN, PageJob, Workers, drawn_since
from poise.live.open.project import LARGEST, Project, ProjectTake, clean_name, safe_file, write_json
from poise.live.open.project_lock import ProjectLock
from poise.live.page.web import CSS, HTML, JS, STAGE, TOLD, Asset, Content, WebServer

SCRIPTS = ("figure", "stage_view", "timeline", "forms", "open")
#: Files that can be fetched beside those of takes.
PAGES: dict[str, Asset] = {
    "/": ("live.open", "open.html", HTML),
    "/open.css": ("live.open", "open.css", CSS),
    **{f"/{name}.js": ("live.open", f"{name}.js", JS) for name in SCRIPTS},
    **STAGE,
}
#: Bytes of a message, which may be a part of a file; s between two states that a page is told.
PART, EVERY_S = 1 << 20, 0.1
#: Files that belong to another one and are no motion themselves; bytes of a disk that stay free.
COMPANIONS, FREE = (".asf", ".bin", ".png", ".jpg", ".jpeg"), 256 << 20
#: The folder, in that of a job, where it writes.
RESULT = "result"
#: Things that happened, which a page is told.
EVENTS = 30
#: A report holds its own scripts; it may do nothing but show itself.
_REPORT = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'; sandbox allow-scripts"
)
_FETCHED = re.compile(r"/(figure|judged|report|export)/([0-9a-z]{1,16})")
#: Address of the frames that a job has simulated so far, from a row on.
_DRAWN = re.compile(r"/drawn/([0-9]{1,9})/([0-9]{1,9})")


@dataclass(frozen=True)
class Runs:
    """Functions that run in processes of their own; each is known by its import path there.

    Attributes:
        work: a command line; its JSON goes to stdout.
        look: (file, reading, folder): writes what the page draws, see `look`.
        rests: (file, reading): writes what the motion rests on, as JSON to stdout.
        preload: modules that a process knows when it begins. heavy: those of simulations, see `Workers`.
    """

    work: Callable[..., None]
    look: Callable[..., None]
    rests: Callable[..., None]
    preload: tuple[str, ...] = ()
    heavy: tuple[str, ...] = ()


class OpenServer:
    """Serves a project until `close`.

    Args:
        project: what is shown.
        guard: what is let in.
        runs: what runs elsewhere.

    Raises:
        PoiseError: another page has the project; or the address is taken or is none of this machine.
    """

    def __init__(self, project: Project, guard: Guard, runs: Runs):
        # Files of a job of another page would be taken away below.
        self._lock = ProjectLock(project.folder)
        self.project, self.guard, self._runs = project, guard, runs
        self._events: list[dict[str, Any]] = []
        self._event_count = 0
        self._exports: dict[str, Path] = {}
        self._looking: dict[str, int] = {}
        self._pages, self._left = 0, 0.0
        self._stood: dict[str, list[dict[str, Any]]] = {}
        self._fresh: asyncio.Event | None = None
        self._jobs = project.folder / ".jobs"
        shutil.rmtree(self._jobs, ignore_errors=True)
        self.workers = Workers(self._jobs, runs.preload, self._changed, self._broke, runs.heavy)
        doors = {"/open": self._talk, "/upload": self._upload}
        try:
            self._web = WebServer(guard, PAGES, doors, PART, self._ready, self._fetch)
        except PoiseError:
            self.workers.close()
            self._lock.release()
            raise
        self._lock.tell(self._web.url.partition("?")[0])
        for take in project.takes.values():
            if not (project.room(take) / "judged.json").exists() and not take.hidden:
                self.look(take)

    @property
    def url(self) -> str:
        """The address of the page, with the token."""
        return self._web.url

    def close(self) -> None:
        """Ends what runs, and stops serving."""
        self.workers.close()
        self._web.close()
        shutil.rmtree(self._jobs, ignore_errors=True)
        self._lock.release()

    def add_file(self, path: Path, **more: Any) -> ProjectTake:
        """A motion of a file, looked at as soon as there is time; the same file is there once."""
        take = self.project.of_path(path)
        if take is None:
            take = self.project.add(path.stem, path, **more)
            self.look(take)
        if take.hidden:
            take = self.project.change(take.id, hidden=False)
        self.project.current = take.id
        self.project.save()
        self._changed()
        return take

    def look(self, take: ProjectTake) -> None:
        """Has a process read a motion for the page."""
        room = self.project.room(take)
        room.mkdir(parents=True, exist_ok=True)
        for name in ("figure.bin", "judged.json"):
            (room / name).unlink(missing_ok=True)
        self._looking[take.id] = self._looking.get(take.id, 0) + 1
        args = (str(self.project.path(take)), dict(take.reading), str(room))
        self.workers.submit("look", self._runs.look, args, self._looked, take=take.id, label="Reading")

    # --- what jobs came to --------------------------------------------------------------------

    def _looked(self, job: PageJob) -> None:
        number = job.about["take"]
        self._looking[number] = self._looking.get(number, 1) - 1
        problem = problem_of(job)
        if problem and number in self.project.takes:
            self._tell("refused", problem, number, code=code_of(job))

    def _worked(self, job: PageJob) -> None:
        about = job.about
        parent, action = self.project.takes.get(about["take"]), ACTIONS[about["action"]]
        problem, answer = problem_of(job), job.answer()
        if job.state == "stopped":
            self._tell("stopped", f"{action.label} was stopped; nothing was changed.", about["take"])
            return
        motion = motion_of(answer.get("outputs") or {})
        if problem or parent is None or motion is None:
            text = problem or f"{action.label} made no motion."
            self._tell("refused", text, about["take"])
            return
        made = self.project.add(
            f"{parent.name} {action.makes}",
            motion,
            parent=parent.id,
            action=action.name,
            line=about["line"],
            reading=about["reads"],
            says=tuple(sentences(action, answer)),
            moment=about["moment"],
        )
        room = self.project.room(made)
        kept = room / RESULT
        shutil.move(job.folder / RESULT, kept)
        inside = kept / motion.relative_to(RESULT)
        result = kept.relative_to(self.project.folder).as_posix() if action.folder else ""
        file = inside.relative_to(self.project.folder).as_posix()
        made = self.project.change(made.id, file=file, result=result)
        if self.project.current == parent.id:
            self.project.current = made.id
        self.project.save()
        self.look(made)
        self._tell("lost" if answer.get("exit_code") else "done", f"{made.name} is there.", made.id)

    def _broke(self, job: PageJob, problem: Exception) -> None:
        said = f"{type(problem).__name__}: {problem}"
        self._tell("refused", f"What came of it could not be kept ({said}).", str(job.about.get("take")))

    def _exported(self, job: PageJob) -> None:
        problem, target = problem_of(job), Path(job.about["target"])
        if problem or not (job.folder / target.name).exists():
            self._tell("refused", problem or "The export was stopped.", job.about["take"])
            return
        shutil.move(job.folder / target.name, target)
        number = f"e{job.id}"
        self._exports[number] = target
        self._tell("exported", f"{target.name} lies in {target.parent}.", job.about["take"], file=number)

    def _rested(self, job: PageJob) -> None:
        problem, found = problem_of(job), job.answer().get("boxes")
        text = problem or ("" if found else "The motion rests on nothing but its floor.")
        self._tell("refused" if problem else "rests", text, job.about["take"], boxes=found or [])

    def _tell(self, kind: str, text: str, take: str, **more: Any) -> None:
        self._event_count += 1
        event = {"number": self._event_count, "kind": kind, "text": text, "take": take, **more}
        self._events = [*self._events[-EVENTS + 1 :], event]
        self._changed()

    # --- what the page is told ----------------------------------------------------------------

    def _changed(self) -> None:
        web = getattr(self, "_web", None)
        if web is not None:
            web.soon(self._wake)

    def _wake(self) -> None:
        if self._fresh is not None:
            fresh, self._fresh = self._fresh, asyncio.Event()
            fresh.set()

    async def _ready(self) -> None:
        self._fresh = asyncio.Event()

    def state(self) -> dict[str, Any]:
        """All that the page shows but the motions themselves."""
        takes = [
            {
                "id": t.id,
                "name": t.name,
                "parent": t.parent,
                "action": t.action,
                "line": t.line,
                "reading": t.reading,
                "says": t.says,
                "moment": t.moment,
                "simulated": bool(t.result),
                "suffix": Path(t.file).suffix.lower(),
                "figure": self._stamp(t, "figure.bin"),
                "judged": self._stamp(t, "judged.json"),
                "looking": self._looking.get(t.id, 0) > 0,
                "boxes": self._stands(t),
                "report": bool(t.result) and (self.project.folder / t.result / "report.html").exists(),
            }
            for t in list(self.project.takes.values())
            if not t.hidden
        ]
        return {
            "v": VERSION,
            "type": "project",
            "folder": str(self.project.folder),
            "takes": takes,
            "current": self.project.current,
            "jobs": self.workers.told(),
            "events": self._events,
        }

    def _stands(self, take: ProjectTake) -> list[dict[str, Any]]:
        """The boxes on which a body that did a motion stood, sat or leaned."""
        if take.result and take.id not in self._stood:
            try:
                text = (self.project.folder / take.result / "supports.json").read_text(encoding="utf-8")
                self._stood[take.id] = [dict(row) for row in json.loads(text)]
            except (OSError, ValueError, TypeError):
                self._stood[take.id] = []
        return self._stood.get(take.id, [])

    def _stamp(self, take: ProjectTake, name: str) -> int:
        try:
            return (self.project.room(take) / name).stat().st_mtime_ns // 1_000_000
        except OSError:
            return 0

    def _fetch(self, path: str) -> Content | None:
        """A file of a take or a job or an export, by its number alone."""
        if drawn := _DRAWN.fullmatch(path):
            return self._drawn(*map(int, drawn.groups()))
        found = _FETCHED.fullmatch(path)
        if found is None:
            return None
        kind, number = found.groups()
        with contextlib.suppress(OSError):
            if kind == "export":
                file = self._exports.get(number)
                return file and Content(file.read_bytes(), "application/octet-stream", file.name)
            take = self.project.takes.get(number)
            if take is None:
                return None
            room = self.project.room(take)
            if kind == "figure":
                return Content((room / "figure.bin").read_bytes(), "application/octet-stream")
            if kind == "judged":
                return Content((room / "judged.json").read_bytes(), "application/json")
            report = self.project.folder / take.result / "report.html"
            return Content(report.read_bytes(), HTML, policy=_REPORT) if take.result else None
        return None

    def _drawn(self, number: int, row: int) -> Content | None:
        job = self.workers.jobs.get(number)
        # A job that ends takes its file with it.
        with contextlib.suppress(OSError, ValueError, KeyError):
            if job is not None:
                data = drawn_since(job.folder / DRAWN, row)
                return Content(data, "application/octet-stream")
        return None

    # --- doors --------------------------------------------------------------------------------

    def left_s(self) -> float:
        """s since the last page was closed; 0 while one is open, or none was yet."""
        return time.monotonic() - self._left if self._left and not self._pages else 0.0

    async def _talk(self, connection: ServerConnection) -> None:
        hello = {
            "v": VERSION,
            "type": "hello",
            "actions": told(),
            "exports": EXPORTS,
            "reading": READING,
            "largest": LARGEST,
        }
        with contextlib.suppress(ConnectionClosed):
            await connection.send(json.dumps(hello))
            sending = asyncio.create_task(self._send(connection))
            self._pages += 1
            try:
                await self._listen(connection)
            finally:
                sending.cancel()
                self._pages, self._left = self._pages - 1, time.monotonic()

    async def _send(self, connection: ServerConnection) -> None:
        last = ""
        with contextlib.suppress(ConnectionClosed):
            while True:
                fresh = self._fresh
                words = json.dumps(self.state())
                if words != last:
                    await connection.send(words)
                    last = words
                await asyncio.sleep(EVERY_S)
                if fresh is not None and fresh is self._fresh:
                    await fresh.wait()

    async def _listen(self, connection: ServerConnection) -> None:
        bucket, said = Bucket(), 0
        async for message in connection:
            if not bucket.takes():
                self.guard.refused["too many messages"] += 1
                closing = asyncio.create_task(connection.close(1008, "too many messages"))
                async for _ in connection:
                    pass
                await closing
                return
            try:
                answer = self.obey(parse(message))
            except PoiseError as problem:
                self.guard.refused[problem.code] += 1
                said += 1
                answer = {"type": "refused", "why": str(problem)} if said <= TOLD else None
            except OSError as problem:
                # The disk is full, or the project's folder is gone.
                why = f"The project cannot be written ({(problem.strerror or '').lower()})."
                answer = {"type": "refused", "why": why}
            if answer is not None:
                await connection.send(json.dumps({"v": VERSION, **answer}))

    async def _upload(self, connection: ServerConnection) -> None:
        """Takes a file in parts: the first answer lets it go on, the last one names the take."""
        asked = parse_qs(urlsplit(connection.request.path if connection.request else "").query)
        name, size = asked.get("name", [""])[0], asked.get("size", [""])[0]
        problem = self._refuses(name, size)
        with contextlib.suppress(ConnectionClosed):
            if problem:
                self.guard.refused["upload"] += 1
                await connection.send(json.dumps({"v": VERSION, "type": "refused", "why": problem}))
                return
            await connection.send(json.dumps({"v": VERSION, "type": "go on"}))
            path = self.project.free_file("files", name)
            part = path.with_name(f".{path.name}.part")
            try:
                whole = await _received(connection, part, int(size))
                if whole:
                    part.replace(path)
                    answer = self._came(path)
                else:
                    answer = {"type": "refused", "why": f"{name} did not arrive whole. Drop it again."}
                await connection.send(json.dumps({"v": VERSION, **answer}))
            finally:
                part.unlink(missing_ok=True)

    def _refuses(self, name: str, size: str) -> str:
        """Why a file is not taken, in a sentence; "" where it is."""
        if not name or not size.isascii() or not size.isdigit() or len(size) > 15:
            return "A file needs a name and a size."
        if int(size) > LARGEST:
            large = f"{clean_name(name)} is larger than {LARGEST >> 30} GB."
            return f"{large} Cut the motion, leave meshes out, or name its path: poise open FILE."
        if shutil.disk_usage(self.project.folder).free < int(size) + FREE:
            return "The disk of the project is full. Free some space."
        return ""

    def _came(self, path: Path) -> dict[str, Any]:
        if path.suffix.lower() in COMPANIONS:
            return {"type": "companion", "name": path.name}
        try:
            return {"type": "took", "take": self.add_file(path).id}
        except PoiseError as problem:
            return {"type": "refused", "why": str(problem)}

    # --- what the page asks for ---------------------------------------------------------------

    def obey(self, message: Mapping[str, Any]) -> dict[str, Any] | None:
        """Does what a page asks for; what it is answered, if anything.

        Raises:
            PoiseError: it makes no sense.
        """
        kind = message.get("type")
        if kind == "stop":
            self.workers.stop(_whole(message.get("job")))
            return None
        take = self.project.takes.get(str(message.get("take")))
        if take is None:
            raise PoiseError("there is no such motion", code="unknown-take")
        match kind:
            case "choose":
                self.project.current = take.id
            case "rename":
                name = clean_name(str(message.get("name", "")))
                if name:
                    self.project.change(take.id, name=name)
            case "hide":
                self.project.change(take.id, hidden=True)
                if self.project.current == take.id:
                    shown = [t.id for t in self.project.takes.values() if not t.hidden]
                    self.project.current = take.parent if take.parent in shown else (*shown, "")[0]
            case "show":
                self.project.change(take.id, hidden=False)
                self.project.current = take.id
            case "reading":
                kept = {k: v for k, v in take.reading.items() if k not in READING}
                take = self.project.change(take.id, reading=kept | reading_of(message.get("values")))
                self.look(take)
            case "line":
                line = self._argv(take, message, Path("OUT"))[1]
                return {"type": "line", "line": line, "action": message.get("action")}
            case "run":
                self._run(take, message)
            case "rests":
                args = (str(self.project.path(take)), dict(take.reading))
                about = {"take": take.id, "label": "Finding what it rests on"}
                self.workers.submit("work", self._runs.rests, args, self._rested, **about)
            case "export":
                self._export(take, str(message.get("format")))
            case _:
                raise PoiseError("unknown type", "message", code="unknown-type")
        self.project.save()
        self._changed()
        return None

    def _run(self, take: ProjectTake, message: Mapping[str, Any]) -> None:
        words, line = self._argv(take, message, Path(RESULT))
        action = ACTIONS[str(message.get("action"))]
        values = message.get("values")
        if isinstance(values, Mapping) and values.get("boxes"):
            write_json(self._boxes(take), values["boxes"])
        moment = message.get("moment")
        moment = moment if isinstance(moment, int) and not isinstance(moment, bool) else None
        about = {
            "take": take.id,
            "action": action.name,
            "label": action.label,
            "line": line,
            "reads": self._reads(take, action),
            "moment": moment,
        }
        self.workers.submit("work", self._runs.work, (words,), self._worked, **about)

    def _argv(self, take: ProjectTake, message: Mapping[str, Any], out: Path) -> tuple[list[str], str]:
        """The words of a button's command line, and the line for people.

        The job writes below `out`, a path in its own folder.
        """
        action = ACTIONS.get(str(message.get("action")))
        if action is None:
            raise PoiseError("there is no such button", code="unknown-action")
        values = message.get("values") or {}
        takes = self.project.takes
        files = {t.id: self.project.path(t) for t in takes.values()}
        source, more = take, list[str]()
        if action.needs:
            source = takes.get(take.parent)
            if not take.result or source is None:
                raise PoiseError(
                    "only a motion that a body did has a range to do anew",
                    hint="Give it a body first",
                    code="no-simulation",
                )
            more = ["--from", str(self.project.folder / take.result)]
        given = {**values} if isinstance(values, Mapping) else values
        words = words_of(action, given, self._frames(take), files, self._boxes(take))
        onto = files.get(str(given.get("onto"))) if isinstance(given, Mapping) else None
        if action.name == "rig" and onto is None:
            hint = "Drop one, or choose a motion"
            raise PoiseError("a rig is missing", hint=hint, code="argument-missing")
        suffix = suffix_for(action, self._home(take), onto)
        name = safe_file(f"{take.name} {action.makes}")
        target = str(out) if action.folder else str(out / f"motion{suffix}")
        path = str(self.project.path(source))
        read = reading_words(source.reading)
        argv = [action.verb, path, *words, *more, *read, "-o", target]
        shown = [*words, *more, *read]
        shown = [_short(w, self.project.folder) for w in shown]
        named = name if action.folder else f"{name}{suffix}"
        came = Path(path)
        # A motion that was made here bears the name of its motion for people.
        read_from = safe_file(f"{source.name}{came.suffix}") if source.parent else came.name
        return argv, shlex.join(["poise", action.verb, read_from, *shown, "-o", named])

    def _reads(self, take: ProjectTake, action: Action) -> dict[str, Any]:
        """How what a button writes is read: a BVH does not say its unit nor its vertical."""
        if action.name == "rig" or self._home(take) != ".bvh":
            return {}
        head = self._head(take)
        own = head.get("format") == "bvh"
        unit, up = (head.get("unit_m", 0.01), head.get("up_axis", "Y")) if own else (0.01, "Y")
        return {"unit": f"{unit:.9g}", "up": up}

    def _export(self, take: ProjectTake, suffix: str) -> None:
        if suffix not in EXPORTS:
            raise PoiseError("that format is not written", code="format-not-written")
        target = self.project.free_file("exports", f"{take.name}{suffix}")
        argv = ["convert", str(self.project.path(take)), target.name, *reading_words(take.reading)]
        about = {"take": take.id, "target": str(target), "label": "Exporting"}
        self.workers.submit("look", self._runs.work, (argv,), self._exported, **about)

    def _boxes(self, take: ProjectTake) -> Path:
        return self.project.room(take) / "boxes.json"

    def _head(self, take: ProjectTake) -> dict[str, Any]:
        """The header of what the page draws; empty before it is there."""
        path = self.project.room(take) / "figure.bin"
        with contextlib.suppress(OSError, ValueError), path.open("rb") as file:
            return json.loads(file.read(int.from_bytes(file.read(4), "little")))
        return {}

    def _home(self, take: ProjectTake) -> str:
        return str(self._head(take).get("home", ".bvh"))

    def _frames(self, take: ProjectTake) -> int:
        frames = int(self._head(take).get("frames", 0))
        if not frames:
            raise PoiseError("the motion is not read yet", take.name, "Wait a moment", code="not-ready")
        return frames


async def _received(connection: ServerConnection, part: Path, size: int) -> bool:
    """Receives a file; true if it came whole."""
    came = 0
    with part.open("xb") as file:
        while came < size:
            message = await connection.recv()
            if isinstance(message, str) or not message or came + len(message) > size:
                return False
            came += len(message)
            file.write(message)
    return True


def _short(word: str, folder: Path) -> str:
    """A word of a command line without the project's folder."""
    return word.replace(f"{folder}/", "")


def _whole(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise PoiseError("no number", "message", code="not-a-number")
    return value
