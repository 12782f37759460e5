"""Scenes in which a character gives way, one file each."""

from poise.env.scenes.door import Doorway
from poise.env.scenes.hands import Hands
from poise.env.scenes.pull import Pull
from poise.env.scenes.stage import PlayScene, Stage, hand_of
from poise.env.scenes.throws import Throws

#: The scenes by their names.
SCENES: dict[str, type[PlayScene]] = {"throws": Throws, "pull": Pull, "hands": Hands, "door": Doorway}

__all__ = ["SCENES", "Doorway", "Hands", "PlayScene", "Pull", "Stage", "Throws", "hand_of"]
