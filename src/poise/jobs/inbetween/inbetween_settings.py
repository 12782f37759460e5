"""The settings of an in-betweening network's training, see `jobs.inbetween.inbetween_training`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

from poise.settings import Checked, part

if TYPE_CHECKING:
    from poise.jobs.library.clips import LibraryConfig
    from poise.learn.between import BetweenConfig, BetweenTraining
    from poise.score.gaps import Protocol

Contacts = Literal["harvey", "two-stage", "floor"]


@dataclass(frozen=True)
class Inbetween(Checked):
    """Settings of one network's training.

    Attributes:
        net: transformer or rtn.
        seed: seed of everything random.
        final, validation: regular expressions in the names of clips that are kept apart (see
            `score.gaps.Protocol`); final clips are never read by training or choices.
        contacts: the labels that the network learns: Harvey et al.'s or Skeleton2Humanoid's, which tell
            from steps alone, or "floor", of slow feet near it, for recordings with sliding feet.
        ema: of the averaged weights that are used.
        mirror: whether it learns from every clip in a mirror, too.
        stretch: windows are drawn up to so many times faster and slower than recorded.
        onto: a motion file; `library_of` brings all clips onto its skeleton and cuts what no character
            can do alone on a floor.
        reading: how it reads them; given alone, all come onto the skeleton that most seconds are on. By
            default clips of the most common skeleton are taken as they are.
    """

    net: Literal["transformer", "rtn"] = "transformer"
    name: str = "library"
    final: str = r"(?!)"
    validation: str | None = None
    contacts: Contacts = "floor"
    fps: float = 30.0
    seed: int = 0
    ema: float = 0.999
    mirror: bool = False
    stretch: float = 1.0
    onto: str | None = None
    reading: LibraryConfig | None = part("poise.jobs.library.clips:LibraryConfig", made=False)
    between: BetweenConfig = part("poise.learn.between:BetweenConfig")
    between_training: BetweenTraining = part("poise.learn.between:BetweenTraining")
    rtn: Any = part("poise.papers.skeleton2humanoid.rtn:RTNConfig")
    rtn_training: Any = part("poise.papers.skeleton2humanoid.rtn:RTNTraining")

    @classmethod
    def paper(cls, **changes: Any) -> Inbetween:
        """Harvey et al. 2020 on LAFAN1 as stated, with the loss of Skeleton2Humanoid's Eq. 3.

        Its alpha is stated nowhere and neither is the width of the LSTM; both are ours.
        """
        from poise.score.gaps import LAFAN1

        plain = cls()
        own: dict[str, Any] = {
            "net": "rtn",
            "name": LAFAN1.name,
            "final": LAFAN1.final,
            "contacts": "harvey",
            "fps": 30.0,
            "ema": 0.0,
            "mirror": False,
            "stretch": 1.0,
            "rtn": replace(
                plain.rtn, encoder=(512, 256), decoder=(512, 256), past=10, longest=30, noise=0.5
            ),
            "rtn_training": replace(
                plain.rtn_training,
                batch=32,
                lr=1e-3,
                decay=False,
                shortest=5,
                quat=1.0,
                pos=1.0,
                root=0.5,
                contact=0.1,
                adversarial=0.1,
                equalise=True,
                products="float32",
            ),
        }
        return cls(**(own | changes))

    @classmethod
    def code(cls, **changes: Any) -> Inbetween:
        """The same as public re-implementations have it: an LSTM of 768 units, clips in a mirror, too,
        an adversarial weight of 0.01, and gradients scaled down to 1.

        Neither paper has published code of its training. Not expressed: critics with windows other
        than 10 and 2 frames, and their other weights of losses, on which they disagree.
        """
        own = cls.paper()
        rtn, how = (
            replace(own.rtn, hidden=768),
            replace(own.rtn_training, adversarial=0.01, grad_norm=1.0, equalise=False),
        )
        return replace(own, **({"mirror": True, "rtn": rtn, "rtn_training": how} | changes))

    @property
    def protocol(self) -> Protocol:
        """The split and the windows by which it is scored."""
        from poise.score.gaps import Protocol

        return Protocol(self.name, self.final, self.validation)

    @property
    def batch(self) -> int:
        """Windows per step."""
        return (self.between_training if self.net == "transformer" else self.rtn_training).batch

    @property
    def longest(self) -> int:
        """The longest gap that is trained."""
        return self.between_training.longest if self.net == "transformer" else self.rtn.longest


def small(config: Inbetween) -> Inbetween:
    """A network that trains in minutes, for trials and tests."""
    from poise.learn.between import BetweenConfig

    return replace(
        config,
        between=BetweenConfig(width=64, layers=2, heads=4, feedforward=128, latent=4),
        rtn=replace(config.rtn, hidden=64, encoder=(64, 32), decoder=(64, 32)),
    )
