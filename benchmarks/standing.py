"""Bodies of many skeletons and sizes stand under their servos alone and replay their own clips.

    python benchmarks/standing.py --data FOLDER [--seconds 10] [--only PART]

FOLDER is the data folder with `INDEX.tsv`. Nothing helps: the servos' targets are the angles of
`relaxed_stance`, 60 Hz physics as in training. Writes `standing.json` and `standing.md` here.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import torch
from speed.standing import measure, scaled, table_lines

from poise.body import generate_table
from poise.formats import read_clip
from poise.motion import Clip

#: Skeletons of as many makers: name, clip, its skeleton file.
CLIPS = {
    "CMU ASF": ("cmu_amc/rfc/90_02.amc", "cmu_amc/rfc/08.asf"),
    "LAFAN1": ("lafan1_bvh/walk4_subject1.bvh", ""),
    "Bandai Namco": ("other/bandai_bvh/dataset-1_walk_normal_001.bvh", ""),
    "acRNN salsa": ("cmu_bvh/acrnn_salsa/01.bvh", ""),
    "dance001": ("cmu_bvh/ad/dance001.bvh", ""),
    "CMU BVH, jumping jacks": ("cmu_bvh/ad/jumping_jacks.bvh", ""),
    "back handspring": ("cmu_bvh/ad/back_handspring1_autolabel.bvh", ""),
    "Rokoko video": ("noisy/rokoko_video/jesse_dance.bvh", ""),
    "MASS": ("other/mass_bvh/walk.bvh", ""),
    "Xsens": ("other/xsens_bvh/251021_04_boxing_120Hz_cm_3DsMax.bvh", ""),
    "DeepMimic": ("deepmimic_txt/humanoid3d_walk.txt", ""),
}
#: One skeleton at these heights, m.
SIZED, HEIGHTS = "LAFAN1", (0.9, 1.2, 1.8, 2.5, 3.5)
COLUMNS = (
    *(("joints", "joints"), ("bodies", "bodies"), ("hinges", "hinges"), ("mass_kg", "kg")),
    *(
        ("height_m", "m"),
        ("stood_s", "stood, s"),
        ("drop_mm", "pelvis drop, mm"),
        ("sway_mm", "sway, mm"),
    ),
    *(("stance_margin_mm", "margin, mm"), ("margin_mm", "least margin, mm"), ("frames", "frames")),
    *(("fitted_sink_mm", "reference sinks, mm"), ("sink_mm", "replay sinks, mm")),
    *(("lifted_mm", "lifted more, mm"), ("joints_mm", "joints off, mm")),
)
_HERE = Path(__file__).parent


def load(data: Path, name: str) -> Clip:
    """One of `CLIPS`."""
    path, asf = CLIPS[name]
    return read_clip(data / path, skeleton=data / asf if asf else None)


def main() -> None:
    torch.set_num_threads(1)
    parser = argparse.ArgumentParser(description="Standing bodies")
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--only", default="")
    arguments = parser.parse_args()
    skeletons, sizes = {}, {}
    for name in CLIPS:
        if arguments.only in name:
            skeletons[name] = measure(load(arguments.data, name), arguments.seconds)
            print("\n".join(table_lines({name: skeletons[name]}, COLUMNS)[2:]), flush=True)
    if arguments.only in SIZED:
        clip = load(arguments.data, SIZED)
        height = generate_table(clip.skeleton, None, [clip]).height_m
        for metres in HEIGHTS:
            name = f"{SIZED} at {metres:g} m"
            sizes[name] = measure(scaled(clip, metres / height), arguments.seconds)
            print("\n".join(table_lines({name: sizes[name]}, COLUMNS)[2:]), flush=True)
    if arguments.only:
        return
    result = {"command": "python benchmarks/standing.py --data FOLDER", "skeletons": skeletons}
    result["sizes"] = sizes
    (_HERE / "standing.json").write_text(json.dumps(result, indent=1) + "\n")
    lines = [*table_lines(skeletons, COLUMNS), "", *table_lines(sizes, COLUMNS)]
    (_HERE / "standing.md").write_text(_HEAD + "\n".join(lines) + "\n")


_HEAD = """# Standing

Bodies made from skeletons of many makers, and of one skeleton at five sizes, hold a relaxed pose for ten
seconds: servo targets are the pose's angles, nothing else acts, physics at 60 Hz as in training. Made by

```sh
python benchmarks/standing.py --data FOLDER
```

- **stood**: until the centre of mass was below three quarters of its height or anything but the feet
  touched the floor.
- **sway**: the farthest that the centre of mass went, horizontally. **margin**: how far its projection
  lies inside the support polygon, in the pose and at least while standing.
- **reference sinks**: the deepest point of the clip as it is trained (up to 20 mm are left to the
  contacts, and the constant lift follows the standing soles). **replay sinks**: the same asked to sink
  by 4 mm at most, for which it was **lifted more** by so much on average.
- **joints off**: mean distance between the clip's joints and the body's.

"""


if __name__ == "__main__":
    main()
