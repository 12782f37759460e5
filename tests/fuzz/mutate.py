"""Mutations that know how a file is built: lines and words, JSON, named arrays, chunks, bytes."""

from __future__ import annotations

import io
import json
import random
import re
import struct
import zipfile
import zlib
from collections.abc import Callable
from typing import Any

WORDS = (
    b"nan", b"inf", b"-inf", b"-1e308", b"1e400", b"1e-320", b"", b"{", b"}", b"-", b"0", b"-0", b"1e9",
    b"99999999999999999999", b"\xff", b"\0", b"1_0", b"0x10", b"null", b"[", b":", b",", b"\t", b'"',
    b"\xe2\x80\xae", b"\x1b[31m", b"\xef\xbb\xbf", b"x" * 300, b"_" * 5000, b"1" * 400, b"\r", b"\x0b",
    "\u0661".encode(), b"JOINT", b"End Site", b"CHANNELS 6", b"MOTION", b"root", b"begin", b"1e-9",
    b"2000", b"\\",
)  # fmt: skip
NUMBERS = (0, 1, -1, 2, 7, 127, 255, 256, 32767, 65535, 2**31 - 1, -(2**31), 2**53, 2**63 - 1)
VALUES: tuple[Any, ...] = (
    None, True, -1, 0, 1, 2**31, 1e308, -1e-308, 1e9, "", "x" * 500, "\x00", "\u202e", [], {}, [[]],
    [None], {"a": 1}, "nan", 0.5, 3, 99999,
)  # fmt: skip
_NUMBER = re.compile(rb"-?\d+\.?\d*(?:[eE][-+]?\d+)?")


#: What a mutation raises that does not suit the data.
_UNFIT = (
    ValueError, LookupError, RuntimeError, EOFError, OSError,
    struct.error, zlib.error, zipfile.BadZipFile,
)  # fmt: skip


def mutate(data: bytes, rng: random.Random) -> bytes:
    """One to three mutations that suit the data."""
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        kinds = [_bytes]
        if data[:4] == b"PK\x03\x04":
            kinds += [_archive] * 4
        elif data[:4] == b"glTF":
            kinds += [_glb] * 3
        elif data[:1] in (b"{", b"["):
            kinds += [_json] * 4 + [_lines]
        elif data[:6] == b"\x93NUMPY":
            kinds += [_header] * 2
        elif b"\0" not in data[:4000]:
            kinds += [_lines, _words, _words, _numbers, _numbers]
        try:
            data = rng.choice(kinds)(data, rng)[: 1 << 20]
        except (
            ValueError,
            KeyError,
            IndexError,
            struct.error,
            zipfile.BadZipFile,
            RuntimeError,
            EOFError,
            OSError,
            zlib.error,
        ):
            data = _bytes(data, rng)
    return data


def _bytes(data: bytes, rng: random.Random) -> bytes:
    """Bytes and little-endian numbers changed, cut, doubled, removed."""
    raw, kind = bytearray(data), rng.randrange(6)
    at = rng.randrange(len(raw) + 1)
    if kind == 0:
        return bytes(raw[:at])
    if kind == 1 and raw:
        for _ in range(rng.choice((1, 1, 2, 8))):
            raw[rng.randrange(len(raw))] = rng.choice((rng.randrange(256), 0, 255, 128))
    elif kind == 2:
        size = rng.choice((1, 2, 4, 8))
        # The first bytes hold the counts, where damage hurts most.
        at = rng.randrange(max(1, min(len(raw), rng.choice((64, 512, len(raw) + 1)))))
        raw[at : at + size] = (rng.choice(NUMBERS) % 256**size).to_bytes(size, "little")
    elif kind == 3:
        end = min(len(raw), at + rng.choice((1, 4, 64, 1000)))
        raw[at:at] = raw[at:end] * rng.choice((1, 1, 50))
    elif kind == 4:
        del raw[at : at + rng.choice((1, 4, 64, 1000))]
    else:
        raw[at:at] = rng.choice(WORDS)
    return bytes(raw)


def _lines(data: bytes, rng: random.Random) -> bytes:
    """Lines dropped, doubled, swapped, many times over."""
    lines = data.split(b"\n")
    i, k = rng.randrange(min(len(lines), rng.choice((8, 60, 10**6)))), rng.randrange(len(lines))
    kind = rng.randrange(5)
    if kind == 0:
        del lines[i]
    elif kind == 1:
        lines[i:i] = [lines[i]] * rng.choice((1, 1, 3, 700))
    elif kind == 2:
        lines[i], lines[k] = lines[k], lines[i]
    elif kind == 3:
        del lines[min(i, k) : max(i, k)]
    else:
        lines[i:i] = [rng.choice(WORDS)]
    return b"\n".join(lines)


