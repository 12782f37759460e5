"""The page for people who animate: its buttons, its project, its jobs, and who is let in."""

from __future__ import annotations

import inspect
import json
import os
import socket
import struct
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import is_dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from toy_jobs import toy_look, toy_rests, toy_work
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from poise.cli.open import _free
from poise.cli.parse import options_of
from poise.errors import PoiseError
from poise.formats import read_clip
from poise.live.admission import Guard
from poise.live.open.actions import ACTIONS, EXPORTS, reading_of, reading_words, words_of
from poise.live.open.answers import sentences
from poise.live.open.job_processes import PageJob, Workers
from poise.live.open.look import figure_of, judged
from poise.live.open.open_server import PAGES, OpenServer, Runs
from poise.live.open.project import LARGEST, Project, safe_file
from poise.live.open.project_lock import LOCK, ProjectLock
from refusals import refused
from test_docs import WALK

#: Options of verbs that come from the settings of a job.
DERIVED = ("controller", "body", "in_place", "seed")


class Client:
    """A page without a browser."""

    def __init__(self, server: OpenServer):
        self.server, self.where = server, f"127.0.0.1:{server.guard.port}"
        self.stack = ExitStack()
        self.socket = self.stack.enter_context(connect(self.door("/open"), max_size=None))
        assert self.read()["type"] == "hello"
        self.state: dict[str, Any] = {}
        self.until(lambda s: True)

    def door(self, path: str) -> str:
        return f"ws://{self.where}{path}{'&' if '?' in path else '?'}token={self.server.guard.token}"

    def read(self) -> dict[str, Any]:
        return json.loads(self.socket.recv(60))

    def send(self, **message: Any) -> None:
        self.socket.send(json.dumps({"v": 1, **message}))

    def until(self, there: Callable[[dict[str, Any]], Any]) -> Any:
        """Reads states until one is as it should be; what `there` finds."""
        if self.state and (found := there(self.state)):
            return found
        while True:
            told = self.read()
            if told["type"] == "project":
                self.state = told
                if found := there(told):
                    return found

    def take(self, name: str) -> dict[str, Any]:
        return self.until(
            lambda s: next(
                (t for t in s["takes"] if t["name"] == name and t["judged"] and not t["looking"]), None
            )
        )

    def event(self, kind: str) -> dict[str, Any]:
        return self.until(lambda s: next((e for e in s["events"] if e["kind"] == kind), None))

    def upload(self, name: str, data: bytes, size: int | None = None) -> dict[str, Any]:
        with connect(
            self.door(f"/upload?name={name}&size={len(data) if size is None else size}")
        ) as one:
            first = json.loads(one.recv(10))
            if first["type"] != "go on":
                return first
            for k in range(0, len(data), 500):
                one.send(data[k : k + 500])
            return json.loads(one.recv(20))


@contextmanager
def serving(folder: Path) -> Iterator[Client]:
    runs = Runs(toy_work, toy_look, toy_rests)
    server = OpenServer(Project(folder), Guard("127.0.0.1", 0, "secret-word"), runs)
    client = None
    try:
        client = Client(server)
        yield client
    finally:
        if client is not None:
            client.stack.close()
        server.close()


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Client]:
    with serving(tmp_path_factory.mktemp("open") / "project") as one:
        assert one.upload("walk.bvh", b"HIERARCHY")["type"] == "took"
        one.take("walk")
        yield one


def test_a_button_makes_a_motion_and_nothing_is_written_over(client: Client):
    walk = client.take("walk")
    source = client.server.project.folder / "files" / "walk.bvh"
    client.send(type="reading", take=walk["id"], values={"up": "-Y", "fps": 30, "swap_sides": True})
    client.until(lambda s: next(t for t in s["takes"] if t["id"] == walk["id"])["reading"])
    client.take("walk")
    client.send(type="line", take=walk["id"], action="mend", values={"path": "keep"})
    while (told := client.read())["type"] != "line":
        pass
    said = "poise doctor walk.bvh --fix --path keep --up=-Y --fps=30 --swap-sides -o 'walk mended.bvh'"
    assert told["line"] == said
    client.send(type="run", take=walk["id"], action="mend", values={"path": "keep"})
    made = client.take("walk mended")
    assert made["line"] == said and made["parent"] == walk["id"] and made["says"] == ["A note."]
    assert client.state["current"] == made["id"] and not client.state["jobs"]
    # A BVH says neither unit nor vertical: what came in decides how the result is read.
    assert made["reading"] == {"unit": "0.0254", "up": "Z"}
    client.send(type="run", take=walk["id"], action="mend", values={})
    client.take("walk mended 2")
    assert source.read_bytes() == b"HIERARCHY"
    assert client.upload("walk.bvh", b"HIERARCHY 2")["type"] == "took"
    assert source.read_bytes() == b"HIERARCHY"


