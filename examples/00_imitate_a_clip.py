"""A clip in, the same motion simulated out: `python examples/00_imitate_a_clip.py [CLIP] [FOLDER]`.

What `poise imitate` does, in Python. One minute of training is enough to see the walk come alive.
"""

import sys
from pathlib import Path

import poise

clip = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(poise.__file__).parent / "data" / "walk.bvh"
out = Path(sys.argv[2]) if len(sys.argv) > 2 else Path("out")

made = poise.imitate(clip, minutes=1.0, folder=out)
paths = made.save(out)

card = made.card
sys.stdout.write(
    f"success {card.succ:.0%} ({card.succ_rule}), joint error {card.mpjpe_mm:.0f} mm, help "
    f"{card.help.force_mean_n:.1f} N = {card.help.share_of_body_weight:.1%} of body weight\n"
    f"open {paths['report']}\n"
)
