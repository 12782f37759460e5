"""Damages sound files and reads them, until the time is over.

python -m tests.fuzz --minutes 30 --seed 1 --keep odd

A file is kept where something is wrong, and the first few of each new sentence or place. Reading happens
in a process of its own, under a limit of memory; a crash, a hang and a hunger are told as what they are.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import random
import re
import tempfile
import time
from collections import Counter
from multiprocessing.connection import Connection
from pathlib import Path

from .corpus import Case, hash_of, pack
from .mutate import mutate
from .oracle import Verdict, judge
from .seeds import NATIVE, Seed, seeds

#: Bytes that reading a file may take beside four times its size, and seconds until it is a hang.
BYTES, HANG = 200 << 20, 60.0
#: Kept files of one sentence.
SAME = 3
#: Every so many files that were read are written and read again.
AGAIN = 5


def work(pipe: Connection) -> None:
    """Reads what comes through the pipe; answers with a verdict and the peak of memory."""
    try:
        import resource
    except ImportError:
        resource = None  # type: ignore[assignment]
    else:
        now = (
            int(Path("/proc/self/statm").read_text().split()[0]) * 4096
            if Path("/proc/self/statm").exists()
            else 4 << 30
        )
        resource.setrlimit(resource.RLIMIT_AS, (now + (2 << 30),) * 2)
    with tempfile.TemporaryDirectory() as folder:
        while (case := pipe.recv()) is not None:
            (name, files), again = case
            before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss if resource else 0
            verdict = judge(Path(folder), name, files, again)
            after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss if resource else 0
            if (after - before) * 1024 > BYTES + 4 * sum(map(len, files.values())):
                verdict = Verdict("memory", f"{(after - before) / 1024:.0f} MB")
            pipe.send((verdict.kind, verdict.text))


def _address_space() -> int:
    """Bytes that this process has reserved so far; a generous guess where that cannot be told."""
    told = Path("/proc/self/statm")
    return int(told.read_text().split()[0]) * 4096 if told.exists() else 8 << 30


class Worker:
    """The process that reads, started again after a crash."""

    def __init__(self) -> None:
        self.context = multiprocessing.get_context("fork")
        self.start()

    def start(self) -> None:
        self.pipe, other = self.context.Pipe()
        self.process = self.context.Process(target=work, args=(other,), daemon=True)
        self.process.start()
        other.close()

    def judge(self, name: str, files: dict[str, bytes], again: bool) -> Verdict:
        """The verdict; "crash" or "hang" where none came."""
        try:
            self.pipe.send(((name, files), again))
            if self.pipe.poll(HANG):
                return Verdict(*self.pipe.recv())
            verdict = Verdict("hang", f"{HANG:.0f} s")
        except (EOFError, OSError):
            self.process.join(5)
            verdict = Verdict("crash", f"exit code {self.process.exitcode}")
        self.process.kill()
        self.process.join()
        self.start()
        return verdict


def key_of(kind: str, verdict: Verdict) -> str:
    """What tells one outcome from another: the sentence without its values."""
    text = re.sub(r"'[^']*'|[-+]?\d[\d.e+-]*|nan|inf", "#", verdict.text)
    return f"{kind} {verdict.kind} {text[:80]}"


def fuzz(
    sound: list[Seed], minutes: float, seed: int, most: int | None = None
) -> tuple[Counter[str], dict]:
    """Counts by format and verdict, and the kept cases by outcome."""
    rng, worker, counts, kept = random.Random(seed), Worker(), Counter[str](), dict[str, list[Case]]()
    end, tried = time.monotonic() + 60 * minutes, 0
    odd: dict[str, str] = {}
    parents: dict[str, list[dict[str, bytes]]] = {s.name: [s.files] for s in sound}
    while time.monotonic() < end and tried != most:
        one = rng.choice(sound)
        # What was found before is damaged further.
        files = dict(rng.choice(parents[one.name]))
        victim = rng.choice(list(files))
        files[victim] = mutate(files[victim], rng)
        verdict = worker.judge(one.name, files, tried % AGAIN == 0)
        tried += 1
        counts[f"{one.format} {verdict.kind}"] += 1
        key = key_of(one.format, verdict)
        cases = kept.setdefault(key, [])
        if not verdict.sound and key not in odd:
            odd[key] = verdict.text
            print(f"{tried}: {key}\n    {verdict.text}", flush=True)
        if len(cases) < (SAME if verdict.kind == "refused" else 40):
            cases.append((one.format, one.name, files))
            if verdict.sound and sum(map(len, files.values())) < 20_000:
                parents[one.name].append(files)
        if tried % 2000 == 0:
            left = (end - time.monotonic()) / 60
            print(f"{tried:,} files, {len(kept)} outcomes, {left:.0f} minutes left", flush=True)
    worker.process.kill()
    return counts, kept


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.fuzz", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("--minutes", type=float, default=1.0)
    parser.add_argument("--formats", nargs="+", help="by default all but those read by native libraries")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, help="folder for odd files, as an archive and one by one")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        every = seeds(Path(folder))
    known = sorted({s.format for s in every})
    if args.formats and (wrong := set(args.formats) - set(known)):
        parser.error(f"no such format: {', '.join(sorted(wrong))}; there are {', '.join(known)}")
    sound = [s for s in every if s.format in (args.formats or set(known) - set(NATIVE))]
    counts, kept = fuzz(sound, args.minutes, args.seed)
    print(json.dumps({"files": counts.total(), "outcomes": dict(sorted(counts.items()))}, indent=1))
    if args.keep is not None:
        args.keep.mkdir(parents=True, exist_ok=True)
        small = (c for some in kept.values() for c in some if sum(map(len, c[2].values())) < 50_000)
        cases = {hash_of(c[2]): c for c in small}
        count = pack(cases.values(), args.keep / f"kept_{args.seed}.tar.xz")
        print(f"{count} files are kept in {args.keep}")


if __name__ == "__main__":
    main()