def _words(data: bytes, rng: random.Random) -> bytes:
    """A word replaced by a tricky one, or by another of the file; one word everywhere."""
    parts = re.split(rb"([ \t\n,;:=\"]+)", data)
    i = 2 * rng.randrange((len(parts) + 1) // 2)
    other = rng.choice((rng.choice(WORDS), parts[2 * rng.randrange((len(parts) + 1) // 2)]))
    if rng.random() < 0.1 and parts[i]:
        return data.replace(parts[i], other[:50])
    parts[i] = other
    return b"".join(parts)


def _numbers(data: bytes, rng: random.Random) -> bytes:
    """A number of the file made another."""
    found = list(_NUMBER.finditer(data))
    some = rng.choice(found[: rng.choice((5, 40, 10**9))])
    old = float(some.group()[:50])
    new = rng.choice(
        (-old, old * 1e3, old * 1e-3, old + 1, old - 1, old * 1e9, float(rng.choice(NUMBERS)), 0.0, 1e-9)
    )
    whole = new == int(new) if abs(new) < 1e18 else False
    text = str(int(new)) if whole and rng.random() < 0.7 else repr(new)
    return data[: some.start()] + text.encode() + data[some.end() :]


def _json(data: bytes, rng: random.Random) -> bytes:
    """A value, a key or an item anywhere in the tree."""
    root = json.loads(data)
    spots: list[tuple[Any, Any]] = []
    stack = [root]
    while stack:
        node = stack.pop()
        keys = node.keys() if isinstance(node, dict) else range(len(node))
        for key in keys:
            spots.append((node, key))
            if isinstance(node[key], dict | list):
                stack.append(node[key])
    # Long lists of numbers would else hide all the rest.
    named = [s for s in spots if isinstance(s[0], dict)] or spots
    node, key = rng.choice(named if rng.random() < 0.7 else spots)
    kind = rng.randrange(5)
    if kind == 0:
        del node[key]
    elif kind == 1:
        other, there = rng.choice(spots)
        node[key] = other[there] if not isinstance(other[there], dict | list) else rng.choice(VALUES)
    elif kind == 2 and isinstance(node[key], int | float):
        node[key] = rng.choice((-node[key], node[key] * 1000, node[key] + 1, rng.choice(NUMBERS)))
    elif kind == 3 and isinstance(node[key], list) and node[key]:
        node[key] = node[key] * rng.choice((0, 2, 2, 50)) if len(node[key]) < 1000 else node[key][:1]
    else:
        node[key] = rng.choice(VALUES)
    return json.dumps(root).encode()


def _glb(data: bytes, rng: random.Random) -> bytes:
    """The JSON or the bytes of a GLB, wrapped soundly again."""
    size = struct.unpack_from("<I", data, 12)[0]
    text, rest = data[20 : 20 + size], data[20 + size :]
    if rng.random() < 0.8:
        text = _json(text.rstrip(b" "), rng)
    else:
        rest = rest[:8] + _bytes(rest[8:], rng)
    text += b" " * (-len(text) % 4)
    whole = struct.pack("<I4s", len(text), b"JSON") + text + rest
    return b"glTF" + struct.pack("<II", 2, 12 + len(whole)) + whole


def _header(data: bytes, rng: random.Random) -> bytes:
    """The header of a .npy: type, order, shape; or the bytes behind it."""
    size = struct.unpack_from("<H", data, 8)[0]
    header, body = data[10 : 10 + size], data[10 + size :]
    if rng.random() < 0.5:
        return data[: 10 + size] + _floats(body, rng)
    change: Callable[[bytes], bytes] = rng.choice(
        (
            lambda h: _numbers(h, rng),
            lambda h: re.sub(rb"'[<|>=][a-zA-Z]\d*'", rng.choice(TYPES), h, count=1),
            lambda h: re.sub(rb"\(.*?\)", rng.choice(SHAPES), h, count=1),
            lambda h: h.replace(b"False", b"True"),
            lambda h: _words(h, rng),
        )
    )
    header = change(header.rstrip()) + b"\n"
    return data[:8] + struct.pack("<H", len(header)) + header + body


NAMES = ("a.npy", "../x.npy", "\u202e.npy", "x" * 300 + ".npy", "poses")
TYPES = (b"'<f8'", b"'<f2'", b"'>f4'", b"'<i8'", b"'|b1'", b"'<U7'", b"'|S9'", b"'|O'", b"'<c16'",
         b"'<M8[s]'", b"'|V3'", b"'<f16'", b"'<U0'")  # fmt: skip
SHAPES = (b"()", b"(0,)", b"(1,)", b"(2,)", b"(3,0)", b"(1,1)", b"(99999999,3)", b"(-1,)", b"(7,3,4,1)",
          b"(1000000,66)")  # fmt: skip


def _floats(body: bytes, rng: random.Random) -> bytes:
    """One number of an array, or each, made another."""
    at = 8 * rng.randrange(max(1, len(body) // 8))
    value = rng.choice((float("nan"), float("inf"), 0.0, 1e300, -1.0, 1e-300, 1e9, 1e5, 0.001))
    if rng.random() < 0.2:
        return struct.pack("<d", value) * (len(body) // 8)
    return body[:at] + struct.pack("<d", value) + body[at + 8 :]


def _archive(data: bytes, rng: random.Random) -> bytes:
    """Members of a zip: changed within, dropped, renamed, doubled; packed soundly again."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = [(n, archive.read(n)) for n in archive.namelist()[:50]]
    i, kind = rng.randrange(len(members)), rng.randrange(8)
    name, content = members[i]
    if kind == 0:
        del members[i]
    elif kind == 1:
        members[i] = (rng.choice(members)[0], content)
    elif kind == 2:
        members[i] = (name, rng.choice(members)[1])
    elif kind == 3:
        members[i] = (
            rng.choice(NAMES),
            content,
        )
    elif kind == 4:
        members[i] = (name, _bytes(content, rng))
    else:
        members[i] = (name, _header(content, rng))
    buffer, seen = io.BytesIO(), set[str]()
    with zipfile.ZipFile(buffer, "w", rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as archive:
        for name, content in members:
            if name not in seen:
                archive.writestr(zipfile.ZipInfo(name), content)
            seen.add(name)
    return buffer.getvalue()
