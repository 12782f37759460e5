"""Data-parallel training: several processes, or two cores of one, that learn as one.

Every process has environments of its own and a copy of the networks. The processes share gradients,
statistics and decisions, so that P processes with N / P environments each do what one process does with
N, up to the order of summation. `torchrun` starts the processes (`joined` finds them).
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, TypeVar

import torch
from safetensors.torch import load as parse_tensors
from safetensors.torch import save as serialise_tensors
from torch import Tensor, nn

from poise.errors import PoiseError
from poise.learn.checkpoint import State, under
from poise.learn.networks import RunningNorm

#: What `torchrun` tells each of its processes.
LAUNCHED = ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")
# Parts of a trainer's state that each process has for itself; the rest is the same in all.
_OWN = ("env/", "generator/noise", "trainer/obs", "trainer/episode_", "style/own/")


class Comm:
    """The processes that learn together: a single one, or those of the default group of
    `torch.distributed`, which must have been initialised.

    All of them make the same calls in the same order; each call waits for the others.

    Attributes:
        rank: of this process, 0 <= rank < size; 0 alone writes files and prints.
        size: number of processes.
        local_size: number of processes on this machine, which share its cores.
    """

    def __init__(self, rank: int = 0, size: int = 1, local_size: int = 1):
        self.rank, self.size, self.local_size = rank, size, local_size

    def sum_(self, x: Tensor) -> Tensor:
        """Replaces `x`, of one shape everywhere, by its sum over the processes; returns it."""
        if self.size > 1:
            torch.distributed.all_reduce(x)
        return x

    def gather(self, data: bytes) -> list[bytes]:
        """On rank 0 the data of every process by rank; elsewhere an empty list."""
        if self.size == 1:
            return [data]
        sizes = torch.zeros(self.size, dtype=torch.int64)
        sizes[self.rank] = len(data)
        self.sum_(sizes)
        width = max(1, int(sizes.max()))
        own = torch.frombuffer(bytearray(data.ljust(width, b"\0")), dtype=torch.uint8)
        parts = [torch.empty_like(own) for _ in range(self.size)] if self.rank == 0 else None
        torch.distributed.gather(own, parts, dst=0)
        return [p[:n].numpy().tobytes() for p, n in zip(parts or (), sizes.tolist(), strict=False)]


#: A single process.
ALONE = Comm()


@contextmanager
def joined() -> Iterator[Comm]:
    """The group that `torchrun` started this process in, or a single process.

    Gloo carries what lies on the CPU and NCCL what lies on a GPU; of several GPUs each process
    takes the one of its local rank.
    """
    if any(name not in os.environ for name in LAUNCHED) or os.environ["WORLD_SIZE"] == "1":
        yield ALONE
        return
    # Its functions have the group that there is when it is imported as a default argument. Imported by
    # an optimizer while there is one, they keep that group and its threads beyond the group's end, and
    # such a thread that gives back a tensor while Python ends aborts the process.
    import torch.distributed.nn

    dist, cuda = torch.distributed, torch.cuda.is_available()
    if cuda:
        torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", "0")) % torch.cuda.device_count())
    try:
        dist.init_process_group("cpu:gloo,cuda:nccl" if cuda else "gloo")
    except (RuntimeError, ValueError) as problem:
        where = f"{os.environ['MASTER_ADDR']}:{os.environ['MASTER_PORT']}"
        reason = str(problem).splitlines()[0] if str(problem) else type(problem).__name__
        hint = "Start all processes with torchrun, and the same --nnodes and --rdzv-endpoint everywhere"
        raise PoiseError(
            f"the processes did not find each other ({reason})", where, hint, code="no-answer"
        ) from None
    try:
        local = int(os.environ.get("LOCAL_WORLD_SIZE", "1"))
        yield Comm(dist.get_rank(), dist.get_world_size(), local)
        # Gloo's threads may still hold tensors of the last call, which they can only give back while
        # Python runs. Waiting for each other lets them, and no process ends while another still sends.
        dist.barrier()
    finally:
        dist.destroy_process_group()


def rank_seed(seed: int, rank: int) -> int:
    """A seed for each process, made from one: rank 0 keeps it, so that one process stays as it was."""
    if rank == 0:
        return seed
    digest = hashlib.sha256(f"{seed}:rank {rank}".encode()).digest()
    return int.from_bytes(digest[:4], "little") >> 1


def share_of(total: int, comm: Comm) -> int:
    """This process's part of `total` environments.

    Raises:
        PoiseError: the number of processes does not divide them.
    """
    if total % comm.size:
        fits = max(comm.size, total - total % comm.size)
        raise PoiseError(
            f"{total} environments cannot be dealt out evenly to {comm.size} processes",
            hint=f"Use --envs {fits}",
            code="not-a-multiple",
        )
    return total // comm.size


# --- numbers -----------------------------------------------------------------------------------


def any_of(comm: Comm, flag: bool) -> bool:
    """Whether it is so in any process."""
    return flag if comm.size == 1 else bool(comm.sum_(torch.tensor(int(flag))))


def sums(comm: Comm, values: Sequence[float]) -> list[float]:
    """Each number summed over the processes."""
    if comm.size == 1:
        return list(values)
    return comm.sum_(torch.tensor(values, dtype=torch.float64)).tolist()


def moments(comm: Comm, x: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and unbiased deviation over all entries of `x` in all processes."""
    if comm.size == 1:
        return x.mean(), x.std()
    wide = x.double()
    total = comm.sum_(torch.stack([wide.sum(), wide.new_tensor(x.numel())]))
    mean = total[0] / total[1]
    square = comm.sum_((wide - mean).square().sum())
    return mean.to(x.dtype), (square / (total[1] - 1)).sqrt().to(x.dtype)


