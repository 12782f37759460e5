"""Environments over the small human, whose terms are recorded at the first step."""

import pytest

from toy_envs import make_env, make_phc, make_task  # noqa: F401


@pytest.fixture(autouse=True)
def recorded_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("poise.env.evaluate.OFTEN", 1)
