"""`poise live`: streams of motion in, simulated characters in a browser out."""

from __future__ import annotations

import contextlib
import secrets
import signal
import time
import webbrowser
from pathlib import Path
from typing import Annotated

from tyro.conf import OmitArgPrefixes, Positional, arg

from poise.cli.console import Answer, say, tell
from poise.cli.options import Flag, Json, OpenPage, PolicyFile, Reading, check_range
from poise.cli.training import working
from poise.errors import PoiseError


def run(
    clips: Annotated[Positional[tuple[Path, ...]], arg(metavar="FILE ...", help_behavior_hint="")] = (),
    policy: PolicyFile = None,
    characters: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None,
    buffer: Annotated[float, arg(metavar="SECONDS")] = 0.1,
    lookahead: Annotated[int, arg(metavar="N")] = 0,
    noise: Annotated[float, arg(metavar="0-1")] = 0.0,
    keypoints: Annotated[int | None, arg(metavar="PORT", help_behavior_hint="")] = None,
    bones: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None,
    vmc: Annotated[int | None, arg(metavar="PORT", help_behavior_hint="")] = None,
    vmc_out: Annotated[str | None, arg(metavar="HOST:PORT", help_behavior_hint="")] = None,
    stream: Flag = False,
    out: Annotated[Path | None, arg(aliases=["-o"], metavar="FILE", help_behavior_hint="")] = None,
    record: Flag = False,
    seconds: Annotated[float | None, arg(metavar="S", help_behavior_hint="")] = None,
    host: Annotated[str, arg(metavar="ADDRESS")] = "127.0.0.1",
    port: Annotated[int, arg(metavar="PORT")] = 8017,
    open: OpenPage = False,
    seed: Annotated[int, arg(metavar="S")] = 0,
    json: Json = False,
    reading: OmitArgPrefixes[Reading] = Reading(),
) -> Answer:
    """Show characters that follow streams of motion, in a browser: drag one and it gives way, knock it
    over and it gets up. Without a stream they walk, or do the motions that you name. Ctrl-C ends it.

    Args:
        clips: motion files that are played again and again, each as one person; by default a walk.
        characters: characters in one world, 1 to 16; by default one for each file.
        buffer: how far behind the stream characters are, 0 to 0.4; more than 0.05 is known ahead, and 0
            extrapolates the motion. Motion that trembles is smoothed, 0.033 s later.
        lookahead: how many characters look ahead before they act; each costs about half a core.
        noise: what is added to the motion as a video estimator errs.
        keypoints: listen for keypoints of pose estimators (TCP and UDP, docs/live.md) instead of playing
            files.
        bones: a motion file of an avatar: the characters take its proportions.
        vmc: listen for VMC (avatar tools send it over UDP, mostly to port 39539) instead of playing
            files.
        vmc_out: send the first character as VMC there.
        stream: wait for people over the WebSocket /stream instead of playing files, see docs/live.md.
        out: where the button Record writes (.bvh, .glb, .csv, ...); by default live.bvh here.
        record: record from the start.
        seconds: end after so many seconds.
        host: the address to listen on. Any other than this machine's own lets others in that know a
            token, which is printed.
        port: the port of the page; 0 takes a free one.
        seed: seed of the noise, of blows and of lookahead.
    """
    check_range("port", port, 0, 65_535)
    check_range("vmc", vmc, 0, 65_535)
    check_range("keypoints", keypoints, 0, 65_535)
    check_range("seconds", seconds, 0.1)
    check_range("seed", seed, 0)
    live_in = vmc is not None or keypoints is not None or stream
    if clips and live_in:
        raise PoiseError(
            "files and a live stream were both given",
            hint="Leave one of them out",
            code="option-conflict",
        )
    from poise.jobs.open import open_run
    from poise.kinematics.travel import find_travel, travelled
    from poise.live.admission import LOOPBACK
    from poise.live.protocol import LiveConfig
    from poise.live.session import Session, SessionConfig

    with working("opening the policy"):
        paths = () if live_in else clips or (Path(__file__).parents[1] / "data" / "walk.bvh",)
        motions = {f"{k + 1} {p.stem}"[:64]: reading.read(p) for k, p in enumerate(paths)}
        for name, clip in motions.items():
            if (travel := find_travel(clip)) is not None:
                tell(f"{clip.name} {travel.words()}: a character is given that travel.", "yellow")
                motions[name] = travelled(clip, travel)
        count = characters or max(1, len(motions))
        config = LiveConfig(count, buffer, lookahead, noise, seed)
        token = None if host in LOOPBACK else secrets.token_urlsafe(24)
        wanted = SessionConfig(
            motions,
            keypoints,
            vmc,
            vmc_out,
            out or Path("live.bvh"),
            host,
            port,
            token,
            record,
        )
        kept = list[Path]()
        tracker = open_run(policy).tracker
        if bones is not None:
            tracker = tracker.with_bones_of(reading.read(bones))
        session = Session(tracker, config, wanted)
    try:
        (tell if json else say)(f"Poise live: {session.server.url}", "bold")
        if token is not None:
            tell(f"Others can reach this machine at {host}. The token in the address lets them in.")
        if session.door is not None:
            tell(f"Waiting for keypoints on TCP and UDP port {session.door.port}. Stand still for 2 s.")
            if token is not None:
                tell(f'Each connection\'s first line and each datagram there needs "token": "{token}".')
        if session.vmc is not None:
            tell(f"Waiting for VMC on UDP port {session.vmc.port}. Stand still for 2 s at first.")
            if token is not None:
                tell("VMC knows no token: whatever reaches that port is believed to be an avatar.")
        elif stream:
            tell("Waiting for people at the WebSocket /stream.")
        tell("Ctrl-C ends it.", "dim")
        if open and not webbrowser.open(session.server.url):
            tell("No browser could be opened; open the address by hand.")
        until = None if seconds is None else time.perf_counter() + seconds
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