def test_a_crash_loses_nothing_and_work_can_be_stopped(client: Client):
    walk = client.take("walk")
    client.send(type="run", take=walk["id"], action="body", values={"seed": 9})
    assert "ended without an answer (signal 9)" in client.event("refused")["text"]
    client.send(type="run", take=walk["id"], action="body", values={"seed": 60})
    job = client.until(lambda s: next((j for j in s["jobs"] if j["share"] == 0.4), None))
    assert job["text"] == "looking ahead, 40 % done, 0:01 left"
    # The frames simulated so far can be seen, in whole rows, from any of them on.
    client.until(lambda s: s["jobs"] and s["jobs"][0]["drawn"])

    def drawn(row: int) -> np.ndarray:
        where = f"http://{client.where}/drawn/{job['id']}/{row}?token=secret-word"
        with urllib.request.urlopen(where, timeout=10) as got:
            data = got.read()
        assert json.loads(data[4:28]) == {"parents": [-1, 0]}
        return np.frombuffer(data[28:], "<f4").reshape(-1, 7)

    # The first one is told before the last one is written.
    end = time.monotonic() + 10.0
    while len(drawn(0)) < 3 and time.monotonic() < end:
        time.sleep(0.05)
    for row, firsts in ((0, [0, 1, 2]), (2, [2]), (7, [])):
        rows = drawn(row)
        assert rows[:, 0].tolist() == firsts and (rows[:, 1] == 10 * rows[:, 0]).all()
    assert _status(client, f"/drawn/{job['id']}/0") == 401
    client.send(type="stop", job=job["id"])
    assert client.event("stopped")["text"] == "Give it a body was stopped; nothing was changed."
    assert not [t for t in client.state["takes"] if t["action"] == "body"]
    client.send(type="rests", take=walk["id"])
    assert client.event("rests")["boxes"][0]["kind"] == "seat"
    client.send(type="export", take=walk["id"], format=".glb")
    file = client.event("exported")
    assert file["text"].startswith("walk.glb lies in ")
    address = f"http://{client.where}/export/{file['file']}?token=secret-word"
    with urllib.request.urlopen(address, timeout=10) as got:
        assert got.headers["Content-Disposition"] == 'attachment; filename="walk.glb"'
        assert got.read().startswith(b"convert ")


def test_what_makes_no_sense_is_refused(client: Client):
    walk = client.take("walk")["id"]
    for message in (
        {"type": "run", "take": walk, "action": "format disk"},
        {"type": "run", "take": "../../etc", "action": "mend"},
        {"type": "run", "take": walk, "action": "mend", "values": {"path": "--force"}},
        {"type": "run", "take": walk, "action": "push", "values": {"force": "1; rm -rf /"}},
        {"type": "run", "take": walk, "action": "rig", "values": {"onto": "/etc/passwd"}},
        {"type": "run", "take": walk, "action": "range", "values": {"span": [0, 1]}},
        {"type": "run", "take": walk, "action": "mend", "values": [1]},
        {"type": "reading", "take": walk, "values": {"skeleton": "/etc/passwd"}},
        {"type": "reading", "take": walk, "values": {"unit": "$(id)"}},
        {"type": "export", "take": walk, "format": "../x"},
        {"type": "stop", "job": "1"},
        {"type": "unknown", "take": walk},
    ):
        client.send(**message)
        while (told := client.read())["type"] != "refused":
            assert told["type"] == "project"
        assert told["why"], message


def _status(client: Client, path: str, **headers: str) -> int:
    asked = urllib.request.Request(f"http://{client.where}{path}", headers=headers)
    try:
        with urllib.request.urlopen(asked, timeout=10) as got:
            return got.status
    except urllib.error.HTTPError as problem:
        return problem.code


def test_settings_of_any_kind_are_words_or_refused():
    """Whatever JSON a page sends for a setting, it becomes plain words or a sentence."""
    rng = np.random.default_rng(1)
    atoms: list[Any] = [None, True, -1, 3, 1e300, 0.5, "", "--force", "a=b", "left_hand", [], {}, [[]]]
    atoms += [[1, 2], ["left_hand", 1, 2], [["left_hand", 1, 2]], [["right_hand", 5, 0, 0, 1]], {"x": 1}]
    made = 0
    for action in ACTIONS.values():
        for _ in range(150):
            given = {
                f.name: atoms[rng.integers(len(atoms))] for f in action.fields if rng.random() < 0.4
            }
            try:
                words = words_of(action, given, 50, {"left_hand": Path("rig.bvh")}, Path("boxes.json"))
            except PoiseError:
                continue
            made += 1
            flags = [w for w in words if w.startswith("--")]
            known = {*action.words, *(f"--{f.flag or f.name}" for f in action.fields)}
            assert {w.partition("=")[0] for w in flags} <= known, given
    assert made > 200


