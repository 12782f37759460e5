"""How torch uses the cores while worlds step, and that nobody else notices."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch

from poise.machine import one_thread


@pytest.fixture(autouse=True)
def two_threads(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Torch as `import poise` leaves it on two cores."""
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def test_within_it_is_one_and_afterwards_what_it_was() -> None:
    with one_thread():
        assert torch.get_num_threads() == 1
        with one_thread():
            assert torch.get_num_threads() == 1
        # The inner one ends nothing.
        assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == 2


def test_an_error_leaves_nothing_behind() -> None:
    with pytest.raises(ValueError, match="within"), one_thread():
        raise ValueError("within")
    assert torch.get_num_threads() == 2


def test_a_function_may_call_itself() -> None:
    @one_thread()
    def down(n: int) -> list[int]:
        return [torch.get_num_threads(), *(down(n - 1) if n else [])]

    assert down(2) == [1, 1, 1] and torch.get_num_threads() == 2


def test_what_the_user_states_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    with one_thread():
        assert torch.get_num_threads() == 2
