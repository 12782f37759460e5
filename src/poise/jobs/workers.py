"""The workers that do a fleet's jobs: processes on this machine, or the workers of a Ray cluster.

A job is a command line of this Python in a fresh process; what it prints goes into a file.
"""

from __future__ import annotations

import ctypes
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from poise.errors import PoiseError

#: Seconds that a job has to save its state and end when it is stopped.
GRACE_S = 60.0
#: Seconds that a Ray cluster has to answer.
ANSWER_S = 10.0
_POLL_S = 0.1
# A job is a run of its own, whatever group this process belongs to.
_NOT_FOR_JOBS = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE", "TORCHELASTIC_RUN_ID")


class WorkerExit(NamedTuple):
    """How a job's process ended."""

    name: str
    code: int
    """Its exit code; below 0 the signal that killed it."""
    said: str
    """Its error in one sentence, or an empty text."""


def prepare_child() -> Callable[[], None] | None:
    """What a job's process does first: it listens to SIGINT, which Ray and shells may have turned
    off, and on Linux it ends when the process that started it does."""
    if os.name != "posix":
        return None
    set_death_signal = 1
    prctl = ctypes.CDLL(None).prctl if sys.platform == "linux" else lambda *_: None

    def prepare() -> None:
        prctl(set_death_signal, signal.SIGKILL)
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])

    return prepare


def launch(command: Sequence[str], log: Path) -> subprocess.Popen[bytes]:
    """A job's process; Ctrl-C in the terminal does not reach it, `ask_to_stop` does."""
    env = {k: v for k, v in os.environ.items() if k not in _NOT_FOR_JOBS}
    # Ray sets it to the cores of its worker; Poise shares out its threads by itself.
    env.pop("OMP_NUM_THREADS", None)
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("ab") as file:
        return subprocess.Popen(
            [sys.executable, *command],
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=subprocess.STDOUT,
            env=env,
            start_new_session=True,
            preexec_fn=prepare_child(),
        )


def ask_to_stop(processes: Sequence[subprocess.Popen[bytes]], grace_s: float = GRACE_S) -> None:
    """Ctrl-C for all of them, and the end after `grace_s` seconds or a second Ctrl-C."""
    for process in processes:
        process.send_signal(signal.SIGINT)
    limit = time.monotonic() + grace_s
    try:
        while any(p.poll() is None for p in processes) and time.monotonic() < limit:
            time.sleep(_POLL_S)
    finally:
        for process in processes:
            process.kill()
            process.wait()


def error_in(log: Path, code: int) -> str:
    """The last `error: ...` that a job told, or how it ended."""
    if code == 0:
        return ""
    if code < 0:
        name = signal.Signals(-code).name if -code in set(signal.Signals) else str(-code)
        return f"its process was killed ({name})"
    try:
        lines = log.read_bytes()[-20_000:].decode(errors="replace").splitlines()
    except OSError:
        lines = []
    told = [line.removeprefix("error: ") for line in lines if line.startswith("error: ")]
    last = next((line.strip() for line in reversed(lines) if line.strip()), "it said nothing")
    return told[-1] if told else f"its process ended with code {code} ({last})"


class LocalWorkers:
    """Processes on this machine, which share its cores.

    Attributes:
        kind: what the table of results says of them.
        slots: jobs at the same time.
        threads: cores of each job.
    """

    kind = "this machine"

    def __init__(self, slots: int, threads: int):
        self.slots, self.threads = slots, threads
        self._running: dict[str, tuple[subprocess.Popen[bytes], Path]] = {}

    def start(self, name: str, command: Sequence[str], log: Path) -> int | None:
        """Runs Python with the arguments `command`; gives the process id if it is on this machine."""
        process = launch(command, log)
        self._running[name] = (process, log)
        return process.pid

    def ended(self) -> list[WorkerExit]:
        """The jobs that ended since the last call; waits a moment if there are none."""
        over = [(n, p, log) for n, (p, log) in self._running.items() if p.poll() is not None]
        for name, _, _ in over:
            del self._running[name]
        if not over:
            time.sleep(_POLL_S)
        return [WorkerExit(n, p.returncode, error_in(log, p.returncode)) for n, p, log in over]

    def stop(self) -> None:
        """Asks the running jobs to save and end, and waits until they have."""
        running, self._running = [p for p, _ in self._running.values()], {}
        ask_to_stop(running)


def run_in_ray(command: Sequence[str], log: str) -> tuple[int, str]:
    """A job from its start to its end, inside a Ray worker; when cancelled, the job saves first."""
    process = launch(command, Path(log))
    try:
        while process.poll() is None:
            time.sleep(_POLL_S)
    except KeyboardInterrupt:
        ask_to_stop([process])
    return process.returncode, error_in(Path(log), process.returncode)


