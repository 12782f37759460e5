"""A snapshot of an environment: everything that some of its worlds are, copied."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from torch import Tensor

from poise.errors import PoiseError

if TYPE_CHECKING:
    from poise.env.env import ImitationEnv


@dataclass(frozen=True, eq=False)
class Snapshot:
    """What n worlds were, see `ImitationEnv.snapshot`.

    Attributes:
        worlds: tensors `(n, ...)` by name: physics "sim", and its "qpos" and "qvel" for another kind of
            backend; the goal's and the plug-ins' rows, "age", "action", ...
        physics: width of the physics without derived fields, the first columns of "sim".
        goal: what the goal's rows point into.
        shared: what all worlds of the environment share: help, failure rates, odds, random generators;
            None where only some of its worlds were copied.
    """

    worlds: Mapping[str, Tensor]
    physics: int
    goal: Mapping[str, Tensor]
    shared: Mapping[str, Tensor] | None

    def __len__(self) -> int:
        return len(self.worlds["sim"])

    def repeated(self, count: int) -> Snapshot:
        """A snapshot of one world as one of `count` worlds."""
        many = {k: v.expand(count, *v.shape[1:]) for k, v in self.worlds.items()}
        return Snapshot(many, self.physics, self.goal, None)

    def picked(self, rows: Tensor) -> Snapshot:
        """The worlds `rows (k,)` of this snapshot, each as often as it is named."""
        return Snapshot({k: v[rows] for k, v in self.worlds.items()}, self.physics, self.goal, None)


def take(env: ImitationEnv, rows: Tensor | None) -> Snapshot:
    """What worlds `rows (n,)` of an environment are, all for None: physics, bodies, goal, episode,
    recovery; and of all worlds what they share: help, failure rates, odds, random generators."""
    state = env.backend.state
    worlds = {"sim": env.backend.snapshot(), "qpos": state.qpos, "qvel": state.qvel, **_rows(env)}
    copies = {k: v.clone() if rows is None else v.index_select(0, rows) for k, v in worlds.items()}
    width = env.backend.snapshot(derived=False).shape[1]
    return Snapshot(copies, width, dict(env.goal.shared()), _shared(env) if rows is None else None)


def put(env: ImitationEnv, snapshot: Snapshot, rows: Tensor | None) -> None:
    """Makes worlds `rows (n,)` of an environment, all for None, what a snapshot holds; see
    `ImitationEnv.restore`, which aims their goals then."""
    count = env.num_envs if rows is None else len(rows)
    if len(snapshot) == 1 and count > 1:
        snapshot = snapshot.repeated(count)
    if len(snapshot) != count:
        raise PoiseError(f"the snapshot holds {len(snapshot)} worlds, and {count} are to be restored")
    into = _rows(env)
    missing = sorted(into.keys() - snapshot.worlds.keys())
    if missing:
        raise PoiseError(f"the snapshot of another kind of environment has no '{missing[0]}'")
    env.goal.load_shared(snapshot.goal)
    for name, value in into.items():
        if rows is None:
            value.copy_(snapshot.worlds[name])
        else:
            value[rows] = snapshot.worlds[name]
    for plugin in env.plugins:
        plugin.assign(rows, env.goal.body(rows))
    sim, backend = snapshot.worlds["sim"], env.backend
    if sim.shape[1] == backend.snapshot().shape[1]:
        backend.restore(sim, rows)
    elif snapshot.physics == backend.snapshot(derived=False).shape[1]:
        # Other terms have other fields of the state fetched, which follow from the rest.
        backend.restore(sim[:, : snapshot.physics], rows)
    else:
        # Another kind of backend, such as a world of several characters.
        backend.write(rows, snapshot.worlds["qpos"], snapshot.worlds["qvel"])
    if rows is None and snapshot.shared is not None:
        for plugin in env.plugins:
            plugin.load_state(snapshot.shared)
        if "weights" in snapshot.shared:
            env.weights = snapshot.shared["weights"]
        env.goal.rng.set_state(snapshot.shared["rng"])


def state_of(env: ImitationEnv) -> dict[str, Tensor]:
    """Everything that a bit-exact continuation of an environment needs."""
    return {
        "sim": env.backend.snapshot(),
        "qpos": env.backend.state.qpos.clone(),
        "qvel": env.backend.state.qvel.clone(),
        "age": env.age.clone(),
        "action": env.action.clone(),
        **env.goal.state(),
        **{k: v for plugin in env.plugins for k, v in plugin.state().items()},
    }


def put_state(env: ImitationEnv, state: Mapping[str, Tensor]) -> None:
    """Makes an environment what `state_of` told; see `ImitationEnv.load_state`."""
    env.goal.load_state(state)
    for plugin in env.plugins:
        plugin.assign(None, env.goal.body(None))
    if state["sim"].dtype == env.backend.state.qpos.dtype:
        env.backend.restore(state["sim"])
    else:
        env.backend.write(None, state["qpos"], state["qvel"])
    for name in ("age", "action"):
        getattr(env, name).copy_(state[name])
    for plugin in env.plugins:
        plugin.load_state(state)
    if env.goal.begins:
        env.weights = env.weights


def _rows(env: ImitationEnv) -> dict[str, Tensor]:
    """The tensors `(N, ...)` of an environment beside its physics, by name."""
    goal = {f"goal/{k}": v for k, v in env.goal.rows().items()}
    own = {"age": env.age, "action": env.action, **goal}
    return {**own, **{k: v for plugin in env.plugins for k, v in plugin.rows().items()}}


def _shared(env: ImitationEnv) -> dict[str, Tensor]:
    """What all worlds of an environment share, by name."""
    own = {k: v for plugin in env.plugins for k, v in plugin.state().items()}
    if env.goal.begins:
        own["weights"] = env.weights
    return {**own, "rng": env.goal.rng.get_state()}
