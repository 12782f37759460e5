"""The Gymnasium adapters pass Gymnasium's own checks and keep its contracts."""

from __future__ import annotations

import warnings

import gymnasium
import numpy as np
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from poise.env import GymEnv, GymVectorEnv
from refusals import refused


def test_single_env_passes_gymnasiums_checker(make_env):
    env = GymEnv(make_env(1, auto_reset=False))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # An infinite observation space is what it is, and there is no registered spec to make anew.
        warnings.filterwarnings("ignore", message=".*(infinity|spec|np_random).*")
        check_env(env, skip_render_check=True)
    env.close()


def test_single_env_steps_to_the_end_and_wraps(make_env):
    env = gymnasium.wrappers.RecordEpisodeStatistics(GymEnv(make_env(1, auto_reset=False)))
    obs, info = env.reset(seed=3)
    assert obs.dtype == np.float32 and info == {}
    for _ in range(40):
        obs, reward, terminated, truncated, info = env.step(np.zeros(env.action_space.shape, np.float32))
        assert isinstance(reward, float) and type(terminated) is bool and type(truncated) is bool
        if terminated or truncated:
            break
    assert terminated and not truncated and "episode" in info
    env.close()


def test_vector_env_contract(make_env):
    env = GymVectorEnv(make_env(5), limit=2.0)
    n, o, a = 5, env.env.num_obs, env.env.num_actions
    assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    assert env.observation_space.shape == (n, o) and env.action_space.shape == (n, a)
    assert env.single_action_space.high.max() == 2.0 and env.action_space.dtype == np.float32
    obs, infos = env.reset(seed=1)
    assert obs in env.observation_space and infos == {}
    seen = 0
    for _ in range(35):
        frames = env.env.age.clone()
        obs, reward, terminated, truncated, infos = env.step(np.zeros((n, a), np.float32))
        assert obs in env.observation_space and reward.shape == (n,) and reward.dtype == np.float32
        over = terminated | truncated
        assert terminated.dtype == truncated.dtype == bool and not (terminated & truncated).any()
        assert ("final_obs" in infos) == over.any()
        for i in np.flatnonzero(over):
            seen += 1
            assert infos["_final_obs"][i] and infos["final_obs"][i] in env.single_observation_space
            # The episode went on to a new start: the age is zero again and the observation another.
            assert env.env.age[i] == 0 and frames[i] >= 0
            assert not np.array_equal(infos["final_obs"][i], obs[i])
        if over.any():
            assert all(infos["final_obs"][i] is None for i in np.flatnonzero(~over))
    assert seen >= n
    env.close()


def test_final_obs_is_what_an_env_without_reset_sees(make_env):
    auto, still = GymVectorEnv(make_env(3)), make_env(3, auto_reset=False)
    auto.reset(seed=7)
    still.reset_to(auto.env.clip, auto.env.frame)
    done = np.zeros(3, bool)
    for _ in range(31):
        zero = np.zeros((3, auto.env.num_actions), np.float32)
        obs, _, terminated, truncated, infos = auto.step(zero)
        twin = still.step(auto.env.action.new_zeros(zero.shape)).obs.numpy()
        over = (terminated | truncated) & ~done
        for i in np.flatnonzero(over):
            np.testing.assert_array_equal(infos["final_obs"][i], twin[i])
        np.testing.assert_array_equal(obs[~done & ~over], twin[~done & ~over])
        done |= over
    assert done.all()
    auto.close()
    still.close()


def test_seed_repeats_everything_and_no_seed_goes_on(make_env):
    env = GymVectorEnv(make_env(4))
    runs = []
    for seed in (11, 11, 12):
        obs, _ = env.reset(seed=seed)
        action = np.full(env.action_space.shape, 0.05, np.float32)
        runs.append(np.concatenate([obs] + [env.step(action)[0] for _ in range(20)]))
    np.testing.assert_array_equal(runs[0], runs[1])
    assert not np.array_equal(runs[0], runs[2])
    env.reset(seed=11)
    assert not np.array_equal(env.reset()[0], runs[0][:4])
    env.close()


def test_returned_arrays_are_not_used_again(make_env):
    env = GymVectorEnv(make_env(2))
    obs, _ = env.reset(seed=0)
    kept = obs.copy()
    env.step(np.zeros(env.action_space.shape, np.float32))
    np.testing.assert_array_equal(obs, kept)
    env.close()


def test_gymnasium_vector_wrappers_apply(make_env):
    inner = GymVectorEnv(make_env(2))
    env = gymnasium.wrappers.vector.RecordEpisodeStatistics(inner)
    env = gymnasium.wrappers.vector.DictInfoToList(env)
    env.reset(seed=0)
    ended = 0
    for _ in range(31):
        _, _, _, _, infos = env.step(np.zeros(env.action_space.shape, np.float32))
        ended += sum("episode" in one and "final_obs" in one for one in infos)
    assert ended and 0 < inner.log["imitation"] <= 1
    env.close()


def test_mistakes_are_told(make_env):
    env = make_env(2, auto_reset=False)
    with refused("auto-reset-needed"):
        GymVectorEnv(env)
    with refused("single-world-needed"):
        GymEnv(env)
    env.close()
    env = make_env(2)
    with refused("out-of-range", says="limit"):
        GymVectorEnv(env, limit=0.0)
    env.close()
