"""Scenes in which a character gives way, one file each."""

from poise.papers.compliant.scenes.ball import Balance
from poise.papers.compliant.scenes.body_scenes import (
    Chicken,
    HandInHand,
    PullScene,
    Throws,
    TrampolineScene,
)
from poise.papers.compliant.scenes.door import DoorScene
from poise.papers.compliant.scenes.stage import PlayScene, SceneSetup, hand_of

#: The scenes by their names.
SCENES: dict[str, type[PlayScene]] = {
    "throws": Throws,
    "pull": PullScene,
    "hands": HandInHand,
    "door": DoorScene,
    "trampoline": TrampolineScene,
    "ball": Balance,
    "chicken": Chicken,
}

__all__ = [
    "SCENES",
    "Balance",
    "Chicken",
    "DoorScene",
    "HandInHand",
    "PlayScene",
    "PullScene",
    "SceneSetup",
    "Throws",
    "TrampolineScene",
    "hand_of",
]
