"""Whether so many characters fit into memory, before any of them is made."""

from __future__ import annotations

from pathlib import Path

from poise.errors import PoiseError

#: Fewer characters than these fit anywhere, so that nothing is worked out for them.
FEW = 10_000
#: Share of the free memory that may be taken.
SHARE = 0.8


def free_bytes(root: Path = Path("/")) -> int | None:
    """Memory that this process may still take, None where the system does not say.

    The least of what the machine has available and what is left of the limit of a container.
    """
    found: list[int] = []
    try:
        lines = (root / "proc/meminfo").read_text().splitlines()
        found += [1024 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")]
    except (OSError, ValueError, IndexError):
        pass
    group = root / "sys/fs/cgroup"
    try:
        limit = int((group / "memory.max").read_text())
        found.append(limit - int((group / "memory.current").read_text()))
    except (OSError, ValueError):
        # Without a limit the file says "max".
        pass
    return min(found) if found else None


def learner_bytes(horizon: int, num_obs: int, num_actions: int) -> int:
    """Bytes per character that one batch of experience takes while PPO learns from it."""
    # Observations as collected, their half-precision copy, actions and means, about a dozen numbers.
    return horizon * (6 * num_obs + 8 * num_actions + 48) + 16 * num_obs


def check_memory(num_envs: int, bytes_each: int, free: int | None) -> None:
    """Refuses more characters than fit, and says how many do.

    Raises:
        PoiseError: `num_envs` times `bytes_each` is more than `SHARE` of the `free` bytes.
    """
    if free is None or num_envs * bytes_each <= SHARE * free:
        return
    fit = max(1, int(SHARE * free / bytes_each))
    raise PoiseError(
        f"{num_envs:,} characters would take about {num_envs * bytes_each / 1e9:.1f} GB of memory, and "
        f"{free / 1e9:.1f} GB are free",
        hint=f"At most {fit:,} fit: use --envs {fit}",
    )
