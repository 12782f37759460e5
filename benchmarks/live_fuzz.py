"""Messages that are torn, swapped and made up, at each door of live motion: what is left must be a pose.

    python benchmarks/live_fuzz.py --count 1000000 --json benchmarks/live_fuzz.json
    python benchmarks/live_fuzz.py --sockets 20000 --json benchmarks/live_fuzz.json

The first hands messages to what reads them, the second sends some over real sockets to a server that
another client uses meanwhile. Either keeps what the JSON holds of the other.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from poise.errors import PoiseError
from poise.live.page.server import PageServer
from poise.live.protocol import command, parse
from poise.live.sockets import Guard, StreamDoor
from poise.live.sources import JsonStream, KeypointFrame
from poise.live.stream import Inbox
from poise.live.vmc import VmcSource, datagram, standard

SKELETON = standard()
#: What a whole message at each door is.
REST = np.tile([1.0, 0, 0, 0], (len(SKELETON), 1))
POSE = {"v": 1, "type": "pose", "person": "a", "time": 1.0, "root": [0, 0, 0.8]}
BODY = {
    "v": 1, "type": "skeleton", "person": "a", "names": SKELETON.names, "parents": SKELETON.parents,
    "offsets": SKELETON.offsets.tolist(),
}  # fmt: skip
POINTS = {
    "v": 1, "type": "keypoints", "person": "a", "time": 1.0, "up": "-Y", "names": list(SKELETON.names),
    "points": [[0.1, k / 20, 3.0] for k in range(len(SKELETON))], "confidence": [0.9] * len(SKELETON),
}  # fmt: skip
PULL = {"v": 1, "type": "pull", "character": 0, "body": 1, "point": [0, 0, 0], "to": [0, 0, 1]}
WHOLE = {
    "vmc": datagram(SKELETON, np.array([0.0, 0, 0.8]), REST, 1.0),
    "stream": json.dumps({**POSE, "rotations": REST.tolist()}).encode(),
    "keypoints": json.dumps(POINTS).encode(),
    "commands": json.dumps(PULL).encode(),
}
#: Pieces that a torn message may get in place of its own.
PIECES = (b"NaN", b"1e999", b"-1e308", b"null", b"[]", b"{}", b'""', b"true", b"[[[[[[", b"\xff", b"\0")


def torn(data: bytes, rng: np.random.Generator) -> bytes:
    """The message with other bytes, cut, with a piece of another kind in it, or one of noise."""
    kind = int(rng.integers(8))
    if kind == 0:
        return rng.bytes(int(rng.integers(0, 200)))
    out = bytearray(data if kind < 6 else data[: int(rng.integers(1, len(data)))])
    if kind == 5:
        at = int(rng.integers(len(out)))
        out[at : at + int(rng.integers(4))] = PIECES[int(rng.integers(len(PIECES)))]
        return bytes(out)
    count = int(rng.integers(0, 4))
    for at, value in zip(rng.integers(0, len(out), count), rng.integers(0, 256, count), strict=True):
        out[at] = value
    return bytes(out)


class Keep:
    """Takes frames of keypoints, which must be points or missing."""

    def __init__(self) -> None:
        self.taken = 0

    def offer(self, frame: KeypointFrame) -> None:
        """Takes one."""
        assert not np.isinf(frame.points).any() and np.isfinite(frame.time_s)
        self.taken += 1


def readers(box: Inbox, keep: Keep) -> dict[str, Callable[[bytes, int], bool]]:
    """What reads a message at each door; whether it was taken or refused is counted there."""
    vmc = VmcSource("127.0.0.1", 0, box, lambda: 0.0)
    stream = JsonStream(box, "", keep.offer)
    stream.receive(json.dumps(BODY), 0.0)
    stream.receive(json.dumps({k: v for k, v in POINTS.items() if k not in ("points",)}), 0.0)

    def obey(data: bytes, _: int) -> bool:
        try:
            command(parse(data))
        except PoiseError as problem:
            box.refuse(problem.what)
            return False
        return True

    def datagram_of(data: bytes, k: int) -> bool:
        before = box.refused.total()
        vmc.receive(data, ("x", k % 3))
        return box.refused.total() == before

    def message(data: bytes, _: int) -> bool:
        return stream.receive(data, 0.0) is None

    return {"vmc": datagram_of, "stream": message, "keypoints": message, "commands": obey}


def fuzz(door: str, count: int, seed: int, seconds: float) -> dict[str, Any]:
    """So many messages, or as many as some seconds of the processor allow; every kind of exception but
    a refusal ends it."""
    rng, box, keep = np.random.default_rng(seed), Inbox(), Keep()
    read, like, taken, made = readers(box, keep)[door], WHOLE[door], 0, 0
    began = time.process_time()
    while made < count and (made % 1000 or time.process_time() - began < seconds):
        taken += read(torn(like, rng), made)
        made += 1
        if made % 16 == 0:
            for line in box.take().values():
                for _, packet in line:
                    assert np.isfinite(packet.root_pos).all() and np.isfinite(packet.rot).all()
    return {
        "messages": made, "refused": made - taken, "taken": taken,
        "reasons": dict(box.refused.most_common(12)),
        "cpu_s": round(time.process_time() - began, 1), "seed": seed,
    }  # fmt: skip


def sockets(count: int, seed: int) -> dict[str, Any]:
    """So many torn messages over each socket, while an honest client of /stream sends poses."""
    rng, box, keep, clock = np.random.default_rng(seed), Inbox(), Keep(), time.perf_counter
    guard = Guard("127.0.0.1", 0)
    hello, obeyed = {"characters": 1}, list[dict[str, Any]]()
    server = PageServer(guard, hello, box, obeyed.append, lambda: {}, clock, keep.offer)
    vmc, door = VmcSource("127.0.0.1", 0, box, clock), StreamDoor("127.0.0.1", 0, box, keep.offer, clock)
    vmc.start()
    door.start()
    url, honest = f"ws://127.0.0.1:{guard.port}", {"sent": 0, "taken": 0}
    ends = contextlib.ExitStack()
    one = ends.enter_context(connect(f"{url}/stream"))
    one.send(json.dumps(BODY))

    def also(last: float) -> float:
        """The honest client's turn, 30 times a second."""
        now = clock()
        if now - last < 1 / 30:
            return last
        one.send(json.dumps({**POSE, "person": "a", "time": now, "rotations": REST.tolist()}))
        honest["sent"] += 1
        take()
        return now

    def take() -> None:
        for name, line in box.take().items():
            honest["taken"] += len(line) if name == "1:a" else 0

    out: dict[str, Any] = {}
    for name, path in (("stream", "/stream"), ("keypoints", "/stream"), ("commands", "/live")):
        made, closed, reasons, last = 0, 0, dict[str, int](), 0.0
        while made < count:
            with connect(url + path, max_size=None, compression=None) as other:
                try:
                    for _ in range(min(count - made, 400)):
                        data = torn(WHOLE[name], rng)
                        made += 1
                        other.send(data if rng.uniform() < 0.5 else data.decode("latin-1"))
                        last = also(last)
                except ConnectionClosed as end:
                    closed += 1
                    why = end.rcvd.reason if end.rcvd is not None else "none"
                    reasons[why] = reasons.get(why, 0) + 1
        out[name] = {"messages": made, "closed": closed, "closed for": reasons}
    last = 0.0
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
        for name, port in (("vmc udp", vmc.port), ("keypoints udp", door.port)):
            for _ in range(count):
                s.sendto(torn(WHOLE[name.split()[0]], rng), ("127.0.0.1", port))
                last = also(last)
            out[name] = {"messages": count}
    made, reasons = 0, dict[str, int]()
    while made < count:
        with socket.create_connection(("127.0.0.1", door.port), 5) as s:
            try:
                s.sendall(WHOLE["keypoints"] + b"\n")
                for _ in range(min(count - made, 400)):
                    made += 1
                    s.sendall(torn(WHOLE["keypoints"], rng).replace(b"\n", b" ") + b"\n")
                    last = also(last)
                s.shutdown(socket.SHUT_WR)
            except OSError:
                pass
            s.settimeout(5)
            said = b""
            try:
                while part := s.recv(65_536):
                    said += part
            except OSError:
                pass
            words = [json.loads(w)["why"] for w in said.splitlines() if w.startswith(b"{")]
            why = words[-1] if words else "nothing, kept open to the end"
            reasons[why] = reasons.get(why, 0) + 1
    out["keypoints tcp"] = {"messages": made, "connections ended with": reasons}
    time.sleep(0.5)
    take()
    alive = one.protocol.state.name == "OPEN"
    ends.close()
    server.close()
    vmc.close()
    door.close()
    refused = {**box.refused, **guard.refused}
    return {**out, "refused": refused, "the honest client": {**honest, "still connected": alive}}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=0)
    parser.add_argument("--sockets", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=1e9, help="of the processor, for each door")
    parser.add_argument("--doors", nargs="+", default=list(WHOLE))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, required=True)
    o = parser.parse_args()
    out = json.loads(o.json.read_text()) if o.json.exists() else {}
    for door in o.doors if o.count else ():
        out[door] = fuzz(door, o.count, o.seed, o.seconds)
        o.json.write_text(json.dumps(out, indent=1) + "\n")
        print(door, out[door], flush=True)
    if o.sockets:
        out["sockets"] = sockets(o.sockets, o.seed)
        o.json.write_text(json.dumps(out, indent=1) + "\n")
        print(out["sockets"], flush=True)


if __name__ == "__main__":
    main()
