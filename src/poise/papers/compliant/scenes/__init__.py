"""Scenes in which a character gives way, one file each."""

from poise.papers.compliant.scenes.ball import Balance
from poise.papers.compliant.scenes.body_scenes import Chicken, Hands, Pull, Throws, Trampoline
from poise.papers.compliant.scenes.door import Doorway
from poise.papers.compliant.scenes.stage import PlayScene, Stage, hand_of

#: The scenes by their names.
SCENES: dict[str, type[PlayScene]] = {
    "throws": Throws, "pull": Pull, "hands": Hands, "door": Doorway, "trampoline": Trampoline,
    "ball": Balance, "chicken": Chicken,
}  # fmt: skip

__all__ = [
    "SCENES",
    "Balance",
    "Chicken",
    "Doorway",
    "Hands",
    "PlayScene",
    "Pull",
    "Stage",
    "Throws",
    "Trampoline",
    "hand_of",
]