def average_gradients(comm: Comm, params: Iterable[nn.Parameter]) -> None:
    """Replaces the gradients by their mean over the processes, through one flat buffer."""
    if comm.size == 1:
        return
    grads = [p.grad for p in params if p.grad is not None]
    flat = comm.sum_(torch.cat([g.reshape(-1) for g in grads])).div_(comm.size)
    parts = flat.split([g.numel() for g in grads])
    torch._foreach_copy_(grads, [part.view_as(g) for part, g in zip(parts, grads, strict=True)])


@contextmanager
def shared_statistics(comm: Comm, norm: RunningNorm) -> Iterator[None]:
    """What `norm` observes inside the block counts in every process; nothing else may change it.

    If the block fails, it must fail in all processes, and the statistics are those from before.
    """
    if comm.size == 1:
        yield
        return
    held = (norm.count, norm.mean, norm.m2)
    before = [x.clone() for x in held]
    for x in held:
        x.zero_()
    try:
        yield
        count, mean, m2 = (x.clone() for x in held)
    finally:
        for x, old in zip(held, before, strict=True):
            x.copy_(old)
    # n = sum n_r;  mean = sum n_r mean_r / n;  M2 = sum M2_r + n_r (mean_r - mean)^2
    total = comm.sum_(torch.cat([count.view(1), count * mean]))
    if float(total[0]) == 0:
        return
    middle = total[1:] / total[0]
    norm.merge(float(total[0]), middle, comm.sum_(m2 + count * (mean - middle).square()))


# --- decisions and states ----------------------------------------------------------------------


