"""`poise open`: a page for people who animate, on their machine."""

from __future__ import annotations

import contextlib
import json as json_
import math
import secrets
import signal
import socket
import sys
import threading
import time
import webbrowser
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import OmitArgPrefixes, Positional, arg

from poise.cli.console import Answer, failure, say, tell
from poise.cli.options import Flag, Json, Reading, check_range
from poise.errors import PoiseError

if TYPE_CHECKING:
    from poise.motion import Clip

#: Modules that a job's process knows when it begins, and those that simulations need besides.
PRELOAD = (
    *("poise.cli.main", "poise.cli.options", "poise.live.open.look"),
    *(f"poise.cli.{verb}" for verb in ("doctor", "convert", "retarget")),
)
HEAVY = (
    *("torch", "mujoco", "poise.jobs.track", "poise.jobs.complete", "poise.live.open.preview"),
    *(f"poise.cli.{verb}" for verb in ("track", "push", "complete")),
)
#: The usual port.
PORT = 8018
#: s between two lines of progress of a job.
PROGRESS_S = 0.25
#: s after which a server without pages ends with --once.
ALONE_S = 60.0


def run(
    clips: Annotated[Positional[tuple[Path, ...]], arg(metavar="FILE ...", help_behavior_hint="")] = (),
    project: Annotated[Path, arg(aliases=["-o"], metavar="DIR")] = Path("poise-project"),
    host: Annotated[str, arg(metavar="ADDRESS")] = "127.0.0.1",
    port: Annotated[int, arg(metavar="PORT")] = PORT,
    browser: Flag = True,
    once: Flag = False,
    seconds: Annotated[float | None, arg(metavar="S", help_behavior_hint="")] = None,
    json: Json = False,
    reading: OmitArgPrefixes[Reading] = Reading(),
) -> Answer:
    """Show motions in a browser, with their faults on a timeline and a button for each thing to do: mend
    them, give them a body, move them onto a rig, fill between keys, push, put a chair, export. Ctrl-C
    ends it; the project opens again.

    Args:
        clips: motion files; a folder that holds a project opens that.
        project: the folder of what is made; what is there already is shown again.
        host: the address to listen on. Any other than this machine's own lets others in that know the
            token in the address.
        port: the port of the page; 0 takes a free one, and so does the usual one where it is taken.
        browser: open no browser; the address is printed.
        once: end a minute after the last page was closed.
        seconds: end after so many seconds.
    """
    check_range("port", port, 0, 65_535)
    check_range("seconds", seconds, 0.1)
    from poise.live.admission import LOOPBACK, Guard
    from poise.live.open.open_server import OpenServer, Runs
    from poise.live.open.project import FILE, Project

    if len(clips) == 1 and (clips[0] / FILE).is_file():
        project, clips = clips[0], ()
    for path in clips:
        if not path.is_file():
            folder = "is a folder, and poise open shows files"
            what = folder if path.is_dir() else "there is no such file"
            raise PoiseError(what, path, "Name motion files", code="file-missing")
    held = Project(project)
    guard = Guard(host, _free(host, port), secrets.token_urlsafe(24))
    server = OpenServer(held, guard, Runs(work, look, rests, PRELOAD, HEAVY))
    try:
        for path in reversed(clips):
            server.add_file(path, reading=stated(reading))
        (tell if json else say)(f"Poise: {server.url}", "bold")
        say(f"The project: {held.folder}")
        if host not in LOOPBACK:
            tell(f"Others can reach this machine at {host}. The token in the address lets them in.")
        tell("Ctrl-C ends it.", "dim")
        if browser and not webbrowser.open(server.url):
            tell("No browser could be opened; open the address by hand.")
        end = math.inf if seconds is None else time.monotonic() + seconds
        _until_told(lambda: time.monotonic() > end or (once and server.left_s() > ALONE_S))
    finally:
        server.close()
    return Answer({"motions": len(held.takes)}, {"project": held.folder / FILE})


def _free(host: str, port: int) -> int:
    """The port; 0, which takes a free one, where it is the usual one and another page has it."""
    if port == PORT:
        try:
            with socket.create_server((host, port), family=_family(host)):
                return port
        except OSError:
            return 0
    return port


def _family(host: str) -> socket.AddressFamily:
    return socket.AF_INET6 if ":" in host else socket.AF_INET


def stated(reading: Reading) -> dict[str, Any]:
    """The user's statements on files, by the names of the options, as a project keeps it."""
    held = {k: v for k, v in vars(reading).items() if v not in (None, False)}
    return {k: str(v.absolute()) if isinstance(v, Path) else v for k, v in held.items()}


def _read(path: str, reading: dict[str, Any]) -> Clip:
    paths: dict[str, Any] = {k: Path(v) if k == "skeleton" else v for k, v in reading.items()}
    return Reading(**paths).read(Path(path))


def _until_told(over: Callable[[], bool]) -> None:
    """Waits for Ctrl-C, for the system to end it, or until it is over."""
    done = threading.Event()
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, lambda *_: done.set())
    with contextlib.suppress(KeyboardInterrupt):
        while not done.wait(0.5) and not over():
            pass


def work(argv: list[str], folder: Path) -> None:
    """A job: the command line `poise ARGV --json`, in the folder `folder`."""
    import os

    from poise.cli import training
    from poise.cli.main import main
    from poise.live.open.job_processes import DRAWN

    os.chdir(folder)
    Path("result").mkdir(exist_ok=True)
    training.EVERY_S, training.DRAWS = PROGRESS_S, folder / DRAWN
    sys.exit(main([*argv, "--json"]))


def look(path: str, reading: dict[str, Any], room: str, folder: Path) -> None:
    """A job: what the page draws of a file, into `room`."""

    def made() -> dict[str, Any]:
        from poise.live.open.look import write_look

        write_look(_read(path, reading), Path(room))
        return {}

    _answered(made)


def rests(path: str, reading: dict[str, Any], folder: Path) -> None:
    """A job: what a motion rests on."""

    def made() -> dict[str, Any]:
        from poise.cli.main import share_cores
        from poise.live.open.look import rests_of

        share_cores()
        tell("looking what it rests on")
        return {"boxes": rests_of(_read(path, reading))}

    _answered(made)


def _answered(made: Any) -> None:
    """Writes what was made, or why it was not, as JSON."""
    try:
        answer: dict[str, Any] = {"ok": True, **made()}
    except (KeyboardInterrupt, Exception) as problem:
        error = failure(problem)[1]
        told = {"what": error.what, "where": error.where, "hint": error.hint, "code": error.code}
        answer = {"ok": False, "error": told}
    sys.stdout.write(json_.dumps(answer, default=str))
    sys.stdout.flush()
