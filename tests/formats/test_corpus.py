"""Odd files that the fuzzer has found: each is read as a sound clip or refused in one short sentence.

`python -m tests.fuzz --minutes 30 --keep FOLDER` finds more; `python -m tests.fuzz.corpus ARCHIVE...`
adds what they hold to the corpus.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from fuzz.corpus import ARCHIVE, Case, unpack
from fuzz.mutate import mutate
from fuzz.oracle import judge
from fuzz.seeds import NATIVE, seeds


@pytest.fixture(scope="module")
def corpus() -> list[Case]:
    return unpack()


def test_it_is_small_and_covers_every_format(corpus: list[Case]) -> None:
    counts = Counter(kind for kind, _, _ in corpus)
    assert counts.total() >= 2000 and ARCHIVE.stat().st_size < 500_000
    assert set(counts) >= {"bvh", "amc", "glb", "gltf", "deepmimic", "npz", "npy", "pkl", "trc", "mot",
                           "csv", "points"}  # fmt: skip
    assert sum(counts[kind] for kind in NATIVE) <= 60


@pytest.mark.parametrize("part", range(8))
def test_every_odd_file_is_read_or_refused(corpus: list[Case], tmp_path: Path, part: int) -> None:
    """In one process; parts, so that several can share the work."""
    bad = []
    for kind, name, files in corpus[part::8]:
        if kind in NATIVE:
            continue
        verdict = judge(tmp_path, name, files, seconds=60.0)
        if not verdict.sound:
            bad.append(f"{kind} {name}: {verdict.kind} {verdict.text}")
    assert bad == []


def test_odd_files_of_native_libraries(corpus: list[Case], tmp_path: Path) -> None:
    """Each in a process of its own, so that a few must do."""
    some: Counter[str] = Counter()
    for kind, name, files in corpus:
        if kind in NATIVE and some[kind] < 2:
            some[kind] += 1
            verdict = judge(tmp_path, name, files, seconds=60.0)
            assert verdict.sound, f"{kind} {name}: {verdict.kind} {verdict.text}"


def test_mutations_come_from_the_seed_alone(tmp_path: Path) -> None:
    import random

    for one in seeds(tmp_path):
        data = one.files[one.name]
        first, again = ([mutate(data, random.Random(k)) for k in range(20)] for _ in range(2))
        assert first == again and len(set(first)) > 10
