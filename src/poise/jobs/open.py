"""Opening what was trained: a run folder, a result with one inside, a policy file, a network's file.

run = open_run("out")                 # what `poise imitate walk.bvh -o out` wrote
run.card, run.clip(), run.evaluate(help_limit=0.0)
open_run().tracker                    # the policy that comes with Poise
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from poise.env.recovery.get_up import RecoveryClips
from poise.errors import PoiseError, did_you_mean
from poise.jobs.deliver import Evaluation
from poise.jobs.perpetual import perpetual_run
from poise.jobs.run_file import (
    FINAL,
    RUN_FILE,
    InbetweenMeta,
    RunFile,
    RunMeta,
    learning_curve,
    policy_for,
    run_folder,
)
from poise.jobs.runs import evaluate, score, trained_policy, transitions
from poise.jobs.tracker import POLICIES, SHIPPED, Tracker, check_policy_file, load_tracker
from poise.learn import LATEST, PolicyBundle, Value, load_checkpoint
from poise.learn.checkpoint import under
from poise.learn.inbetween_model import MODEL, InbetweenModel, load_model
from poise.recipes.perpetual import RECIPE
from poise.recipes.perpetual import RECIPE as PERPETUAL
from poise.recipes.perpetual_settings import Perpetual
from poise.recipes.perpetual_settings import config_of as perpetual_config
from poise.recipes.residual_force import RECIPE as RESIDUAL_FORCE
from poise.recipes.residual_force import build
from poise.recipes.residual_force_settings import config_of
from poise.settings import check_data, from_data
from poise.version import __version__

if TYPE_CHECKING:
    import numpy as np

    from poise.motion import Clip
    from poise.recipes.imitation import Imitation
    from poise.score import ScoreCard, Transitions

#: The name of the recipe of in-betweening networks.
INBETWEEN = "inbetween"


@dataclass(eq=False, repr=False)
class Run:
    """What was trained, opened; everything in it is read or built when it is asked for.

    path: the run folder, or the file. recipe: "residual-force", "perpetual" or "inbetween". config: the
    recipe's settings, None in the file of an in-betweening network.
    """

    path: Path
    recipe: str
    config: Any
    file: RunFile | None = None

    def __repr__(self) -> str:
        return f"Run({str(self.path)!r}, {self.recipe})"

    @cached_property
    def task(self) -> Imitation:
        """The task as the latest policy knows it, rebuilt from the run's own clips.

        Raises:
            PoiseError: a policy or network file, which holds no clips.
        """
        if self.file is None or self.recipe == INBETWEEN:
            raise PoiseError(
                "it holds no clips to simulate", self.path, "Give the folder of a run", code="not-a-run"
            )
        if self.recipe == PERPETUAL["name"]:
            return perpetual_run.reopen(self.file)
        return build(self.file.library(), self.config)

    @property
    def policy(self) -> PolicyBundle:
        """The latest policy; it acts deterministically on raw observations."""
        return self.tracker.policy if self.file is None else self.trained[0]

    @cached_property
    def trained(self) -> tuple[PolicyBundle, dict[str, Any]]:
        """The latest policy and what its checkpoint says, "help_limit" among it: N that it was left."""
        return trained_policy(self.path, self.task)

    @cached_property
    def tracker(self) -> Tracker:
        """The policy with its body, which tracks any motion.

        Raises:
            PoiseError: a run of another recipe, or nothing was trained in it.
        """
        if self.recipe == INBETWEEN:
            raise PoiseError(
                "it holds a network that fills keyframes, and no policy",
                self.path,
                code="wrong-file-kind",
            )
        return load_tracker(self.path) if self.file is None else policy_of_run(self.file)

    @cached_property
    def model(self) -> InbetweenModel:
        """The network that fills keyframes.

        Raises:
            PoiseError: a run of another recipe, or nothing was trained in it.
        """
        if self.recipe != INBETWEEN:
            hint = "Give a run of poise train inbetween"
            raise PoiseError(
                "it holds a policy, and no network that fills keyframes",
                self.path,
                hint,
                code="wrong-file-kind",
            )
        return load_model(self.path)

    def evaluate(
        self,
        rule: str = "phc",
        help_limit: float | None = None,
        most: int | None = None,
        device: str = "cpu",
    ) -> Evaluation:
        """Simulates start frames of the run's clips to their ends, see `runs.evaluate`."""
        return evaluate(self.task, *self.trained, rule, help_limit, most, device)

    def score(
        self,
        rule: str = "phc",
        help_limit: float | None = None,
        device: str = "cpu",
        starts: int = 1,
    ) -> ScoreCard:
        """The score card of `evaluate`, also of large libraries, beside that of doing nothing.

        Args:
            starts: how many times every episode is begun, each perturbed, see `runs.score`.
        """
        return score(self.task, *self.trained, rule, help_limit, device, starts)

    @cached_property
    def card(self) -> ScoreCard:
        """The score card of all start frames, simulated when it is first asked for."""
        return self.score()

    def episode(self, clip: int | str = 0, frame: int = 0) -> Evaluation:
        """One episode of a clip (its number or name) from one of its control frames."""
        names = self.task.library.names
        if isinstance(clip, str):
            if clip not in names:
                raise PoiseError(
                    f"the run has no clip '{clip}'. {did_you_mean(clip, names)}",
                    self.path,
                    code="unknown-clip",
                )
            clip = names.index(clip)
        if not 0 <= clip < len(names):
            raise PoiseError(
                f"the run has clips 0 to {len(names) - 1}, got {clip}", self.path, code="index-outside"
            )
        if not 0 <= frame < int(self.task.reference.length[clip]) - 1:
            raise PoiseError(
                f"'{names[clip]}' has no step after its frame {frame}", self.path, code="frame-outside"
            )
        starts = torch.tensor([clip]), torch.tensor([frame])
        return evaluate(self.task, *self.trained, starts=starts)

    def clip(self, clip: int | str = 0) -> Clip:
        """The simulated motion of one of the run's clips on the skeleton that it came on, as high as
        there."""
        from poise.jobs.deliver import as_high_as_source, simulated_clip

        episode = self.episode(clip)
        made = simulated_clip(self.task, episode)
        return as_high_as_source(made, self.task, episode.recordings[0].clip)

    def transitions(
        self,
        most: int | None = 32,
        help_limit: float | None = None,
        noise: float = 0.0,
        seed: int = 0,
        device: str = "cpu",
    ) -> Transitions:
        """Every step of episodes: observations, actions, rewards, ends; see `Transitions.save`.

        Args:
            most: start frames, evenly spread over the clips; None takes all.
            help_limit: as for `evaluate`.
            noise, seed: one deviation of what is added to each action, and where it is drawn from.
        """
        return transitions(self.task, *self.trained, help_limit, most, noise, seed, device)

    @property
    def curve(self) -> dict[str, np.ndarray]:
        """The columns of the learning curve by name; empty where nothing was logged."""
        return learning_curve(self.path) if self.path.is_dir() else {}


