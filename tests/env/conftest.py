"""Environments over the small human."""

from toy_envs import make_task, make_phc, make_env  # noqa: F401