def test_strangers_are_kept_out(client: Client):
    key = "token=secret-word"
    for path in PAGES:
        assert _status(client, path) == 401 and _status(client, f"{path}?{key}") == 200
    cookie = f"poise-{client.server.guard.port}=secret-word"
    assert _status(client, "/open.js", Cookie=cookie) == 200
    assert _status(client, "/open.js", Cookie=cookie.replace("word", "worm")) == 401
    assert _status(client, f"/?{key}", Origin="http://evil.example") == 403
    assert _status(client, f"/?{key}", Host="evil.example") == 403
    walk = client.take("walk")["id"]
    assert _status(client, f"/figure/{walk}?{key}") == 200
    for path in (
        "/figure/../project.json",
        "/figure/%2e%2e",
        f"/figure/{walk}/..",
        "/export/e999",
        "/drawn/999/0",
        "/drawn/1/../0",
        "/x",
    ):
        assert _status(client, f"{path}?{key}") == 404, path
    with pytest.raises(InvalidStatus, match="403"):
        connect(client.door("/open"), origin="http://evil.example")  # type: ignore[arg-type]
    with pytest.raises(InvalidStatus, match="401"):
        connect(f"ws://{client.where}/upload?name=x&size=1")


def test_uploads_have_a_limit_and_no_folders(client: Client):
    files = client.server.project.folder / "files"
    told = client.upload("huge.fbx", b"", LARGEST + 1)
    assert told["why"].startswith("huge.fbx is larger than 1 GB. Cut the motion")
    assert client.upload("x.bvh", b"12345", 3)["why"] == "x.bvh did not arrive whole. Drop it again."
    assert "needs a name" in client.upload("", b"1")["why"]
    assert client.upload("..%2F..%2Fevil.bvh", b"1")["type"] == "took"
    assert client.upload("walk.asf", b"1")["type"] == "companion"
    assert (files / "evil.bvh").exists() and not list(files.glob(".*"))
    assert [safe_file(n) for n in ("..", "/", "a\\b\n.bvh", "ä$(x).bvh")] == [
        "motion", "motion", "b.bvh", "__(x).bvh",
    ]  # fmt: skip


def test_odd_messages_do_not_end_the_server(client: Client):
    rng = np.random.default_rng(0)
    odd = [b"", b"{", b"[]", b'"x"', b'{"v": 1}', b'{"v": 1, "type": 3, "take": []}', b"\xff\xfe"]
    odd += [bytes(rng.integers(0, 256, 40).tolist()) for _ in range(20)]
    sent = 0
    while sent < 100_000:
        with (
            connect(client.door("/open"), close_timeout=0.1, max_queue=None) as one,
            suppress(ConnectionClosed),
        ):
            for k in range(20_000):
                one.send(odd[k % len(odd)])
                sent += 1
    with connect(client.door("/open")) as again:
        assert json.loads(again.recv(10))["type"] == "hello"


def test_a_project_opens_again(tmp_path: Path):
    with serving(tmp_path) as client:
        client.upload("run.bvh", b"HIERARCHY")
        client.send(type="run", take=client.take("run")["id"], action="body", values={})
        made = client.take("run with a body")
        assert made["simulated"]
    with serving(tmp_path) as client:
        assert client.take("run with a body") == made and client.state["current"] == made["id"]
        client.send(type="hide", take=made["id"])
        client.until(lambda s: len(s["takes"]) == 1)
    assert (tmp_path / "takes" / made["id"] / "result" / "simulated.bvh").exists()
    (tmp_path / "project.json").write_text("[]")
    with refused("not-a-project"):
        Project(tmp_path)


