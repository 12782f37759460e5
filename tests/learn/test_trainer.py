"""Training goes on bit for bit: from memory, from a file, after kills."""

import csv
import os
import random
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from toy_point_env import PointEnv

from poise.learn import LATEST, PPOConfig, Trainer, Until, load_checkpoint, load_policy, run
from refusals import refused

TOY = PPOConfig(
    std=0.3,
    horizon=12,
    epochs=2,
    policy_hidden=(16,),
    value_hidden=(16,),
    minibatch=128,
    critic_warmup=2,
    kl_target=0.01,
    learn_std=True,
)


def make(seed: int = 0, **options) -> Trainer:
    return Trainer(PointEnv(32, seed), TOY, seed=seed, character="point", **options)


def assert_same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> None:
    assert a.keys() == b.keys()
    for name in a:
        x, y = a[name].clone(), b[name].clone()
        if name == "trainer/counters":
            x[2] = y[2] = 0.0  # Seconds.
        assert (
            torch.equal(x.nan_to_num(-1), y.nan_to_num(-1))
            if x.is_floating_point()
            else torch.equal(x, y)
        )


def rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "log.csv").open(newline="") as file:
        return [{k: v for k, v in r.items() if not k.startswith("time/")} for r in csv.DictReader(file)]


# One split lies inside the critic's warm-up, where the policy has no moments yet.
@pytest.mark.parametrize("split", [0, 1, 3])
def test_resume_is_bit_exact(split, tmp_path):
    through = make()
    whole = [through.iterate().row() for _ in range(6)]
    first = make()
    parts = [first.iterate().row() for _ in range(split)]
    first.save(tmp_path / "c")
    second = make(seed=5)  # Everything of another seed is replaced.
    assert second.load(tmp_path / "c")["iteration"] == split
    parts += [second.iterate().row() for _ in range(6 - split)]
    assert_same(through.state(), second.state())
    for a, b in zip(whole, parts, strict=True):
        for name in a:
            assert name.startswith("time/") or a[name] == pytest.approx(b[name], abs=0, nan_ok=True), (
                name
            )
    assert second.seconds > first.seconds


def test_a_resumed_run_may_change_what_the_config_fixes(tmp_path):
    fixed = replace(TOY, kl_target=None, learn_std=False)
    Trainer(PointEnv(32), fixed, character="point").save(tmp_path / "c")
    changed = replace(fixed, policy_lr=1e-5, value_lr=1e-6, std=0.2)
    trainer = Trainer(PointEnv(32), changed, character="point")
    trainer.load(tmp_path / "c")
    groups = (trainer.ppo.optimizer.param_groups[0], trainer.ppo.value_optimizer.param_groups[0])
    assert [g["lr"] for g in groups] == [1e-5, 1e-6]
    assert trainer.iterate().update.std == pytest.approx(0.2)


def test_saving_disturbs_nothing():
    a, b = make(), make()
    for _ in range(3):
        a.iterate()
        b.state()
        b.iterate()
    assert_same(a.state(), b.state())


def test_a_run_resumes_and_leaves_the_same_table(tmp_path):
    run(make(), Until(iterations=6), tmp_path / "whole")
    run(make(), Until(iterations=4), tmp_path / "parts", every=3)
    result = run(make(), Until(iterations=6), tmp_path / "parts", every=3)
    assert result.last is not None and result.last.iteration == 6 and not result.interrupted
    assert_same(
        load_checkpoint(tmp_path / "whole" / LATEST)[0], load_checkpoint(tmp_path / "parts" / LATEST)[0]
    )
    assert rows(tmp_path / "whole") == rows(tmp_path / "parts")
    assert len(rows(tmp_path / "whole")) == 6
    assert run(make(), Until(iterations=6), tmp_path / "parts").last is None


def test_limits_and_callbacks(tmp_path):
    seen: list[int] = []
    trainer = make()
    result = run(
        trainer,
        Until(samples=3 * 12 * 32, minutes=10),
        tmp_path,
        on_iteration=lambda s: seen.append(s.iteration),
        tensorboard=False,
    )
    assert seen == [1, 2, 3] and result.checkpoint == tmp_path / LATEST
    assert not (tmp_path / "tensorboard").exists()
    assert run(make(), Until(minutes=0)).last is None
    stopped = run(make(), Until(iterations=9), on_iteration=lambda s: s.iteration < 2)
    assert stopped.last is not None and stopped.last.iteration == 2
    with refused("limit-missing"):
        Until()


