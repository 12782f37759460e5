"""Clips that a policy is told with noise: what it is told, what judges it, how it is trained."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from poise.env import ImitationEnv
from poise.jobs.perpetual.evaluation import evaluate_clips
from poise.jobs.perpetual.perpetual_run import begin, resume, train
from poise.learn import PolicyBundle, Until
from poise.motion.noise import VIDEO, perturb_clip, scaled
from poise.recipes.body_shapes import BodyShapes
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual import build
from poise.recipes.perpetual_settings import Perpetual
from refusals import refused
from toy_library import PLAIN, library, tiny

NOISY = {"noise": (0.5,), "action": "additive"}


def built(**changes: object) -> Imitation:
    return build(library(), tiny(**(PLAIN | NOISY | changes)))


@pytest.fixture(scope="module")
def imitation() -> Imitation:
    return built(window=(2,))


def begun(imitation: Imitation, clip: int, frame: int = 3) -> tuple[ImitationEnv, torch.Tensor]:
    env = imitation.env(1, threads=1, auto_reset=False)
    return env, env.reset_to(torch.tensor([clip]), torch.tensor([frame]))


def test_each_clip_is_there_once_more_for_every_strength() -> None:
    made, plain = built(noise=(0.25, 1.0)), built(noise=())
    names = plain.library.names
    assert made.library.names == (*names, *(f"{n}~0.25" for n in names), *(f"{n}~1" for n in names))
    assert not made.reference.cyclic[len(names) :].any()
    assert made.library.weights[: len(names)] == made.library.weights[len(names) : 2 * len(names)]
    assert not plain.reference.misleads
    again = built(noise=(0.25, 1.0)).reference
    torch.testing.assert_close(again.hinges, made.reference.hinges, rtol=0, atol=0)


def test_the_policy_is_told_the_noise_and_judged_without(imitation: Imitation) -> None:
    count = len(imitation.library) // 2
    clean, noisy = begun(imitation, 0)[0], begun(imitation, count)[0]
    torch.testing.assert_close(clean.goal.now(), noisy.goal.now())
    torch.testing.assert_close(clean.goal.start(None)[0], noisy.goal.start(None)[0])
    for k in (1, 2):
        assert not torch.allclose(clean.goal.ahead(k), noisy.goal.ahead(k))
    tables = [env.goal.targets() for env in (clean, noisy)]
    assert not torch.allclose(*(table[rows] for table, rows in tables))
    still = torch.zeros(1, clean.num_actions)
    for _ in range(3):
        clean.step(still)
        noisy.step(still)
        # By what the reward and the failure are counted the noise does not move.
        torch.testing.assert_close(clean.goal.now(), noisy.goal.now())
    for env in (clean, noisy):
        env.close()


def test_the_noise_is_that_of_an_estimator(imitation: Imitation) -> None:
    """What is told of a clip is the clip with `perturb_clip`, up to its place on the floor."""
    clip, reference = imitation.library.clips[0], imitation.reference
    seen = perturb_clip(clip.replaced(cyclic=False), scaled(VIDEO, 0.5), imitation.config.seed)
    count = len(imitation.library) // 2
    frames = int(reference.length[0])
    places = torch.arange(frames)
    told = reference.gather_packed(torch.full((frames,), count), places, told=True)
    root = reference.layout.unpacked(told).pos[:, 0, :2]
    assert seen.fps == reference.rate_hz
    torch.testing.assert_close(root, torch.tensor(seen.root_pos[:frames, :2]).float(), atol=2e-3, rtol=0)


def test_observations_of_clean_clips_stay(imitation: Imitation) -> None:
    plain, count = built(noise=(), window=(2,)), len(imitation.library) // 2
    (a, seen), (b, told), (c, apart) = (
        begun(plain, 0), begun(imitation, 0), begun(imitation, count),
    )  # fmt: skip
    torch.testing.assert_close(seen, told, rtol=0, atol=0)
    assert not torch.allclose(told, apart)
    for env in (a, b, c):
        env.close()


def test_references_are_joined_with_those_that_tell_no_other(imitation: Imitation) -> None:
    plain = built(noise=()).reference
    both = plain.joined(imitation.reference)
    assert both.misleads and len(both.hinges) == both.frames
    clip, frame = torch.tensor([0, len(plain.length)]), torch.tensor([2, 2])
    told = both.gather_packed(clip, frame, told=True)
    torch.testing.assert_close(told[0], told[1])
    with refused("count-differs"):
        plain.told([q.numpy() for q in plain.qpos.split(plain.length.tolist())][:-1])


def test_evaluations_count_clips_with_noise_as_clips(imitation: Imitation) -> None:
    env, _ = begun(imitation, 0)
    rng = torch.Generator().manual_seed(0)
    policy = PolicyBundle.make(env.num_obs, env.num_actions, (8,), generator=rng)
    env.close()
    results = evaluate_clips(imitation, policy, threads=1)
    assert len(results.succeeded) == len(imitation.library)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"noise": (0.0,)}, ("out-of-range", "noise")),
        ({"noise": (0.5, 0.5)}, ("out-of-range", "noise")),
        (
            {"noise": (0.5,), "shape": True, "shapes": BodyShapes(count=2)},
            ("settings-conflict", "noise"),
        ),
    ],
)
def test_noise_that_cannot_be_is_refused(changes: dict[str, object], said: tuple) -> None:
    with refused(*said):
        tiny(**(PLAIN | changes))


def test_a_training_with_noise_goes_on_from_its_folder(tmp_path: Path) -> None:
    config: Perpetual = tiny(**(PLAIN | NOISY | {"max_primitives": 1}))
    made = begin(tmp_path, library(), config)
    train(made, tmp_path, Until(iterations=1), threads=1, tensorboard=False)
    again = resume(tmp_path, config)
    assert again.library.names == made.library.names
    torch.testing.assert_close(again.reference.hinges, made.reference.hinges)