def test_a_process_waits_for_work_and_what_is_light_needs_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("poise.live.open.job_processes.IDLE_S", 0.0)
    told, over = list[PageJob](), threading.Event()

    def ended(job: PageJob) -> None:
        told.append(job)
        over.set()

    workers = Workers(tmp_path, (), lambda: None, lambda *_: None, ("json", "no_such_module"))
    try:
        ids = list[int]()
        for number in range(2):
            end = time.monotonic() + 20
            while workers.spare is None and time.monotonic() < end:
                time.sleep(0.02)
            assert workers.spare is not None
            ids.append(workers.spare)
            over.clear()
            argv = ["track", "-o", "result", *(("--seed", "9") if number else ())]
            workers.submit("work", toy_work, (argv,), ended)
            assert over.wait(20)
        # One that was killed took nothing with it; both ran where somebody waited.
        assert [(j.state, j.code) for j in told] == [("done", 0), ("crashed", -9)]
        assert len(set(ids)) == 2
        assert not any(_lives(number) for number in ids)
        while workers.spare is None:
            time.sleep(0.02)
        last = workers.spare
        assert _lives(last)
    finally:
        workers.close()
    assert not _lives(last)


def _lives(number: int) -> bool:
    try:
        os.kill(number, 0)
    except ProcessLookupError:
        return False
    return True


def test_a_file_is_looked_at_without_torch(tmp_path: Path) -> None:
    script = (
        "import sys; from pathlib import Path; from poise.cli.open import look; import importlib; "
        "from poise.cli.open import PRELOAD; [importlib.import_module(m) for m in PRELOAD]; "
        f"look({str(WALK)!r}, {{}}, {str(tmp_path)!r}, Path({str(tmp_path)!r})); "
        "assert not {'torch', 'mujoco'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", script], check=True, timeout=60, stdout=subprocess.DEVNULL)
    assert (tmp_path / "figure.bin").exists() and (tmp_path / "judged.json").exists()