def open_run(path: Path | str | None = None) -> Run:
    """What was trained in a folder or a file; without a path the policy that comes with Poise.

    Args:
        path: a run folder, a result folder with one in it, a policy file, or an in-betweening network;
            or "keypoints", the policy that is told places alone, where no file has that name.

    Raises:
        PoiseError: there is nothing, it is damaged, or it is something else.
    """
    named, path = None if path is None else str(path), SHIPPED if path is None else Path(path)
    if named in POLICIES and not path.exists():
        path = POLICIES[named]
    if path.is_dir() and not (path / RUN_FILE).exists() and (path / MODEL).exists():
        path = path / MODEL
    if not path.exists():
        hint = f"Give the folder of a run or a result, a policy file, or {', '.join(POLICIES)}"
        raise PoiseError("there is no such file or folder", path, hint, code="file-missing")
    if path.is_dir():
        return _folder(run_folder(path))
    _, meta = load_checkpoint(path)
    if meta.get("kind") == "inbetween model":
        return Run(path, INBETWEEN, None)
    check_policy_file(meta, path)
    return Run(path, PERPETUAL["name"], perpetual_config(meta["config"], path))


def _folder(folder: Path) -> Run:
    path = folder / RUN_FILE
    tensors, meta = load_checkpoint(path)
    if meta.get("kind") == "inbetween run":
        # It takes longer to import than a policy takes to open.
        from poise.jobs.inbetween.inbetween_settings import Inbetween

        check_data(InbetweenMeta, meta, path)
        return Run(folder, INBETWEEN, from_data(Inbetween, meta["config"], path))
    check_data(RunMeta, meta, path)
    file = RunFile(path, meta, tensors)
    known = {PERPETUAL["name"]: perpetual_config, RESIDUAL_FORCE["name"]: config_of}
    if file.recipe not in known:
        own = file.recipe in ("compliant-imitation", "dual-policy")
        hint = "Runs of it are for poise play and poise eval" if own else None
        raise PoiseError(
            f"there is no recipe '{json.dumps(file.recipe)[1:-1][:40]}' here",
            path,
            hint,
            code="unknown-recipe",
        )
    return Run(folder, file.recipe, known[file.recipe](meta["config"], path), file)


