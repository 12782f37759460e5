"""`poise live`: streams of motion in, simulated characters in a browser out."""

from __future__ import annotations

import contextlib
import secrets
import signal
import time
import webbrowser
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import OmitArgPrefixes, Positional, arg

from poise.cli.console import Answer, say, tell
from poise.cli.options import Flag, Reading, check_range
from poise.cli.training import working
from poise.errors import PoiseError


@dataclass(frozen=True)
class Options:
    """Show characters that follow streams of motion, in a browser: drag one and it gives way, knock it
    over and it gets up. Without a stream they walk, or do the motions that you name. Ctrl-C ends it."""

    clips: Annotated[Positional[tuple[Path, ...]], arg(metavar="FILE ...", help_behavior_hint="")] = ()
    """Motion files that are played again and again, each as one person; by default a walk."""
    policy: Annotated[Path | None, arg(metavar="FILE|RUN", help_behavior_hint="")] = None
    """A policy file, the folder of a run, or keypoints, the policy that comes along and is told places
    alone; by default the one for rotations that comes with Poise."""
    characters: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Characters in one world, 1 to 16; by default one for each file."""
    buffer: Annotated[float, arg(metavar="SECONDS")] = 0.1
    """How far behind the stream characters are, 0 to 0.4; more than 0.05 is known ahead, and 0
    extrapolates the motion. Motion that trembles is smoothed, 0.033 s later."""
    lookahead: Annotated[int, arg(metavar="N")] = 0
    """How many characters look ahead before they act; each costs about half a core."""
    noise: Annotated[float, arg(metavar="0-1")] = 0.0
    """What is added to the motion as a video estimator errs."""
    keypoints: Annotated[int | None, arg(metavar="PORT", help_behavior_hint="")] = None
    """Listen for keypoints of pose estimators (TCP and UDP, docs/live.md) instead of playing files."""
    bones: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """A motion file of an avatar: the characters take its proportions."""
    vmc: Annotated[int | None, arg(metavar="PORT", help_behavior_hint="")] = None
    """Listen for VMC (avatar tools send it over UDP, mostly to port 39539) instead of playing files."""
    vmc_out: Annotated[str | None, arg(metavar="HOST:PORT", help_behavior_hint="")] = None
    """Send the first character as VMC there."""
    stream: Flag = False
    """Wait for people over the WebSocket /stream instead of playing files, see docs/live.md."""
    out: Annotated[Path | None, arg(aliases=["-o"], metavar="FILE", help_behavior_hint="")] = None
    """Where the button Record writes (.bvh, .glb, .csv, ...); by default live.bvh here."""
    record: Flag = False
    """Record from the start."""
    seconds: Annotated[float | None, arg(metavar="S", help_behavior_hint="")] = None
    """End after so many seconds."""
    host: Annotated[str, arg(metavar="ADDRESS")] = "127.0.0.1"
    """The address to listen on. Any other than this machine's own lets others in that know a token,
    which is printed."""
    port: Annotated[int, arg(metavar="PORT")] = 8017
    """The port of the page; 0 takes a free one."""
    open: Flag = False
    """Open the page in the browser."""
    seed: Annotated[int, arg(metavar="S")] = 0
    """Seed of the noise, of blows and of lookahead."""
    json: Flag = False
    """Print one JSON document at the end and nothing else on stdout, see docs/cli.md."""
    reading: OmitArgPrefixes[Reading] = field(default_factory=Reading)


def run(options: Options, argv: Sequence[str]) -> Answer:
    """Serves until Ctrl-C."""
    o = options
    check_range("port", o.port, 0, 65_535)
    check_range("vmc", o.vmc, 0, 65_535)
    check_range("keypoints", o.keypoints, 0, 65_535)
    check_range("seconds", o.seconds, 0.1)
    check_range("seed", o.seed, 0)
    live_in = o.vmc is not None or o.keypoints is not None or o.stream
    if o.clips and live_in:
        raise PoiseError(
            "files and a live stream were both given",
            hint="Leave one of them out",
            code="option-conflict",
        )
    from poise.jobs.open import open_run
    from poise.kinematics.travel import find_travel, travelled
    from poise.live.protocol import LiveConfig
    from poise.live.session import Session, SessionConfig
    from poise.live.sockets import LOOPBACK

    with working("opening the policy"):
        paths = () if live_in else o.clips or (Path(__file__).parents[1] / "data" / "walk.bvh",)
        clips = {f"{k + 1} {p.stem}"[:64]: o.reading.read(p) for k, p in enumerate(paths)}
        for name, clip in clips.items():
            if (travel := find_travel(clip)) is not None:
                tell(f"{clip.name} {travel.words()}: a character is given that travel.", "yellow")
                clips[name] = travelled(clip, travel)
        count = o.characters or max(1, len(clips))
        config = LiveConfig(count, o.buffer, o.lookahead, o.noise, o.seed)
        token = None if o.host in LOOPBACK else secrets.token_urlsafe(24)
        wanted = SessionConfig(
            clips,
            o.keypoints,
            o.vmc,
            o.vmc_out,
            o.out or Path("live.bvh"),
            o.host,
            o.port,
            token,
            o.record,
        )
        kept = list[Path]()
        tracker = open_run(o.policy).tracker
        if o.bones is not None:
            tracker = tracker.with_bones_of(o.reading.read(o.bones))
        session = Session(tracker, config, wanted)
    try:
        (tell if o.json else say)(f"Poise live: {session.server.url}", "bold")
        if token is not None:
            tell(f"Others can reach this machine at {o.host}. The token in the address lets them in.")
        if session.door is not None:
            tell(f"Waiting for keypoints on TCP and UDP port {session.door.port}. Stand still for 2 s.")
            if token is not None:
                tell(f'Each connection\'s first line and each datagram there needs "token": "{token}".')
        if session.vmc is not None:
            tell(f"Waiting for VMC on UDP port {session.vmc.port}. Stand still for 2 s at first.")
            if token is not None:
                tell("VMC knows no token: whatever reaches that port is believed to be an avatar.")
        elif o.stream:
            tell("Waiting for people at the WebSocket /stream.")
        tell("Ctrl-C ends it.", "dim")
        if o.open and not webbrowser.open(session.server.url):
            tell("No browser could be opened; open the address by hand.")
        until = None if o.seconds is None else time.perf_counter() + o.seconds
        with _ends_well():
            session.run(until)
    except KeyboardInterrupt:
        pass
    finally:
        with contextlib.suppress(KeyboardInterrupt):
            kept = session.close()
    outputs = {f"motion {k + 1}": path for k, path in enumerate(kept)}
    return Answer({"figures": session.last}, outputs)


@contextlib.contextmanager
def _ends_well():
    """A polite end of the process is Ctrl-C as well."""

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