def test_ctrl_c_finishes_the_iteration_and_saves(tmp_path):
    def press(stats) -> None:
        if stats.iteration == 2:
            os.kill(os.getpid(), signal.SIGINT)

    before = signal.getsignal(signal.SIGINT)
    result = run(make(), Until(iterations=50), tmp_path, every=10, on_iteration=press, tensorboard=False)
    assert result.interrupted
    assert load_checkpoint(tmp_path / LATEST)[1]["iteration"] == 2
    assert signal.getsignal(signal.SIGINT) is before


def test_a_loaded_policy_acts_like_the_trainers(tmp_path):
    trainer = make(metadata={"recipe": "toy"})
    trainer.iterate()
    trainer.save(tmp_path / "c")
    loaded = load_policy(tmp_path / "c", character="point")
    obs = torch.randn(9, 4, generator=torch.Generator().manual_seed(0))
    want = trainer.policy().act(obs)
    assert torch.equal(loaded.act(obs), want)
    assert loaded.meta["metadata"] == {"recipe": "toy"}
    trainer.policy().save(tmp_path / "p", "point")
    assert torch.equal(load_policy(tmp_path / "p").act(obs), want)
    with refused("checkpoint-unfit", says=("point", "dog")):
        load_policy(tmp_path / "c", character="dog")
    with refused("checkpoint-unfit", says=("policy", "trainer")):
        make().load(tmp_path / "p")

    warm = make(seed=7, warm_start=loaded)
    assert torch.equal(warm.policy().act(obs), want)
    warm.iterate()
    with refused("state-differs", says="policy/mean/layers.0.weight"):
        Trainer(PointEnv(8), replace(TOY, policy_hidden=(8,)), warm_start=loaded)


def test_what_does_not_fit_is_refused(tmp_path):
    trainer = make()
    trainer.save(tmp_path / "c")
    with refused("checkpoint-unfit", says=("num_envs", "32", "16")):
        Trainer(PointEnv(16), TOY, character="point").load(tmp_path / "c")
    with refused("checkpoint-unfit", says=("point", "dog")):
        Trainer(PointEnv(32), TOY, character="dog").load(tmp_path / "c")
    with refused("state-differs", says="critic/layers.0.weight"):
        Trainer(PointEnv(32), replace(TOY, value_hidden=(8,)), character="point").load(tmp_path / "c")


# A parent that has paid for all imports forks the training again and again and kills it.
KILLER = """
import os, random, signal, sys, tempfile, time, torch
torch.set_num_threads(1)
from pathlib import Path
from test_trainer import LATEST, Until, load_checkpoint, make, run
folder, rng, resumed = Path(sys.argv[1]), random.Random(int(sys.argv[2])), set()
run(make(), Until(iterations=3), tempfile.mkdtemp())
start = time.perf_counter()
run(make(), Until(iterations=20), tempfile.mkdtemp())
usual = time.perf_counter() - start
for attempt in range(60):
    pid = os.fork()
    if pid == 0:
        run(make(), Until(iterations=24), folder, every=int(sys.argv[3]))
        os._exit(0)
    if attempt < 59:
        time.sleep(rng.uniform(0, 0.35 * usual))
        os.kill(pid, signal.SIGKILL)
    _, status = os.waitpid(pid, 0)
    if os.WIFEXITED(status):
        break
    if (folder / LATEST).exists():
        resumed.add(load_checkpoint(folder / LATEST)[1]["iteration"])
print(attempt, len(resumed))
sys.exit(os.WEXITSTATUS(status))
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="kills a forked process")
@pytest.mark.parametrize("every", [1, 4])
def test_kills_at_random_moments_change_nothing(every, tmp_path):
    here = str(Path(__file__).parent)
    paths = [here, str(Path(here).parent), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    seed = str(random.randrange(10**6))
    command = [sys.executable, "-c", KILLER, str(tmp_path / "killed"), seed, str(every)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"seed {seed}: {done.stderr[-2000:]}"
    kills, places = map(int, done.stdout.split())
    assert kills >= 2 and places >= 2, f"seed {seed}: {kills} kills at {places} iterations"
    run(make(), Until(iterations=24), tmp_path / "whole", tensorboard=False)
    whole, killed = (load_checkpoint(tmp_path / name / LATEST)[0] for name in ("whole", "killed"))
    assert_same(whole, killed)
    assert rows(tmp_path / "whole") == rows(tmp_path / "killed"), f"seed {seed}"
    assert not list((tmp_path / "killed").glob(".*"))
