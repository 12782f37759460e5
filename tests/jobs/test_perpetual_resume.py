"""A perpetual run that was stopped or killed anywhere ends like one that was not, bit for bit."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from poise.jobs.library.files import same_library
from poise.jobs.perpetual.perpetual_run import begin, resume, train
from poise.jobs.perpetual.stage_trainer import StageTrainer
from poise.jobs.perpetual.stages import Progress, Stage
from poise.jobs.run_file import FINAL
from poise.learn import LATEST, Until, load_checkpoint
from poise.motion import ClipLibrary
from poise.papers.perpetual.ablations import StagedPerpetual
from poise.papers.perpetual.primitive_stages import PrimitiveOrder
from poise.recipes.perpetual_settings import Perpetual, config_of
from poise.settings import to_data
from refusals import refused
from toy_library import library, tiny

ITERATIONS = 16
#: Evaluations are at every second iteration of a stage; it ends at 0.35, 0.56 and 0.86 of all at most.
CONFIG = tiny(recovery=True, max_primitives=2)
STAGES = ["primitive 1", "primitive 2", "recovery", "composer"]


class KilledError(Exception):
    """Ends a training without any farewell."""


def go_on(
    folder: Path,
    show: Callable[[Progress], bool | None] | None = None,
    save_s: float = 0.0,
    config: Perpetual = CONFIG,
) -> None:
    imitation = begin(folder, library(), config)
    until = Until(iterations=ITERATIONS)
    train(imitation, folder, until, show, threads=1, tensorboard=False, save_s=save_s)


def killing(at: int) -> Callable[[Progress], None]:
    def show(p: Progress) -> None:
        if p.iteration == at:
            raise KilledError

    return show


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An uninterrupted run with real evaluations."""
    folder = tmp_path_factory.mktemp("whole")
    stages: list[str] = []
    go_on(folder, lambda p: stages.append(p.stage.name))
    # The third clip is too hard for so little training, so that all stages are there.
    assert list(dict.fromkeys(stages)) == STAGES
    return folder


def assert_same(a: Path, b: Path) -> None:
    """All numbers of two run folders, but for the clocks."""
    for name in (LATEST, FINAL):
        one, other = (load_checkpoint(f / name)[0] for f in (a, b))
        for tensors in (one, other):
            if "trainer/counters" in tensors:
                tensors["trainer/counters"][2] = 0.0
        assert one.keys() == other.keys()
        different = [k for k in one if not torch.equal(one[k].nan_to_num(), other[k].nan_to_num())]
        assert not different
    assert (a / "success.csv").read_text() == (b / "success.csv").read_text()
    assert curve(a) == curve(b) and result(a) == result(b)


def result(folder: Path) -> dict[str, object]:
    said = json.loads((folder / "result.json").read_text())
    return {k: v for k, v in said.items() if k != "seconds"}


def curve(folder: Path) -> list[dict[str, str]]:
    with (folder / "log.csv").open(newline="") as file:
        return [{k: v for k, v in r.items() if not k.startswith("time/")} for r in csv.DictReader(file)]


def test_a_run_stopped_at_each_boundary_goes_on(whole: Path, tmp_path: Path) -> None:
    ended: list[str] = []

    def stop(p: Progress) -> bool:
        if p.following is not None:
            ended.append(p.stage.name)
        # In the middle of a stage, too.
        return p.following is None and p.iteration != 11

    for _ in range(5):
        go_on(tmp_path, stop)
    assert ended == STAGES[:-1]
    assert_same(whole, tmp_path)