@contextmanager
def together(comm: Comm, error: type[PoiseError] = PoiseError) -> Iterator[None]:
    """Either every process leaves the block, or each one raises.

    The process that failed raises its own exception, the others `error`; on rank 0 it names the
    first process that failed and what it said.
    """
    if comm.size == 1:
        yield
        return
    problem: Exception | None = None
    try:
        yield
    except Exception as failure:
        problem = failure
    if any_of(comm, problem is not None):
        said = comm.gather(b"" if problem is None else (str(problem) or repr(problem)).encode())
        if problem is not None:
            raise problem
        rank, text = next(((r, t) for r, t in enumerate(said) if t), (None, b""))
        lost = "another process" if rank is None else f"process {rank}"
        because = f" ({text.decode()})" if text else ""
        raise error(f"{lost} stopped{because}", code="process-stopped")


def gather_state(comm: Comm, state: State) -> State:
    """On rank 0 the state with all processes' own parts, as "rank<r>/..."; elsewhere as it was."""
    if comm.size == 1:
        return state
    own = {k: v.detach().cpu().contiguous() for k, v in state.items() if k.startswith(_OWN)}
    out = dict(state)
    for rank, data in enumerate(comm.gather(serialise_tensors(own) if comm.rank else b"")):
        if rank:
            out |= {f"rank{rank}/{k}": v for k, v in parse_tensors(data).items()}
    return out


def own_state(comm: Comm, state: Mapping[str, Tensor]) -> Mapping[str, Tensor]:
    """This process's state out of what `gather_state` gave on rank 0."""
    return {**state, **under(f"rank{comm.rank}", state)} if comm.rank else state


def noise_name(comm: Comm) -> str:
    """The purpose for which this process's generator of action noise is made."""
    return f"noise {comm.rank}" if comm.rank else "noise"


T = TypeVar("T")

#: Products of rows and weights from which a minibatch is worth two threads.
WORTH = 100_000_000


class ThreadedUpdate:
    """Starts work in threads of their own, made when the first is asked for."""

    def __init__(self) -> None:
        self._pool: ThreadPoolExecutor | None = None

    def __call__(self, parallel: bool, work: Callable[..., T], *args: Any) -> Callable[[], T]:
        """Starts `work`, or does it at once where not `parallel`; gives what waits for its result."""
        if not parallel:
            result = work(*args)
            return lambda: result
        if self._pool is None:
            # One for the critic, one for the second part of the policy's minibatch.
            self._pool = ThreadPoolExecutor(2, "update", torch.set_num_threads, (1,))
        return self._pool.submit(work, *args).result


def parts_of(index: Tensor, weights: int, processes: int) -> tuple[Tensor, ...]:
    """A minibatch's rows in the parts of which gradients are computed apart, by whichever thread.

    So a sum is of the same numbers with one thread and with two. On a GPU, in one of several processes
    and of little work it is one part.
    """
    whole = index.device.type != "cpu" or processes > 1 or index.numel() * weights < WORTH
    return (index,) if whole else index.tensor_split(2)


def mean_gradient(
    parts: Sequence[Tensor],
    params: Sequence[nn.Parameter],
    loss_and_terms: Callable[[Tensor], tuple[Tensor, Tensor]],
    beside: ThreadedUpdate,
    parallel: bool,
) -> Tensor:
    """Fills `params` with the gradient of the mean loss over all rows of `parts`; the mean terms `(K,)`.

    loss_and_terms: of some rows, the mean loss with a gradient and terms without.
    """
    rows = sum(part.numel() for part in parts)

    def part_of(index: Tensor) -> tuple[tuple[Tensor | None, ...], Tensor]:
        loss, terms = loss_and_terms(index)
        share = index.numel() / rows
        return torch.autograd.grad(loss * share, params, allow_unused=True), terms * share

    others = [beside(parallel, part_of, part) for part in parts[1:]]
    try:
        gradient, terms = part_of(parts[0])
    finally:
        # No thread outlives the step.
        found = [other() for other in others]
    for param, value in zip(params, gradient, strict=True):
        param.grad = value
    for more, their_terms in found:
        for mine, theirs in zip(gradient, more, strict=True):
            if mine is not None and theirs is not None:
                mine.add_(theirs)
        terms = terms + their_terms
    return terms
