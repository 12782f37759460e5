"""Scenes in which a character gives way, one file each."""

from poise.env.scenes.ball import Balance
from poise.env.scenes.chicken import Chicken
from poise.env.scenes.door import Doorway
from poise.env.scenes.hands import Hands
from poise.env.scenes.pull import Pull
from poise.env.scenes.stage import PlayScene, Stage, hand_of
from poise.env.scenes.throws import Throws
from poise.env.scenes.trampoline import Trampoline

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
