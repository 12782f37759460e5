"""Environments over the small human."""

from toy_envs import make_env, make_phc, make_task  # noqa: F401
