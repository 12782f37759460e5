"""Fleets of processes: all jobs end, killed ones are tried again, failed ones named, Ctrl-C saves."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from fleet_jobs import job, tries

from poise.jobs.fleet import FLEET_FILE, combinations, read_table, run_fleet
from poise.jobs.workers import LocalWorkers, error_in, launch, make_workers
from refusals import refused

pytestmark = pytest.mark.skipif(os.name != "posix", reason="signals")


def states(folder: Path) -> dict[str, str]:
    return {name: r.state for name, r in read_table(folder).items()}


def test_six_jobs_with_a_killed_worker_complete(tmp_path: Path) -> None:
    jobs = [job(tmp_path, f"clip{k}", "die" if k == 2 else "work") for k in range(6)]
    events: list[tuple[str, str]] = []
    workers = make_workers(None, 3, len(jobs), cores=6)
    assert (workers.slots, workers.threads) == (3, 2)
    result = run_fleet(jobs, tmp_path, workers, on_event=lambda e, r: events.append((e, r.name)))
    assert result.count("done") == 6 and not result.interrupted
    assert events.count(("again", "clip2")) == 1 and tries(tmp_path, "clip2") == 2
    assert all(tries(tmp_path, f"clip{k}") == 1 for k in (0, 1, 3, 4, 5))
    table = json.loads((tmp_path / FLEET_FILE).read_text())
    assert [j["name"] for j in table["jobs"]] == [j.name for j in jobs]
    entry = table["jobs"][2]
    assert entry["attempts"] == 2 and entry["score"]["succ"] == 0.5 and "per_clip" not in entry["score"]
    assert entry["seconds"] > 0 and entry["pid"] is None and entry["error"] == ""
    assert table["workers"] == "this machine" and table["threads"] == 2


def test_done_jobs_are_skipped_until_their_command_changes(tmp_path: Path) -> None:
    jobs = [job(tmp_path, "a"), job(tmp_path, "b")]
    run_fleet(jobs, tmp_path, LocalWorkers(2, 1))
    events: list[str] = []
    run_fleet(jobs, tmp_path, LocalWorkers(2, 1), on_event=lambda e, r: events.append(e))
    assert events == ["skipped", "skipped"] and tries(tmp_path, "a") == 1
    (tmp_path / "a" / "score.json").unlink()
    run_fleet([jobs[0], job(tmp_path, "b", "other")], tmp_path, LocalWorkers(2, 1))
    assert tries(tmp_path, "a") == 2 and tries(tmp_path, "b") == 2
    assert set(states(tmp_path).values()) == {"done"}


def test_failed_jobs_are_tried_thrice_and_named(tmp_path: Path) -> None:
    modes = ("refuse", "crash", "forget", "work")
    result = run_fleet([job(tmp_path, m, m) for m in modes], tmp_path, LocalWorkers(4, 1), retries=2)
    by_name = {r.name: r for r in result.records}
    assert [by_name[m].state for m in modes] == ["failed", "failed", "failed", "done"]
    assert by_name["refuse"].error == "walk.bvh: the clip is too short. Give a longer one"
    assert "code 1 (RuntimeError: no luck)" in by_name["crash"].error
    assert "cannot be seen here" in by_name["forget"].error
    assert [tries(tmp_path, m) for m in modes] == [3, 3, 3, 1]
    # Another run of the fleet gives the failed ones another chance.
    run_fleet([job(tmp_path, "refuse", "refuse")], tmp_path, LocalWorkers(1, 1), retries=0)
    assert tries(tmp_path, "refuse") == 4


def test_ctrl_c_lets_jobs_save_and_the_fleet_goes_on(tmp_path: Path) -> None:
    jobs = [job(tmp_path, "quick"), job(tmp_path, "slow", "hang"), job(tmp_path, "never")]

    def press(event: str, record: object) -> None:
        if event == "started" and tries(tmp_path, "quick"):
            deadline = time.monotonic() + 20
            while not tries(tmp_path, "slow") and time.monotonic() < deadline:
                time.sleep(0.02)
            time.sleep(0.2)
            raise KeyboardInterrupt

    result = run_fleet(jobs, tmp_path, LocalWorkers(1, 1), on_event=press)
    assert result.interrupted and (tmp_path / "slow" / "saved").exists()
    assert states(tmp_path) == {"quick": "done", "slow": "waiting", "never": "waiting"}
    result = run_fleet(jobs, tmp_path, LocalWorkers(1, 1))
    assert result.count("done") == 3 and tries(tmp_path, "quick") == 1


@pytest.mark.skipif(sys.platform != "linux", reason="death signals are Linux's")
def test_jobs_end_with_the_fleet(tmp_path: Path) -> None:
    code = """
import sys, time
from pathlib import Path
from poise.jobs.workers import launch
print(launch(["-c", "import time; time.sleep(60)"], Path(sys.argv[1])).pid, flush=True)
time.sleep(60)
"""
    command = [sys.executable, "-c", code, str(tmp_path / "log")]
    parent = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    parent.kill()
    parent.wait()
    parent.stdout.close()
    deadline = time.monotonic() + 10
    while _alive(child) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not _alive(child)


def _alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] not in "ZX"
    except FileNotFoundError:
        return False


def test_errors_are_one_sentence(tmp_path: Path) -> None:
    process = launch(
        ["-c", "print('error: one'); print('error: two'); raise SystemExit(2)"], tmp_path / "l"
    )
    assert process.wait() == 2 and error_in(tmp_path / "l", 2) == "two"
    assert error_in(tmp_path / "none", 1) == "its process ended with code 1 (it said nothing)"
    assert error_in(tmp_path / "l", -9) == "its process was killed (SIGKILL)" and not error_in(
        tmp_path, 0
    )
    with refused("name-repeated"):
        run_fleet([job(tmp_path, "a")] * 2, tmp_path, LocalWorkers(1, 1))
    (tmp_path / FLEET_FILE).write_text('{"format": 7}')
    with refused("file-damaged"):
        run_fleet([job(tmp_path, "a")], tmp_path, LocalWorkers(1, 1))


def test_combinations_and_cores() -> None:
    assert combinations({}) == [{}]
    assert combinations({"a": ["1", "2"], "b": ["3"]}) == [{"a": "1", "b": "3"}, {"a": "2", "b": "3"}]
    for slots, jobs, cores, expected in ((0, 9, 4, (4, 1)), (0, 2, 8, (2, 4)), (8, 9, 2, (8, 1))):
        workers = make_workers(None, slots, jobs, cores)
        assert (workers.slots, workers.threads) == expected