def policy_of_run(file: RunFile) -> Tracker:
    """The latest policy of a run of `poise train perpetual`.

    Its body stands in the run file; where that is of an earlier version it is made from all clips again.

    Raises:
        PoiseError: a run of another recipe, or nothing was trained in it.
    """
    folder = file.path.parent
    if file.recipe != RECIPE["name"]:
        raise PoiseError(
            "its policy knows only the clips that it was trained on, and cannot track others",
            folder,
            "Give the run of poise train perpetual, or imitate the clip with poise imitate",
            code="policy-of-own-clips",
        )
    config, example = perpetual_config(file.meta["config"], file.path), file.library().clips[0]
    humanoid = None if config.body.mjcf else file.body(example.skeleton)
    if humanoid is None:
        made = perpetual_run.reopen(file)
        humanoid, example, names = made.humanoid, made.library.clips[0], made.library.names
        config, known = made.config, made.recovery_clips
    else:
        told, names = under(perpetual_run.WAYS, file.tensors), file.meta["body"]["names"]
        known = RecoveryClips.of(told) if told else None
        if known is None:
            # As in a task that is built, see `recipes.perpetual.build`.
            config = replace(config, recovering=replace(config.recovering, primitive="own"))
        if config.recovery and not perpetual_run.knows_recovery(folder):
            config, known = replace(config, recovery=False), None
    earlier = file.earlier
    policy, said = policy_for(folder, humanoid, config.help_start)
    inner: Mapping[str, Any] = said.get("metadata", {})
    about = {
        "clips": list(names),
        "stage": inner.get("stage") or inner.get("course", {}).get("stage", {}).get("kind", ""),
        "finished": (folder / FINAL).exists(),
        # With what the policy had cost that the run went on from.
        "samples": int(said.get("samples", 0)) + earlier["samples"],
        "seconds": float(said.get("seconds", 0.0)) + earlier["seconds"],
        "help_n": float(said["help_limit"]),
        "poise": __version__,
    }
    return Tracker(policy, humanoid, example, config, about, known, value_of_run(folder, policy, config))


def value_of_run(folder: Path, policy: PolicyBundle, config: Perpetual) -> Value | None:
    """The critic of a run's last checkpoint, None where there is none."""
    path = folder / LATEST
    if not path.exists():
        return None
    state = load_checkpoint(path)[0]
    return Value(policy, state, config.ppo.activation) if "critic/layers.0.weight" in state else None
