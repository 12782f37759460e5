"""How long the expert is cloned: by the frames of the library."""

from __future__ import annotations

from math import ceil

from poise.learn import CloneConfig

#: Control steps that the clone sees of each frame of the library, and the most in all: a step is kept as
#: 4 bytes for every number of observation and action, 3.4 kB for 20 bodies, so 2.2 GB.
PER_FRAME, MOST = 16, 640_000
#: The same for the LQR teacher: its feedback takes more to learn.
PER_FRAME_OF_PATHS, MOST_OF_PATHS = 60, 1_000_000
#: From so many control steps on, more rounds are of more use than more steps in each.
MANY = 200_000
#: Worlds for which `CloneConfig` states its steps; in more of them fewer do.
USUAL = 512


def clone_for(frames: int, worlds: int, paths: bool = False) -> CloneConfig:
    """The settings of cloning for a library of `frames` at the control rate, in so many `worlds`.

    Never less than `CloneConfig`'s own 56 steps in 3 rounds, which are 115,000 control steps in 512
    worlds and enough for some minutes of motion. A library of 31,000 frames gets 496,000 in 6 rounds: 4
    times as many, over which the regression takes 5 times as long.

    paths: the teacher is an LQR teacher on optimised trajectories and must stay near to them: less
        noise, more steps.
    """
    each, most = (PER_FRAME_OF_PATHS, MOST_OF_PATHS) if paths else (PER_FRAME, MOST)
    plain, wanted = CloneConfig(), min(each * frames, most)
    if wanted <= MANY:
        rounds, epochs = plain.rounds, plain.epochs
    else:
        rounds, epochs = 5, (6, 3)
    steps = ceil(wanted / ((rounds + 1) * worlds))
    noise = (0.0, 0.5, 1.0) if paths else plain.noise
    least = ceil(plain.steps * min(1.0, USUAL / worlds))
    return CloneConfig(steps=max(least, steps), rounds=rounds, epochs=epochs, noise=noise)
