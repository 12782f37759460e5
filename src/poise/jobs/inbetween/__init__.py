"""In-betweening networks from a folder of clips."""

from poise.jobs.inbetween.training import (
    FRAMES,
    RECIPE,
    RUN_FILE,
    Inbetween,
    Task,
    as_model,
    begin,
    example_of,
    prepare,
    small,
    steps_in,
    train,
    validation,
)

__all__ = [
    "FRAMES",
    "RECIPE",
    "RUN_FILE",
    "Inbetween",
    "Task",
    "as_model",
    "begin",
    "example_of",
    "prepare",
    "small",
    "steps_in",
    "train",
    "validation",
]
