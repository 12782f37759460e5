"""Episodes as learners want them: what a policy saw and did in every step.

steps = open_run("out").transitions(most=16)
steps.save("rollouts.npz")
steps.obs, steps.actions, steps.rewards, steps.terminated, steps.episode
"""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from poise.env import Acts, ImitationEnv
from poise.errors import PoiseError
from poise.eval.episodes import frames_from
from poise.motion.io.text import write_whole

#: The version of the file, in its array `poise_transitions`.
VERSION = 1


@dataclass(frozen=True, eq=False, repr=False)
class Transitions:
    """S control steps of E episodes, one after another.

    Attributes:
        obs: `(S, O)` float32, what the policy saw before the step, not normalised.
        actions: `(S, A)` float32, what it did.
        rewards: `(S,)` float32, the sum that the task weighs.
        terms: `(S, K)` float32, the rewards by term, not weighted.
        terminated: `(S,)` bool, the episode ended with this step; nothing is bootstrapped.
        truncated: `(S,)` bool, it was cut off after this step; bootstrap with `last_obs`.
        failed: `(S,)` bool, it ended with this step because the motion was lost.
        episode: `(S,)` int64, from 0.
        qpos, qvel: `(S, 7 + n)` and `(S, 6 + n)` float32, MuJoCo's, before the step.
        last_obs: `(E, O)` float32, what was seen after the last step of each episode.
        clip, start: `(E,)` int64, the clip and the control frame at which each began.
        obs_names, action_names, term_names, clip_names: of the columns and the clips. A column of the
            observations is called `TERM[k]`.
        rate_hz: control steps per second.
    """

    obs: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    terms: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    failed: np.ndarray
    episode: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    last_obs: np.ndarray
    clip: np.ndarray
    start: np.ndarray
    obs_names: tuple[str, ...]
    action_names: tuple[str, ...]
    term_names: tuple[str, ...]
    clip_names: tuple[str, ...]
    rate_hz: float

    def __repr__(self) -> str:
        steps, sizes = (
            len(self.obs),
            f"{self.obs.shape[1]} observations, {self.actions.shape[1]} actions",
        )
        return f"Transitions({len(self.clip)} episodes, {steps} steps, {sizes})"

    def save(self, path: str | Path) -> Path:
        """Writes all of it into an npz without pickles, whole or not at all.

        Raises:
            PoiseError: another suffix, or nothing can be written there.
        """
        path = Path(path)
        if path.suffix != ".npz":
            raise PoiseError("rollouts are written as .npz", path, "Choose a name that ends in .npz")
        arrays = {f.name: np.asarray(getattr(self, f.name)) for f in fields(self)}
        buffer = io.BytesIO()
        np.savez_compressed(buffer, poise_transitions=np.array(VERSION), **arrays)  # type: ignore[arg-type]
        write_whole(path, buffer.getvalue())
        return path


def record_transitions(
    make_env: Callable[[int], ImitationEnv],
    policy: Acts,
    clip: Tensor,
    start: Tensor,
    noise: float = 0.0,
    seed: int = 0,
    cycles: int = 2,
) -> Transitions:
    """Simulates every episode until it ends or its clip does, and keeps each step.

    Args:
        make_env: gives an environment of N worlds without automatic reset, which is closed in the end.
        policy: acts on raw observations.
        clip, start: `(E,)` clip index and first control frame.
        noise: one deviation of what is added to each action, in the actions' own units. The actions that
            are kept hold it.
        seed: of the noise.
        cycles: rounds of a cyclic clip, after which an episode is cut off.
    """
    if not noise >= 0:
        raise PoiseError(f"noise must be at least 0, got {noise:g}")
    env, rng = make_env(len(clip)), torch.Generator().manual_seed(seed)
    columns: dict[str, list[Tensor]] = {}
    try:
        obs = env.reset_to(clip, start).clone()
        most = frames_from(env.reference, clip, start, cycles) - 1
        going = torch.ones(len(clip), dtype=torch.bool)
        last = obs.clone()
        for t in range(int(most.max())):
            action = policy.act(obs)
            if noise:
                action = action + noise * torch.randn(action.shape, generator=rng).to(action)
            state = env.backend.state
            row = {"obs": obs.clone(), "actions": action, "qpos": state.qpos, "qvel": state.qvel}
            row = {k: v.detach().to("cpu", torch.float32, copy=True) for k, v in row.items()}
            step = env.step(action)
            obs = step.final_obs.clone()
            row |= {"rewards": step.reward.cpu().float(), "kept": going.clone()}
            row["terms"] = torch.stack([v.cpu().float() for v in env.terms.values()], -1)
            terminated, truncated = step.terminated.cpu(), step.truncated.cpu()
            row |= {"terminated": terminated.clone(), "failed": step.failed.cpu().clone()}
            row["truncated"] = (truncated | (t + 1 >= most)) & ~terminated
            last[going] = obs[going].to(last)
            going &= ~(terminated | row["truncated"])
            for name, value in row.items():
                columns.setdefault(name, []).append(value)
            if not going.any():
                break
        return _transitions(env, columns, last, clip, start)
    finally:
        env.close()


def _transitions(
    env: ImitationEnv, columns: dict[str, list[Tensor]], last: Tensor, clip: Tensor, start: Tensor
) -> Transitions:
    """Episodes one after another, without what was simulated after their ends."""
    kept = torch.stack(columns.pop("kept"), 1)
    flat = {name: torch.stack(values, 1)[kept].numpy() for name, values in columns.items()}
    episode = torch.arange(len(clip))[:, None].expand_as(kept)[kept]
    hinges = env.goal.humanoid.hinges
    more = tuple(f"residual[{k}]" for k in range(env.num_actions - len(hinges)))
    return Transitions(
        **flat,
        episode=episode.numpy(),
        last_obs=last.detach().cpu().float().numpy(),
        clip=clip.numpy().copy(),
        start=start.numpy().copy(),
        obs_names=tuple(f"{name}[{k}]" for name, size in env.obs_widths.items() for k in range(size)),
        action_names=(*hinges, *more),
        term_names=tuple(t.name for t in env.task.rewards),
        clip_names=tuple(env.reference.names),
        rate_hz=float(env.reference.rate_hz),
    )