class RayWorkers:
    """The workers of a Ray cluster, which must see the same folders as this machine; see `LocalWorkers`.

    Args:
        address: HOST:PORT or ray://HOST:PORT of a cluster, `auto` for the one that this machine
            belongs to, `local` for a new one on this machine.
        slots: jobs at the same time; 0 for one on each core.
        most: no more slots than jobs are needed.
    """

    kind = "ray"

    def __init__(self, address: str, slots: int, most: int):
        self._ray = ray = _import_ray()
        quiet = {"log_to_driver": False, "logging_level": "ERROR", "configure_logging": False}
        if address == "local":
            ray.init(address="local", include_dashboard=False, **quiet)
        else:
            _check_answer(address)
            ray.init(address=address, **quiet)
        cores = [int(n["Resources"].get("CPU", 0)) for n in ray.nodes() if n["Alive"]]
        self.slots = max(1, min(slots or sum(cores), most))
        # A job cannot have more cores than one machine has.
        self.threads = max(1, min(sum(cores) // self.slots, max(cores, default=1)))
        self._run = ray.remote(num_cpus=self.threads, max_retries=0)(run_in_ray)
        self._running: dict[Any, str] = {}

    def start(self, name: str, command: Sequence[str], log: Path) -> int | None:
        self._running[self._run.remote(list(command), str(log))] = name
        return None

    def ended(self) -> list[WorkerExit]:
        ready, _ = self._ray.wait(list(self._running), num_returns=1, timeout=5 * _POLL_S)
        out = []
        for ref in ready:
            name = self._running.pop(ref)
            try:
                out.append(WorkerExit(name, *self._ray.get(ref)))
            except self._ray.exceptions.RayError as problem:
                out.append(WorkerExit(name, 1, f"its Ray worker was lost ({type(problem).__name__})"))
        return out

    def stop(self) -> None:
        try:
            for ref in self._running:
                self._ray.cancel(ref, force=False)
            if self._running:
                self._ray.wait(list(self._running), num_returns=len(self._running), timeout=GRACE_S)
        finally:
            self._running = {}
            self._ray.shutdown()


Workers = LocalWorkers | RayWorkers


def make_workers(address: str | None, slots: int, jobs: int, cores: int) -> Workers:
    """Processes on this machine's `cores`, or with an `address` the workers of a Ray cluster.

    Raises:
        PoiseError: Ray is not installed, or nothing answers at the address.
    """
    jobs = max(1, jobs)
    if address is not None:
        return RayWorkers(address, slots, jobs)
    slots = min(slots or cores, jobs)
    return LocalWorkers(slots, max(1, cores // slots))


def _import_ray() -> Any:
    try:
        return import_module("ray")
    except ImportError:
        raise PoiseError(
            "--address needs Ray, which is not installed",
            hint="Install it with: pip install 'poise-motion[fleet]', or leave --address out",
            code="extra-missing",
        ) from None


def _check_answer(address: str) -> None:
    """Raises a `PoiseError` unless a Ray cluster answers, since Ray itself waits for minutes."""
    host, colon, port = address.removeprefix("ray://").rpartition(":")
    if address != "auto":
        if not colon or not host or not port.isdecimal() or not 0 < int(port) < 2**16:
            hint = "Write HOST:PORT, ray://HOST:PORT, auto or local"
            raise PoiseError(
                f"--address '{address}' is no address of a Ray cluster",
                hint=hint,
                code="address-malformed",
            )
        try:
            socket.create_connection((host, int(port)), timeout=ANSWER_S / 2).close()
        except OSError as problem:
            raise _no_answer(address, (problem.strerror or str(problem)).lower()) from None
    code = "import ray, sys; ray.init(address=sys.argv[1], log_to_driver=False)"
    try:
        done = subprocess.run(
            [sys.executable, "-c", code, address], capture_output=True, text=True, timeout=ANSWER_S
        )
    except subprocess.TimeoutExpired:
        reason = "the port is open, but no head node of Ray answers this machine"
        raise _no_answer(address, reason) from None
    if done.returncode:
        last = next((x.strip() for x in reversed(done.stderr.splitlines()) if x.strip()), "no reason")
        raise _no_answer(address, last[:200])


def _no_answer(address: str, reason: str) -> PoiseError:
    where = "Ray on this machine" if address == "auto" else f"Ray at {address}"
    hint = (
        "Start it with 'ray start --head', with the same RAY_AUTH_MODE and token as here, or leave "
        "--address out to use this machine alone"
    )
    return PoiseError(f"does not answer ({reason.rstrip('.')})", where, hint, code="no-answer")
