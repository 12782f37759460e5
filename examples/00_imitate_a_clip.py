"""A clip in, the same motion simulated out: `python examples/00_imitate_a_clip.py [CLIP] [FOLDER]`.

What `poise imitate` does, in Python. One minute of training is enough to see the walk come alive.
"""

import sys
from pathlib import Path

import poise
from poise.jobs.deliver import deliver
from poise.jobs.runs import begin, evaluate, learning_curve, train, trained_policy
from poise.learn import Until
from poise.motion import ClipLibrary
from poise.motion.io import read_clip
from poise.recipes.residual_force import ResidualForce

clip_path = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(poise.__file__).parent / "data" / "walk.bvh"
out = Path(sys.argv[2]) if len(sys.argv) > 2 else Path("out")

clip = read_clip(clip_path)
config = ResidualForce(method="rfc-implicit")
imitation = begin(out / "run", ClipLibrary.of(clip), config)
train(imitation, out / "run", Until(minutes=1.0))
policy, meta = trained_policy(out / "run", imitation)
evaluation = evaluate(imitation, policy, meta)
paths = deliver(imitation, evaluation, out, learning_curve(out / "run"))

card = evaluation.card
sys.stdout.write(
    f"success {card.succ:.0%} ({card.succ_rule}), joint error {card.mpjpe_mm:.0f} mm, help "
    f"{card.help.force_mean_n:.1f} N = {card.help.share_of_body_weight:.1%} of body weight\n"
    f"open {paths['report']}\n"
)
