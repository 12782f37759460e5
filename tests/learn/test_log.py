"""The logs: growing columns, cutting back on resume."""

import time

from poise.learn import Log


def lines(folder) -> list[str]:
    return (folder / "log.csv").read_text().splitlines()


def test_rows_are_appended_and_new_columns_added(tmp_path):
    log = Log(tmp_path, tensorboard=False)
    log.write({"iteration": 1, "reward": 0.1})
    log.write({"iteration": 2, "reward": 1 / 3, "new": 2.0})
    log.write({"iteration": 3, "new": 4.0})
    log.close()
    log.close()
    assert lines(tmp_path) == ["iteration,reward,new", "1,0.1,", f"2,{1 / 3!r},2.0", "3,,4.0"]


def test_resume_drops_later_and_torn_rows(tmp_path):
    log = Log(tmp_path, tensorboard=False)
    for i in range(1, 5):
        log.write({"iteration": i, "reward": i / 10})
    log.close()
    with (tmp_path / "log.csv").open("a") as file:
        file.write("2")  # A torn row that looks like an early one.
    log = Log(tmp_path, last=2, tensorboard=False)
    log.write({"iteration": 3, "reward": 0.3})
    log.close()
    assert lines(tmp_path) == ["iteration,reward", "1,0.1", "2,0.2", "3,0.3"]


def test_a_fresh_start_empties_the_table(tmp_path):
    for _ in range(2):
        log = Log(tmp_path, tensorboard=False)
        log.write({"iteration": 1, "reward": 0.5})
        log.close()
    assert lines(tmp_path) == ["iteration,reward", "1,0.5"]


def test_tensorboard_reads_what_was_written_and_hides_repeated_steps(tmp_path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    for last in (0, 2):
        # Files are read in the order of their names, with stamps of whole seconds.
        time.sleep(1.01 if last else 0.0)
        log = Log(tmp_path, last=last)
        for i in range(last + 1, 5):
            log.write({"iteration": i, "reward": i / 10 + last})
        log.close()
    events = EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    scalars = [(e.step, round(e.value, 3)) for e in events.Scalars("reward")]
    assert scalars == [(1, 0.1), (2, 0.2), (3, 2.3), (4, 2.4)]
