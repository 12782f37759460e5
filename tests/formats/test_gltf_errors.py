"""Damaged and hostile glTF files: each refusal is one sentence that names the file and the place."""

from __future__ import annotations

import json
import random
import struct
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from handmade_gltf_files import Gltf, put, turn, walker

from poise.errors import PoiseError
from poise.formats import gltf_file, read_clip
from poise.motion import describe
from refusals import refused

HUGE = 1 << 34


def refusal(path: Path, *told: Any) -> str:
    with refused(*told) if told else pytest.raises(PoiseError) as error:
        read_clip(path)
    message = str(error.value)
    assert message.startswith(str(path)) and "\n" not in message
    return message.removeprefix(str(path))


def changed(change: Callable[[dict[str, Any]], object]) -> Gltf:
    file, _ = walker()
    change(file.doc)
    return file


def accessor(index: int, **fields: object) -> Callable[[dict[str, Any]], object]:
    return lambda doc: doc["accessors"][index].update(fields)


def view(index: int, **fields: object) -> Callable[[dict[str, Any]], object]:
    return lambda doc: doc["bufferViews"][index].update(fields)


def node(index: int, **fields: object) -> Callable[[dict[str, Any]], object]:
    return lambda doc: doc["nodes"][index].update(fields)


def sampler(**fields: object) -> Callable[[dict[str, Any]], object]:
    return lambda doc: doc["animations"][0]["samplers"][0].update(fields)


# In the walker accessor 0 holds the hips' path, 1 its times, 2 the leg's turns, 3 their times.
CASES: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "no animation": (
        lambda d: d.update(animations=[]),
        ("no-animation",),
    ),
    "nothing moves": (
        lambda d: d["animations"][0].update(channels=[]),
        ("nothing-moves",),
    ),
    "no nodes": (
        lambda d: d.update(nodes=[]),
        ("no-joints",),
    ),
    "a cycle": (
        lambda d: (d["nodes"][4].update(children=[0]), d["scenes"][0].update(nodes=[])),
        ("hierarchy-cycle", "Hips"),
    ),
    "two parents": (node(1, children=[2, 4]), ("second-parent", "LeftFoot")),
    "a child that is not there": (
        node(4, children=[99]),
        ("index-outside", ("LeftFoot", "99", "5")),
    ),
    "an accessor out of bounds": (
        accessor(0, count=1000),
        ("data-out-of-bounds", ("walk", "12000", "84")),
    ),
    "a view out of bounds": (
        view(0, byteLength=100_000),
        ("data-out-of-bounds", ("walk", "100000", "252")),
    ),
    "a huge count": (
        accessor(1, count=10**9),
        ("clip-too-long", "40000000"),
    ),
    "a count that is no number": (
        accessor(1, count="many"),
        ("number-unusable", ("walk", "many")),
    ),
    "a wrong type": (
        accessor(0, type="VEC4"),
        ("wrong-type", ("walk", "VEC3", "VEC4")),
    ),
    "an unknown component": (
        accessor(0, componentType=7),
        ("wrong-type", ("walk", "7")),
    ),
    "an unknown interpolation": (
        sampler(interpolation="MAGIC"),
        ("unknown-choice", ("walk", "MAGIC")),
    ),
    "too few values": (
        accessor(0, count=6),
        ("count-differs", ("translation", "Hips")),
    ),
    "compressed": (
        view(0, extensions={"EXT_meshopt_compression": {}}),
        ("compressed", ("walk", "EXT_meshopt_compression")),
    ),
    "mirrored": (
        node(1, scale=[-1, 1, 1]),
        ("scale-unusable", ("Spine", "mirrors space")),
    ),
    "a matrix of words": (
        node(1, matrix=["a"] * 16),
        ("number-unusable", ("Spine", "matrix")),
    ),
    "glTF 1": (
        lambda d: d.update(asset={"version": "1.0"}),
        ("version-unsupported", "1.0"),
    ),
    "no version": (
        lambda d: d.update(asset={"version": 2}),
        ("part-missing",),
    ),
    "nodes that are no list": (lambda d: d.update(nodes={}), ("not-a-list", "nodes")),
}


@pytest.mark.parametrize("case", CASES)
def test_refusals(tmp_path: Path, case: str) -> None:
    change, message = CASES[case]
    file = changed(change)
    refusal(put(tmp_path, "a.glb", file), *message)
    if case != "a view out of bounds":
        refusal(put(tmp_path, "a.gltf", file), *message)


