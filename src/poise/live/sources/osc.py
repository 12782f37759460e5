"""Open Sound Control 1.0, as much of it as VMC sends: strict, bounded, and without surprises.

A datagram is a message or a bundle of them; every part is checked before it is used, and what is no
OSC is refused whole.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from poise.errors import PoiseError

#: Bytes of a datagram, bundles in one another, messages of a datagram, arguments of one.
MOST, DEPTH, MESSAGES, ARGUMENTS = 65_507, 4, 1024, 32
_BUNDLE = b"#bundle\0"


class Message(NamedTuple):
    """An address such as "/VMC/Ext/Bone/Pos", and its arguments: numbers, words, flags."""

    address: str
    arguments: tuple[int | float | str | bool, ...]


def messages(data: bytes) -> list[Message]:
    """The messages of a datagram in order.

    Raises:
        PoiseError: it is no OSC, or too large, too deep or too long.
    """
    if not data or len(data) > MOST or len(data) % 4:
        raise PoiseError("no OSC", "datagram")
    out = list[Message]()
    for message in _parts(data, DEPTH):
        out.append(message)
        if len(out) > MESSAGES:
            raise PoiseError("too many messages", "datagram")
    return out


def _parts(data: bytes, depth: int) -> Iterator[Message]:
    if not data.startswith(_BUNDLE):
        yield _message(data)
        return
    if depth == 0:
        raise PoiseError("too deep", "datagram")
    at = 16
    if len(data) < at:
        raise PoiseError("no OSC", "datagram")
    while at < len(data):
        if at + 4 > len(data):
            raise PoiseError("no OSC", "datagram")
        (size,) = struct.unpack_from(">i", data, at)
        at += 4
        if size <= 0 or size % 4 or at + size > len(data):
            raise PoiseError("no OSC", "datagram")
        yield from _parts(data[at : at + size], depth - 1)
        at += size


def _message(data: bytes) -> Message:
    address, at = _word(data, 0)
    tags, at = _word(data, at)
    if not address.startswith("/") or not tags.startswith(",") or len(tags) > ARGUMENTS + 1:
        raise PoiseError("no OSC", "datagram")
    out = list[int | float | str | bool]()
    for tag in tags[1:]:
        if tag in "if":
            if at + 4 > len(data):
                raise PoiseError("no OSC", "datagram")
            out.append(struct.unpack_from(">" + tag, data, at)[0])
            at += 4
        elif tag == "s":
            word, at = _word(data, at)
            out.append(word)
        elif tag in "TF":
            out.append(tag == "T")
        else:
            raise PoiseError("unknown argument", "datagram")
    if at != len(data):
        raise PoiseError("no OSC", "datagram")
    return Message(address, tuple(out))


def _word(data: bytes, at: int) -> tuple[str, int]:
    """A word that ends with 0, filled up with 0 to a multiple of 4, and where the next part begins."""
    end = data.find(b"\0", at)
    if end < 0:
        raise PoiseError("no OSC", "datagram")
    after = end + 4 - end % 4
    if after > len(data) or any(data[end:after]):
        raise PoiseError("no OSC", "datagram")
    try:
        return data[at:end].decode("utf-8"), after
    except UnicodeDecodeError:
        raise PoiseError("no OSC", "datagram") from None


def encoded(address: str, arguments: Sequence[int | float | str]) -> bytes:
    """A message as bytes."""
    tags, out = ",", b""
    for value in arguments:
        if isinstance(value, str):
            tags, out = tags + "s", out + _filled(value)
        elif isinstance(value, int):
            tags, out = tags + "i", out + struct.pack(">i", value)
        else:
            tags, out = tags + "f", out + struct.pack(">f", value)
    return _filled(address) + _filled(tags) + out


def bundled(parts: Sequence[bytes]) -> bytes:
    """Messages as a bundle that is due at once."""
    sized = b"".join(struct.pack(">i", len(p)) + p for p in parts)
    return _BUNDLE + struct.pack(">q", 1) + sized


def _filled(word: str) -> bytes:
    data = word.encode("utf-8") + b"\0"
    return data + bytes(-len(data) % 4)
