"""Small motion files for the command line: a body that can be simulated, and many that cannot."""

from __future__ import annotations

import json
import math
from pathlib import Path

BVH = """HIERARCHY
ROOT Hips
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT Head
  {
    OFFSET 0 65 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    End Site
    {
      OFFSET 0 20 0
    }
  }
  JOINT LeftFoot
  {
    OFFSET 10 -85 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    End Site
    {
      OFFSET 0 -5 15
    }
  }
}
"""
ROW = "0 90 0 1 2 3 4 5 6 7 8 9"
ASF = """:version 1.10
:name person
:units
  mass 1.0
  length 0.45
  angle deg
:root
  order TX TY TZ RX RY RZ
  axis XYZ
  position 0 0 0
  orientation 0 0 0
:bonedata
  begin
    id 1
    name spine
    direction 0 1 0
    length 9
  end
  begin
    id 2
    name head
    direction 0 1 0
    length 4
    axis 0 0 0 XYZ
    dof rx
    limits (-45 45)
  end
  begin
    id 3
    name lfemur
    direction 0 -1 0
    length 15
  end
  begin
    id 4
    name lfoot
    direction 0 -1 0
    length 1
    axis 0 0 0 XYZ
    dof rx
    limits (-10 170)
  end
:hierarchy
  begin
    root spine lfemur
    spine head
    lfemur lfoot
  end
"""


def bvh(rows: list[str] | None = None, header: str = BVH, frames: int | None = None) -> str:
    rows = [ROW] * 4 if rows is None else rows
    count = len(rows) if frames is None else frames
    return header + "\n".join(["MOTION", f"Frames: {count}", "Frame Time: 0.02", *rows]) + "\n"


def amc(frames: int = 4, bone: str = "head") -> str:
    lines = ["#!OML:ASF", ":FULLY-SPECIFIED", ":DEGREES"]
    for t in range(frames):
        lines += [str(t + 1), "root 0 15 0 0 0 0", f"{bone} 4", "lfoot 6"]
    return "\n".join(lines) + "\n"


def deepmimic(frames: int = 16) -> str:
    """A body that stands at 30 Hz, bends a knee and raises an arm: 15 control steps."""
    one, rows = [1.0, 0.0, 0.0, 0.0], []
    for t in range(frames):
        bend = 0.2 * math.sin(0.4 * t)
        right = [*one, -abs(bend), *one, *one, 0.1]
        left = [*one, -abs(bend), *one, math.cos(bend), math.sin(bend), 0.0, 0.0, 0.7]
        rows.append([1 / 30, 0.01 * t, 0.88, 0.0, *one, *one, *one, *right, *left])
    return json.dumps({"Loop": "none", "Frames": rows})


def put(folder: Path, name: str, text: str | bytes) -> Path:
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


#: Options of a training that takes seconds.
MINIATURE = ["--iterations", "2", "--envs", "16", "--threads", "1", "--no-expert"]