def test_values_that_are_no_numbers_are_named(tmp_path: Path) -> None:
    file, at = walker()
    turns = np.array([turn("x", 5 * k) for k in range(7)])
    turns[4, 1] = np.nan
    animation = file.doc["animations"][0]
    file.channel(animation, at["Head"], "rotation", [k / 30 for k in range(7)], turns)
    refusal(put(tmp_path, "a.glb", file), "number-unusable", ("rotation", "Head", "0.1333"))
    turns[4] = 0
    file, at = walker()
    file.channel(file.doc["animations"][0], at["Head"], "rotation", [k / 30 for k in range(7)], turns)
    refusal(put(tmp_path, "a.glb", file), "not-a-rotation", ("Head", "4", "0.1333"))
    for times, message in (
        ([0, 0.1, 0.05], "goes back in time at key 2 (0.05 s)"),
        ([0, np.nan, 0.1], "has no usable time at key 1"),
    ):
        file, at = walker()
        file.channel(file.doc["animations"][0], at["Head"], "rotation", times, turns[:3])
        assert refusal(put(tmp_path, "a.glb", file)) == f": channel 2 of animation 'walk' {message}"


def test_containers_that_are_cut_or_lie(tmp_path: Path) -> None:
    good = walker()[0].glb()
    path = tmp_path / "a.glb"

    def message(data: bytes) -> str:
        path.write_bytes(data)
        return refusal(path)

    cut = "The file seems cut off"
    assert message(good[:15]) == f": a GLB file needs at least 20 bytes, this has 15. {cut}"
    assert message(good[:-9]) == (
        f": the GLB header states {len(good)} bytes, but {len(good) - 9} are there. {cut}"
    )
    version = good[:4] + struct.pack("<I", 1) + good[8:]
    assert message(version) == ": this is GLB version 1. Export it as glTF 2.0"
    long = good[:12] + struct.pack("<I", 10**9) + good[16:]
    left = len(good) - 20
    assert message(long) == f": the chunk at byte 12 states 1000000000 bytes, but {left} are left. {cut}"
    kind = good[:16] + b"BIN\0" + good[20:]
    assert message(kind) == ": the first chunk of the GLB is not JSON"
    assert message(b"\1\2\3") == ": this is no glTF: it starts with neither 'glTF' nor '{'"
    size = struct.unpack_from("<I", good, 12)[0]
    alone = b"glTF" + struct.pack("<II", 2, 20 + size) + good[12 : 20 + size]
    assert message(alone) == ": buffer 0 has neither an address nor a GLB chunk"
    path.write_bytes(good)
    assert read_clip(path).frames == 7


@pytest.mark.parametrize(
    ("uri", "message"),
    [
        ("none.bin", ": its buffer file 'none.bin' is missing. Put the buffer beside the file"),
        (
            "https://example.org/a.bin",
            ": buffer 0 lies at 'https://example.org/a.bin', and Poise fetches nothing from elsewhere. "
            "Save it with its buffers embedded (.glb)",
        ),
        (
            "file:///etc/passwd",
            ": buffer 0 lies at 'file:///etc/passwd', and Poise fetches nothing from elsewhere. "
            "Save it with its buffers embedded (.glb)",
        ),
        *(
            (
                uri,
                f": buffer 0 names '{shown}', which lies outside the file's folder. "
                "Put the buffer beside the file",
            )
            for uri, shown in (
                ("../secret.bin", "../secret.bin"),
                ("%2e%2e/secret.bin", "../secret.bin"),
                ("/etc/passwd", "/etc/passwd"),
                ("link/secret.bin", "link/secret.bin"),
            )
        ),
        ("data:text/plain,abc", ": the embedded buffer 0 is not base64 of a usable size"),
        ("data:;base64,a*b=", ": the embedded buffer 0 is not valid base64. The file seems cut off"),
        (
            "data:;base64,AAAA",
            ": buffer 0 has 3 bytes, but the document states 252. The file seems cut off",
        ),
    ],
)
def test_addresses_of_buffers(tmp_path: Path, uri: str, message: str) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    (tmp_path / "secret.bin").write_bytes(bytes(1000))
    (folder / "link").symlink_to(tmp_path)
    path = folder / "a.gltf"
    path.write_text(walker()[0].gltf(uri))
    assert refusal(path) == message


