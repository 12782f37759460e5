"""All terms of a task as one function of tensors, recorded once and replayed without Python."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import torch
from torch import Tensor

from poise.env.frame import Context, DoneTerm, Frame, Observable, ObsTerm, RewardTerm
from poise.errors import PoiseError
from poise.sim import Backend

TensorFunction = Callable[..., tuple[Tensor, ...]]

#: Where a slice without an end ends.
_END = torch.iinfo(torch.int64).max
#: Calls after which a function is recorded that is often called: making a recording takes as long as
#: some fifty of them.
OFTEN = 100


class Recorded:
    """A function of tensors on the CPU that is recorded once it is called often, see `record`.

    What it returns is not to be written into.
    """

    def __init__(self, plain: TensorFunction):
        self._plain, self._function, self._left = plain, plain, OFTEN

    @property
    def replays(self) -> bool:
        """True once the function is replayed from a recording."""
        return self._function is not self._plain

    def __call__(self, *given: Tensor) -> tuple[Tensor, ...]:
        self._left -= 1
        if self._left == 0 and given[0].device.type == "cpu":
            self._function = record(self._function, given)
        return self._function(*given)


def record(plain: TensorFunction, given: tuple[Tensor, ...]) -> TensorFunction:
    """What `plain(*given)` does, as one call for any number of worlds (TorchScript).

    It is the same operations in the same order, without Python's share: half of the time for hundreds
    of worlds, most of it for one. It runs in torch's inference mode: copy what it makes before giving
    it to code that may want gradients. A function with operations that depend on values, such as an `if`
    on a tensor, cannot be recorded: it is given back as it is, as every function is where torch has
    renamed what records and replays, which belongs to its inner parts.
    """
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        try:
            graph = _traced(plain, given)
            _drop_whole_slices(graph)
            # Torch has no public name for it; one that is renamed is the fallback below.
            recorded = torch._C._create_function_from_graph("replayed", graph)  # noqa: SLF001
        except (RuntimeError, AttributeError, TypeError):
            return plain
    # What a recording would freeze, such as a value that was asked for, torch only warns of.
    if any(issubclass(w.category, torch.jit.TracerWarning) for w in told):
        return plain

    def replay(*given: Tensor) -> tuple[Tensor, ...]:
        # What every operation otherwise notes for gradients is a sixth of the time of one world.
        with torch.inference_mode():
            return recorded(*given)

    return replay


def _traced(plain: TensorFunction, given: tuple[Tensor, ...]) -> Any:
    """The operations of `plain(*given)`.

    `torch.jit.trace` does the same, but keeps the function and its constants until the process ends,
    which is some MB for every environment.
    """
    names = [f"given{k}" for k in range(len(given))]
    # Torch has no public name for it; one that is renamed is the fallback of `record`.
    trace = torch._C._create_graph_by_tracing  # noqa: SLF001
    return trace(plain, given, lambda _: "", True, False, None, names)[0]


def _drop_whole_slices(graph: Any) -> None:
    """Takes out the `[:]` of every `x[:, 2:]`, which a recording would run as a step of its own."""
    for node in graph.findAllNodes("aten::slice"):
        source, _, *bounds = node.inputs()
        if [b.toIValue() for b in bounds] == [0, _END, 1]:
            node.output().replaceAllUsesWith(source)
            node.destroy()


#: From so many worlds on, two threads evaluate a half each.
MANY = 256


class Sources(Mapping[str, Tensor]):
    """The tensors of an environment by name: fields of MuJoCo's state, and what it holds itself.

    held: tensors `(N, ...)` that stay the same ones.
    """

    def __init__(self, backend: Backend, held: Mapping[str, Tensor]):
        self._backend, self._held = backend, dict(held)
        self._names: list[str] = []
        self._known: tuple[str, ...] | None = None

    def live(self, told: Mapping[str, Tensor]) -> Sources:
        """All of them, with what the goal tells, see `of`."""
        self._held |= told
        return self

    def reads(self, name: str) -> bool:
        """Whether terms read a tensor, once it is known (`settle`)."""
        return self._known is not None and name in self._known

    def __getitem__(self, name: str) -> Tensor:
        if name not in self._names:
            if name not in self._held and name not in self._backend.state:
                self._backend.state.bind((name,))
            self._names.append(name)
        return self._held[name] if name in self._held else self._backend.state[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def settle(self) -> None:
        """What was asked for until now is what terms read, and what `of` gives."""
        self._known = tuple(dict.fromkeys((*self._names, "age")))

    def of(self, told: Mapping[str, Tensor], ids: Tensor | None = None) -> dict[str, Tensor]:
        """What terms read, of all worlds; or of worlds `ids (n,)`, of which the goals are given.

        told: packed goals `(N, W)` of now, "goal", and of one control step later, "ahead", and those of
            the "window" `(N, K, W)`.
        """
        assert self._known is not None
        self._held |= told
        if ids is None:
            return {name: self[name] for name in self._known}
        return {name: self[name] if name in told else self[name][ids] for name in self._known}


def seen_by(terms: tuple[ObsTerm, ...], frame: Frame) -> Tensor:
    """The observations `(N, O)` of some terms side by side; O is 0 without any."""
    parts = [term.fn(frame, **term.params) for term in terms]
    return torch.cat(parts, -1) if parts else frame.phase.unsqueeze(-1)[:, :0]


class TermValues(NamedTuple):
    """obs `(N, O)`. scores `(2 + K, N)`: the reward, the part of it that is imitation, and the value of
    each of K reward terms. ends `(3, N)` bool: failed, terminated, truncated. style `(N, F)`: what a
    motion prior sees."""

    obs: Tensor
    scores: Tensor
    ends: Tensor
    style: Tensor


class Terms:
    """The terms of a task: evaluated one by one, or replayed from a recording of just that.

    Args:
        style: what a motion prior sees, none for none.
        observables: what frames know, by name.
        context: what all frames share.
        horizon: control steps until an episode times out.
        fused: replay a recording once they are often evaluated, see `Recorded`; on the CPU only.
    """

    def __init__(
        self,
        obs: tuple[ObsTerm, ...],
        rewards: tuple[RewardTerm, ...],
        dones: tuple[DoneTerm, ...],
        style: tuple[ObsTerm, ...],
        observables: Mapping[str, Observable],
        context: Context,
        horizon: int,
        device: torch.device,
        fused: bool = True,
    ):
        self.obs, self.rewards, self.dones, self.style = obs, rewards, dones, style
        self.observables, self.context, self.horizon = observables, context, horizon
        self.fused = fused
        # Row 0 weighs the terms for the reward, row 1 for the imitation reward that is reported.
        shares = [[t.weight, t.weight * t.imitation] for t in rewards]
        self._weights = torch.tensor(shares).reshape(-1, 2).T.contiguous().to(device)
        # Which terms count near the reference and which far from it.
        counts = [[t.when != "far", t.when != "near"] for t in rewards]
        self._near, self._far = (
            torch.tensor(counts, dtype=torch.bool).reshape(-1, 2, 1).to(device).unbind(1)
        )
        self._recorded: dict[str, TensorFunction] = {}
        self._plain: dict[str, TensorFunction] = {}
        self._at_once = False
        self._pool: ThreadPoolExecutor | None = None

    def record_at_once(self) -> None:
        """They are recorded when they are next evaluated, seldom or not."""
        self._at_once = True
        self._recorded.clear()

    @property
    def recorded(self) -> frozenset[str]:
        """The names among "observe" and "judge" that are replayed from a recording, see `record`."""
        known = self._recorded.items()
        return frozenset(
            name
            for name, f in known
            if (f.replays if isinstance(f, Recorded) else f is not self._plain[name])
        )

    def frame(self, sources: Mapping[str, Tensor]) -> Frame:
        """What the terms see."""
        return Frame(sources, self.observables, self.context)

    def observe(self, sources: Mapping[str, Tensor]) -> Tensor:
        """The observations `(N, O)`."""
        return self._run("observe", self._observe, sources)[0]

    def judge(self, sources: Mapping[str, Tensor]) -> TermValues:
        """Observations, rewards and failures."""
        worlds = len(sources["age"])
        if not self.fused or worlds < MANY:
            return TermValues(*(x.clone() for x in self._run("judge", self.evaluated, sources)))
        # A recording runs without Python's lock, so that the second half really runs beside the first.
        # Many worlds are always cut, whatever the machine, since it may move the last digit.
        halves = zip(*(x.tensor_split(2) for x in sources.values()), strict=True)
        first, second = (dict(zip(sources, half, strict=True)) for half in halves)
        if "judge" not in self._recorded:
            self._run("judge", self.evaluated, first)
        other = self._helper().submit(self._run, "judge", self.evaluated, second)
        ours, theirs = self._run("judge", self.evaluated, first), other.result()
        obs, scores, ends, style = zip(ours, theirs, strict=True)
        return TermValues(torch.cat(obs), torch.cat(scores, 1), torch.cat(ends, 1), torch.cat(style))

    def _helper(self) -> ThreadPoolExecutor:
        if self._pool is None:
            # One thread for torch in it; without this it would start as many as there are cores.
            self._pool = ThreadPoolExecutor(1, "terms", torch.set_num_threads, (1,))
        return self._pool

    def _observe(self, sources: Mapping[str, Tensor]) -> tuple[Tensor, ...]:
        return (seen_by(self.obs, self.frame(sources)),)

    def evaluated(self, sources: Mapping[str, Tensor]) -> tuple[Tensor, ...]:
        """All terms one by one, in the order of `TermValues`."""
        frame = self.frame(sources)
        rewards = [term.fn(frame, **term.params) for term in self.rewards]
        values = torch.stack(rewards or [frame.phase])[: len(rewards)]
        if frame.point is not None:
            values = torch.where(torch.where(frame.point.far, self._far, self._near), values, 0.0)
        failed = torch.zeros_like(frame.phase, dtype=torch.bool)
        for term in self.dones:
            failed = failed | term.fn(frame, **term.params)
        scores = torch.cat((self._weights @ values, values))
        return seen_by(self.obs, frame), scores, self.ends(frame, failed), seen_by(self.style, frame)

    def ends(self, frame: Frame, failed: Tensor) -> Tensor:
        """`(3, N)` bool, episodes that failed, are terminated and are truncated."""
        # A clip that is done to its end is a finished task, and its remaining return is stated: as many
        # steps like the last as `completion_bonus` says, since with nothing to come the last steps
        # would not matter and characters would fall in them. To bootstrap there would rest on a state
        # with a value that is never learned, and the policy comes to exploit it.
        done = frame.place.end > 0
        if frame.spared is not None:
            failed, done = failed & ~frame.spared, done & ~frame.spared
        terminated = failed | done
        return torch.stack((failed, terminated, (frame.source("age") >= self.horizon) & ~terminated))

    def check(self, sources: Mapping[str, Tensor], worlds: int) -> None:
        """Evaluates every term once, and names one that gives what it must not.

        Raises:
            PoiseError: an observation that is not `(N, k)`, a reward that is not `(N,)`, or a
                termination that is not `(N,)` bool.
        """
        frame = self.frame(sources)
        for kind, terms, ndim in (
            ("observation", (*self.obs, *self.style), 2),
            ("reward", self.rewards, 1),
            ("termination", self.dones, 1),
        ):
            for term in terms:
                value = term.fn(frame, **term.params)
                want = "(N, k)" if ndim == 2 else "(N,) bool" if kind == "termination" else "(N,)"
                good = value.ndim == ndim and len(value) == worlds
                if not good or (kind == "termination") != (value.dtype == torch.bool):
                    got = f"{tuple(value.shape)} {str(value.dtype).removeprefix('torch.')}"
                    raise PoiseError(
                        f"the {kind} '{term.name}' must be {want} for N = {worlds}, got {got}",
                        code="wrong-shape",
                    )
        self.evaluated(sources)

    def _run(
        self,
        name: str,
        plain: Callable[[Mapping[str, Tensor]], tuple[Tensor, ...]],
        sources: Mapping[str, Tensor],
    ) -> tuple[Tensor, ...]:
        if not self.fused:
            return plain(sources)
        if name not in self._recorded:
            names = tuple(sources)

            def flat(*tensors: Tensor) -> tuple[Tensor, ...]:
                return plain(dict(zip(names, tensors, strict=True)))

            given = tuple(sources.values())
            # Many worlds are trained, and two threads need a recording. A program that is called as
            # seldom as when a motion is tried once is sooner done without: both do the same to the bit.
            now = self._at_once or OFTEN == 1 or 2 * len(sources["age"]) >= MANY
            self._plain[name] = flat
            self._recorded[name] = record(flat, given) if now else Recorded(flat)
        return self._recorded[name](*sources.values())