def test_a_killed_run_goes_on_from_an_older_checkpoint(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        # While it clones, before anything is saved: it begins again.
        patch.setattr(StageTrainer, "save", lambda self: (_ for _ in ()).throw(KilledError()))
        with pytest.raises(KilledError):
            go_on(tmp_path)
    assert not (tmp_path / LATEST).exists()
    for moment in (3, 9, 13):
        # Nothing but evaluations saves, so that some iterations are lost and made again.
        with pytest.raises(KilledError):
            go_on(tmp_path, killing(moment), save_s=1e9)
    go_on(tmp_path, save_s=1e9)
    assert_same(whole, tmp_path)


def test_a_run_killed_between_any_two_stages_ends_the_stage_again(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before the next stage is chosen, and before its trainer is made."""
    died = set()

    def dying(step: str) -> Callable[..., object]:
        plain = getattr(PrimitiveOrder, step)

        def die(*args: object, **more: object) -> object:
            stage = next(x for x in args if isinstance(x, Stage))
            if stage.number > 1 and (step, stage) not in died:
                died.add((step, stage))
                raise KilledError
            return plain(*args, **more)

        return die

    for step in ("next", "trainer"):
        monkeypatch.setattr(PrimitiveOrder, step, dying(step))
    for _ in range(2 * len(STAGES[1:])):
        with pytest.raises(KilledError):
            go_on(tmp_path)
    go_on(tmp_path)
    for step in ("next", "trainer"):
        stages = sorted((s for at, s in died if at == step), key=lambda s: s.number)
        assert [s.name for s in stages] == STAGES[1:]
    assert_same(whole, tmp_path)


def test_a_finished_run_goes_on_with_more_time(tmp_path: Path) -> None:
    imitation = begin(tmp_path, library(), tiny(single=True, expert=False))
    for iterations, trains in ((2, True), (2, False), (4, True)):
        until = Until(iterations=iterations)
        result = train(imitation, tmp_path, until, threads=1, tensorboard=False)
        assert (result.last is not None) == trains and result.results is not None
        assert (tmp_path / FINAL).exists() and len(curve(tmp_path)) == iterations


def test_settings_for_additive_actions() -> None:
    config = StagedPerpetual.additive(single=True, num_envs=8)
    assert (config.action, config.style, config.single, config.num_envs) == ("additive", None, True, 8)
    assert config.ppo.std == 0.055 and config_of(to_data(config), kind=StagedPerpetual) == config


def test_settings_survive_json() -> None:
    for config in (tiny(), tiny(style=None, lateral=True, start="random"), StagedPerpetual()):
        assert config_of(to_data(config)) == config
    with refused("unknown-setting", says="colour"):
        config_of(to_data(StagedPerpetual()) | {"colour": 3})


def test_another_run_in_the_folder_is_refused(tmp_path: Path) -> None:
    begin(tmp_path, library(), CONFIG, "here")
    with refused("settings-differ", says="max_primitives, recovery, seed"):
        begin(tmp_path, library(), tiny(seed=2), "here")
    with refused("clips-differ", says="calm, walk, turn"):
        begin(tmp_path, ClipLibrary(library().clips[:2]), CONFIG, "here")
    with refused("library-differs", says="here"):
        resume(tmp_path, CONFIG, "there")
    assert resume(tmp_path, CONFIG, "here").config == CONFIG


def test_a_run_goes_on_with_a_folder_that_was_moved(tmp_path: Path) -> None:
    """Under another name, too; not with a copy of one that is there, nor with one of other clips."""
    old, new, run = tmp_path / "moves", tmp_path / "disk-2/walks", tmp_path / "run"
    clips = [c.replaced(name=f"moves-{c.name}") for c in library().clips]
    for folder in (old, new):
        folder.mkdir(parents=True)
        for clip in library().clips:
            (folder / f"{clip.name}.bvh").write_text("HIERARCHY")
    begin(run, ClipLibrary.of(clips), CONFIG, f"{old}, without x, onto {old}/a.bvh")
    moved = f"{new}, without x, onto {new}/a.bvh"
    with refused("library-differs", says="moves"):
        resume(run, CONFIG, moved)
    shutil.rmtree(old)
    assert resume(run, CONFIG, moved).config == CONFIG
    for other in (f"{new}, onto {new}/a.bvh", f"{new}, without x, onto {new}/b.bvh"):
        with refused("library-differs", says="moves"):
            resume(run, CONFIG, other)
    (new / "walk.bvh").unlink()
    with refused("library-differs", says="moves"):
        resume(run, CONFIG, moved)


def test_images_and_folders_of_a_moved_library(tmp_path: Path) -> None:
    (tmp_path / "b" / "sub-1").mkdir(parents=True)
    (tmp_path / "b" / "sub-1" / "a-b.bvh").write_text("HIERARCHY")
    old, new = str(tmp_path / "a"), str(tmp_path / "b")
    images = ["a-sub-1-a_b", "a-sub-1-a_b-mirrored", "a-sub-1-a_b-mirrored-backwards"]
    assert same_library([old], [new], images)
    assert same_library([old], [old], [])
    assert not same_library([old], [new], ["a-sub-1-a"])
    assert not same_library([old], [new, "with mirror images"], images)
    assert not same_library([old], [str(tmp_path / "c")], images)


def test_a_single_clip_is_no_library(tmp_path: Path) -> None:
    with refused("library-too-small", says="calm"):
        begin(tmp_path / "run", ClipLibrary(library().clips[:1]), CONFIG)
    assert not (tmp_path / "run").exists()