def test_small_files_cannot_ask_for_endless_work(tmp_path: Path) -> None:
    """Many channels over the same keys, far times, many objects, deep nesting: refused in no time."""
    start = time.perf_counter()
    file, at = walker()
    times = file.accessor([0.0, 0.001, 90_000_000.0])
    file.doc["animations"][0]["samplers"].append(
        {"input": times, "output": file.accessor([turn("x", 0)] * 3)}
    )
    file.doc["animations"][0]["channels"].append(
        {"sampler": 2, "target": {"node": at["Head"], "path": "rotation"}}
    )
    refusal(put(tmp_path, "a.glb", file), "clip-too-long")
    file = changed(lambda d: d.update(nodes=[{} for _ in range(gltf_file.MAX_OBJECTS + 1)]))
    refusal(put(tmp_path, "b.glb", file), "over-limit", ("nodes", "100001", "100000"))
    path = tmp_path / "c.gltf"
    path.write_text('{"asset": {"version": "2.0"}, "nodes": ' + "[" * 100_000)
    refusal(path, "bad-json")
    # A chain of nodes, and many animated ones.
    deep: list[dict[str, Any]] = [{"name": f"n{i}", "children": [i + 1]} for i in range(50_000)]
    file = changed(lambda d: d.update(nodes=[*deep, {"name": "end"}], skins=[]))
    file.doc["animations"][0]["channels"] = [{"sampler": 1, "target": {"node": 0, "path": "rotation"}}]
    refusal(put(tmp_path, "d.glb", file), "nested-too-deep", "50000")
    flat: list[dict[str, Any]] = [{"name": "n0", "children": list(range(1, 9_000))}]
    file = changed(lambda d: d.update(nodes=flat + [{} for _ in range(8_999)], skins=[]))
    file.doc["animations"][0]["channels"] = [
        {"sampler": 1, "target": {"node": i, "path": "rotation"}} for i in range(9_000)
    ]
    refusal(put(tmp_path, "e.glb", file), "too-many-joints", ("9000", "1500"))
    file.doc["animations"][0]["channels"] *= 2
    refusal(put(tmp_path, "f.glb", file), "over-limit", ("channels", "18000", "10000"))
    assert time.perf_counter() - start < 30.0


def mutated(file: Gltf, rng: random.Random) -> bytes:
    """A document with one to three random changes: odd values, lost keys, flipped bytes."""
    tricky = [
        None,
        -1,
        0,
        3,
        10**6,
        HUGE,
        1.5,
        "x",
        "",
        [],
        {},
        [1],
        {"a": 1},
        True,
        float("inf"),
        "LINEAR",
    ]
    doc = json.loads(json.dumps(file.doc))
    made = Gltf()
    made.doc, made.data = doc, bytearray(file.data)
    for _ in range(rng.randint(1, 3)):
        spot: Any = doc
        while True:
            keys = list(spot) if isinstance(spot, dict) else list(range(len(spot)))
            if not keys:
                break
            key = rng.choice(keys)
            if isinstance(spot[key], dict | list) and rng.random() < 0.85:
                spot = spot[key]
                continue
            if isinstance(spot, dict) and rng.random() < 0.2:
                del spot[key]
            else:
                spot[key] = rng.choice(tricky)
            break
    if rng.random() < 0.3:
        made.data[rng.randrange(len(made.data))] = rng.randrange(256)
    data = bytearray(made.glb() if rng.random() < 0.5 else made.gltf().encode())
    if rng.random() < 0.2:
        data[rng.randrange(len(data))] = rng.randrange(256)
    if rng.random() < 0.1:
        del data[rng.randrange(len(data)) :]
    return bytes(data) or b" "


def test_damaged_files(tmp_path: Path) -> None:
    """Only a sound clip or a refusal that names the file may come out, and soon."""
    rng = random.Random(5)
    file, at = walker()
    file.doc["nodes"][at["Spine"]].update(scale=[1, 1, 1], rotation=[0, 0, 0, 1])
    file.doc["nodes"][at["Head"]]["matrix"] = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0.35, 0, 1]
    sparse = {
        "count": 1,
        "indices": {"bufferView": file.view(b"\2"), "componentType": 5121},
        "values": {"bufferView": file.view(np.zeros(3, "<f4").tobytes())},
    }
    file.doc["accessors"][0]["sparse"] = sparse
    file.doc["animations"][0]["extras"] = {"poise": {"fps": 30.0, "frame_time": 1 / 30, "cyclic": False}}
    file.doc["nodes"][0]["extras"] = {"poise_ends": [[0, 0.1, 0]]}
    read = 0
    for _ in range(400):
        path = tmp_path / "a.glb"
        path.write_bytes(mutated(file, rng))
        start = time.perf_counter()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                clip = read_clip(path)
                facts = describe(clip)
            assert np.isfinite(clip.positions()).all() and facts["height_m"] > 0
            read += 1
        except PoiseError as error:
            message = str(error)
            assert message.startswith(str(path)) and "\n" not in message and len(message) < 600, message
            assert all(c.isprintable() for c in message), message
        assert time.perf_counter() - start < 5.0
    assert 20 < read < 380


def test_an_address_too_long_for_any_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.gltf").write_text(walker()[0].gltf("x" * 5000))
    refusal(tmp_path / "a.gltf", "address-malformed")
    (tmp_path / "a.gltf").write_text(walker()[0].gltf("x" * 300))
    refusal(tmp_path / "a.gltf", "address-malformed")