def test_a_project_has_one_page_at_a_time(tmp_path: Path) -> None:
    with serving(tmp_path) as client:
        address = f"http://{client.where}/"
        job = tmp_path / ".jobs" / "kept"
        job.mkdir(parents=True)
        with refused("project-in-use", says=("is open already", f"process {os.getpid()}", address)):
            OpenServer(
                Project(tmp_path), Guard("127.0.0.1", 0, "w"), Runs(toy_work, toy_look, toy_rests)
            )
        # Nothing of the first one's was touched.
        assert job.exists() and client.upload("walk.bvh", b"HIERARCHY")["type"] == "took"
    assert not (tmp_path / LOCK).exists()
    # A process that was killed holds nobody off, whatever its file says.
    script = (
        "import sys; from pathlib import Path; from poise.live.open.project_lock import ProjectLock; "
        f"lock = ProjectLock(Path({str(tmp_path)!r})); print('held', flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None and other.stdout.readline() == "held\n"
        with refused("project-in-use", says=(f"process {other.pid}",)):
            ProjectLock(tmp_path)
        other.kill()
        other.wait(10)
    assert json.loads((tmp_path / LOCK).read_text())["process"] == other.pid
    with serving(tmp_path) as client:
        assert client.take("walk")
        assert json.loads((tmp_path / LOCK).read_text())["process"] == os.getpid()


def test_a_port_that_is_taken_leaves_the_project_free(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        guard = Guard("127.0.0.1", taken.getsockname()[1], "w")
        with refused("cannot-listen"):
            OpenServer(Project(tmp_path), guard, Runs(toy_work, toy_look, toy_rests))
    with serving(tmp_path) as client:
        assert client.state["takes"] == []


def _options(made: Callable[..., Any]) -> Iterator[tuple[str, Any]]:
    """The options of a verb with their defaults, by their flags."""
    for name, given in inspect.signature(made).parameters.items():
        if is_dataclass(given.default):
            yield from _options(type(given.default))
        else:
            yield name, given.default


def test_a_button_says_what_differs_from_the_command_line():
    """A setting that is not said is the command line's own default."""
    for action in ACTIONS.values():
        verb = import_module(f"poise.cli.{action.verb}")
        text = inspect.getsource(verb) + inspect.getsource(import_module("poise.cli.options"))
        known = dict(_options(options_of(verb)))
        for field in action.fields:
            flag = field.flag or field.name
            name = flag.removeprefix("no-").replace("-", "_")
            name = {"from": "start", "range": "span"}.get(name, name)
            default = known.get(name)
            assert name in known or name in text or name in DERIVED, flag
            if field.kind in ("number", "choice", "flag") and name in known and not field.always:
                same = default in (inspect.Parameter.empty, None, field.default)
                assert same, (action.name, field.name, default, field.default)


def test_settings_as_words():
    given = {
        "at": "chest", "force": 160.0, "start": 1.2, "direction": [-1, 0.5, 0], "hold_feet": False,
    }  # fmt: skip
    words = words_of(ACTIONS["push"], given, 86, {}, Path("boxes.json"))
    said = "--at chest --force 160 --from 1.2 --direction=-1,0.5,0 --no-hold-feet"
    assert " ".join(words) == said
    given = {"keyframes": [40, 0, 85], "touches": [["right_hand", 60, 0.2, 0.5, 1.2]]}
    words = words_of(ACTIONS["between"], given, 86, {}, Path("b"))
    assert " ".join(words) == "--keyframes 0,40,85 --touch right_hand:60:0.2,0.5,1.2"
    words = words_of(ACTIONS["rig"], {"maps": ["Arm=upperarm_l", "--x=y"]}, 86, {}, Path("b"))
    assert words == ["--map=Arm=upperarm_l", "--map=--x=y"]
    assert words_of(ACTIONS["rig"], {"hands": "place"}, 86, {}, Path("b")) == ["--hands", "place"]
    assert words_of(ACTIONS["cut"], {"frames": [5, 9]}, 86, {}, Path("b")) == ["--frames", "5-9"]
    words = words_of(ACTIONS["range"], {"span": [1.0, 2.5]}, 86, {}, Path("b"))
    assert words == ["--range=1-2.5", "--seed", "1"]
    with refused("out-of-range"):
        words_of(ACTIONS["push"], {"force": 1e9}, 86, {}, Path("b"))
    with refused("out-of-range"):
        words_of(ACTIONS["between"], {"keyframes": [0, 86]}, 86, {}, Path("b"))
    assert reading_words(reading_of({"up": "-Y", "fps": 29.97, "unit": "cm", "raw": False})) == [
        "--up=-Y", "--fps=29.97", "--unit=cm",
    ]  # fmt: skip
    assert all(suffix.startswith(".") for suffix in EXPORTS)


def test_a_result_in_sentences():
    score = {
        "help": {"force_mean_n": 0.0},
        "reference": {"foot_slide_mm_per_s": 54.2},
        "delivered": [{"delivered": {"sole_slide_mm_per_s": 11.4}}],
    }
    answer = {"result": {"sentence": "Tracked to its end.", "score": score}, "notes": ["More."]}
    assert sentences(ACTIONS["body"], answer) == [
        "Tracked to its end.", "Nothing helped the body: 0 N.",
        "Soles slide by 11 mm/s in what is written, the motion it follows by 54.", "More.",
    ]  # fmt: skip


def test_what_is_drawn_is_the_motion():
    clip = read_clip(WALK)
    data = figure_of(clip)
    (size,) = struct.unpack_from("<I", data)
    head = json.loads(data[4 : 4 + size])
    places = np.frombuffer(data[4 + size :], "<f4").reshape(clip.frames, -1, 3)
    assert head["joints"] == len(clip.skeleton) and head["fps"] == 30.0 and head["step"] == 1
    np.testing.assert_allclose(places[:, : head["joints"]], clip.positions(), atol=1e-5)
    # Tips stay as far from their joints as the file says.
    for k, (joint, end) in enumerate(e for e in clip.skeleton.ends if np.linalg.norm(e[1]) > 1e-6):
        way = np.linalg.norm(places[:, head["joints"] + k] - places[:, joint], axis=-1)
        np.testing.assert_allclose(way, np.linalg.norm(end), atol=1e-4)
        assert head["parents"][head["joints"] + k] == joint
    assert head["sides"][head["roles"]["left_foot"]] == "left"


def test_a_foot_that_slides_is_marked_where_it_does():
    clip = read_clip(WALK)
    slid = clip.root_pos.copy()
    slid[5:20, :2] += np.linspace(0, 1, 15)[:, None] * [0.0, 0.6]
    slid[20:, :2] += [0.0, 0.6]
    found = judged(clip.replaced(root_pos=slid))
    marks = [f for f in found["faults"] if f["kind"] == "foot slide"]
    assert marks and all(f["title"] == "slides while it stands" and f["repairable"] for f in marks)
    # Each is that of a foot that stood in some of those frames; the longest goes as far as the floor.
    assert all(f["start"] <= 20 and f["stop"] >= 5 for f in marks)
    assert 40 < max(f["size"] for f in marks) < 75 and {f["unit"] for f in marks} == {"cm"}
    assert found["judged"] and {g["what"] for g in found["guesses"]} >= {"up", "unit", "fps"}
    assert len(found["contacts"]) == 2


def test_a_second_page_takes_another_port(monkeypatch: pytest.MonkeyPatch):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        monkeypatch.setattr("poise.cli.open.PORT", port)
        assert _free("127.0.0.1", port) == 0
    assert _free("127.0.0.1", port) == port
    # One that was named is taken at its word.
    assert _free("127.0.0.1", 9) == 9
