"""Damaged motion files: only a valid clip or a refusal that names the file may come out."""

from __future__ import annotations

import random
import time
import warnings
from pathlib import Path

import numpy as np
import pytest
from handmade_motion_files import ASF, amc_text, bvh_text, deepmimic_text

from poise.errors import PoiseError
from poise.formats import read_clip
from poise.motion import describe

MUTATIONS = 1000
TRICKY = (
    b"nan", b"inf", b"-1e308", b"1e400", b"", b"{", b"}", b"-", b"0", b"99999999999999999999", b"\xff",
    b"\0", b"1_0", b"JOINT", b"End Site", b"CHANNELS 6", b"MOTION", b":", b"null", b"[", b"root",
    b"begin",
)  # fmt: skip


def mutate(data: bytes, rng: random.Random) -> bytes:
    """One to three of: cut off, flipped bytes, a line dropped, doubled or swapped, a word replaced."""
    for _ in range(rng.randint(1, 3)):
        kind = rng.randrange(6)
        lines = data.split(b"\n")
        # The first lines hold the hierarchy, where damage hurts most.
        i = rng.randrange(min(len(lines), rng.choice((8, 60, len(lines)))))
        if kind == 0:
            data = data[: rng.randrange(len(data) + 1)]
        elif kind == 1:
            raw = bytearray(data)
            for _ in range(rng.randint(1, 4) if raw else 0):
                raw[rng.randrange(len(raw))] = rng.choice((rng.randrange(256), rng.randrange(32, 127)))
            data = bytes(raw)
        elif kind == 2:
            data = b"\n".join(lines[:i] + lines[i + 1 :])
        elif kind == 3:
            data = b"\n".join(lines[: i + 1] + lines[i:])
        elif kind == 4:
            k = rng.randrange(len(lines))
            lines[i], lines[k] = lines[k], lines[i]
            data = b"\n".join(lines)
        else:
            words = lines[i].split(b" ")
            words[rng.randrange(len(words))] = rng.choice(TRICKY)
            lines[i] = b" ".join(words)
            data = b"\n".join(lines)
    return data


def trimmed(path: Path, lines: int) -> bytes:
    return b"\n".join(path.read_bytes().splitlines()[:lines]) + b"\n"


def try_one(folder: Path, name: str, files: dict[str, bytes]) -> bool:
    """Whether the file was read; any outcome but a sound clip or a proper refusal fails."""
    for other, data in files.items():
        (folder / other).write_bytes(data)
    start = time.perf_counter()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            clip = read_clip(folder / name)
            facts = describe(clip)
        assert np.isfinite(clip.positions()).all() and facts["frames"] >= 2 and facts["height_m"] > 0
        return True
    except PoiseError as error:
        message = str(error)
        assert any(message.startswith(str(folder / other)) for other in files), message
        assert "\n" not in message and len(message) < 600, message
        assert all(c.isprintable() for c in message), message
        return False
    finally:
        assert time.perf_counter() - start < 5.0


def fuzz(folder: Path, samples: list[tuple[str, dict[str, bytes]]], count: int, seed: int) -> int:
    rng = random.Random(seed)
    read = 0
    for _ in range(count):
        name, files = rng.choice(samples)
        victim = rng.choice(list(files))
        read += try_one(folder, name, {**files, victim: mutate(files[victim], rng)})
    return read


def handmade() -> list[tuple[str, dict[str, bytes]]]:
    return [
        ("a.bvh", {"a.bvh": bvh_text().encode()}),
        ("7_01.amc", {"7.asf": ASF.encode(), "7_01.amc": amc_text().encode()}),
        ("a.txt", {"a.txt": deepmimic_text().encode()}),
    ]


def test_damaged_handmade_files(tmp_path: Path) -> None:
    for name, files in handmade():
        assert try_one(tmp_path, name, files)
    read = fuzz(tmp_path, handmade(), MUTATIONS, seed=1)
    assert 0 < read < MUTATIONS


def test_damaged_real_files(data_dir: Path, tmp_path: Path) -> None:
    samples: list[tuple[str, dict[str, bytes]]] = []
    for path in (
        "cmu_bvh/acrnn_salsa/10.bvh",
        "cmu_bvh/ad/heiansyodan.bvh",
        "other/bandai_bvh/dataset-2_walk_active_005.bvh",
        "other/mass_bvh/walk.bvh",
        "lafan1_bvh/walk4_subject1.bvh",
    ):
        head, _, rows = (data_dir / path).read_bytes().partition(b"MOTION")
        lines = rows.splitlines()
        data = b"\n".join([*head.splitlines(), b"MOTION", b"Frames: 12", *lines[2:15]]) + b"\n"
        samples.append(("r.bvh", {"r.bvh": data}))
    for folder, stem, take in (("02", "02", "02_01"), ("usc", "135-martialArts", "135_06-martialArts")):
        skeleton = (data_dir / f"cmu_amc/{folder}/{stem}.asf").read_bytes()
        motion = trimmed(data_dir / f"cmu_amc/{folder}/{take}.amc", 3 + 30 * 10)
        samples.append((f"{take}.amc", {f"{stem}.asf": skeleton, f"{take}.amc": motion}))
    text = (data_dir / "deepmimic_txt/humanoid3d_run.txt").read_bytes()
    samples.append(("r.txt", {"r.txt": text}))
    for i, (name, files) in enumerate(samples):
        folder = tmp_path / str(i)
        folder.mkdir()
        assert try_one(folder, name, files), name
        assert fuzz(folder, [(name, files)], MUTATIONS // len(samples), seed=2 + i) < MUTATIONS


@pytest.mark.parametrize("seed", range(20))
def test_noise_is_refused(tmp_path: Path, seed: int) -> None:
    noise = random.Random(seed).randbytes(5000)
    for name in ("a.bvh", "7_01.amc", "a.txt"):
        files = {name: noise}
        if name.endswith("amc"):
            files["7.asf"] = noise if seed % 2 else ASF.encode()
        assert not try_one(tmp_path, name, files)
