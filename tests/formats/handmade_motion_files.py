"""Small motion files made by hand: one person in BVH, ASF with AMC, and DeepMimic."""

from __future__ import annotations

import json
import math
from pathlib import Path

BVH_HEADER = """HIERARCHY
ROOT Hips
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT Spine
  {
    OFFSET 0 50 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    JOINT Head
    {
      OFFSET 0 15 0
      CHANNELS 3 Yrotation Xrotation Zrotation
      End Site
      {
        OFFSET 0 20 0
      }
    }
  }
  JOINT LeftLeg
  {
    OFFSET 10 0 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    JOINT LeftFoot
    {
      OFFSET 0 -85 0
      CHANNELS 3 Zrotation Xrotation Yrotation
      End Site
      {
        OFFSET 0 -5 15
      }
    }
  }
}
"""
BVH_WIDTH = 18


def bvh_rows(frames: int = 8) -> list[str]:
    """A body that walks along +Z and sways."""
    rows = []
    for t in range(frames):
        values = [0.5 * t, 90.0, 2.0 * t] + [10.0 * math.sin(0.7 * t + k) + 5 for k in range(15)]
        rows.append(" ".join(f"{v:.6f}" for v in values))
    return rows


def bvh_text(rows: list[str] | None = None, frames: int | None = None, header: str = BVH_HEADER) -> str:
    rows = bvh_rows() if rows is None else rows
    count = len(rows) if frames is None else frames
    return header + "\n".join(["MOTION", f"Frames: {count}", "Frame Time: 0.02", *rows]) + "\n"


ASF = """# made by hand
:version 1.10
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
    axis 0 0 0 XYZ
    dof rx ry rz
    limits (-20.0 45.0)
           (-30.0 30.0)
           (-30.0 30.0)
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
    direction 0.6 -0.8 0
    length 8
    axis 0 0 20 XYZ
    dof rx rz
    limits (-160.0 20.0)
           (-70.0 70.0)
  end
  begin
    id 4
    name lfoot
    direction 0 -1 0
    length 7
    axis -90 0 20 XYZ
    dof rx
    limits (-10.0 170.0)
  end
:hierarchy
  begin
    root spine lfemur
    spine head
    lfemur lfoot
  end
"""


def amc_text(frames: int = 6) -> str:
    lines = ["#!OML:ASF person.ASF", ":FULLY-SPECIFIED", ":DEGREES"]
    for t in range(frames):
        lines += [
            str(t + 1),
            f"root {0.1 * t:.4f} 15.0 {0.2 * t:.4f} {3.0 * t:.3f} 5.0 {-2.0 * t:.3f}",
            f"spine {2.0 * t:.3f} 1.0 -3.0",
            f"head {4.0 * t:.3f}",
            f"lfemur {-5.0 * t:.3f} 10.0",
            f"lfoot {6.0 * t:.3f}",
        ]
    return "\n".join(lines) + "\n"


def deepmimic_row(t: int, duration: float = 0.02) -> list[float]:
    """One frame of 44 numbers: straight, but for the right knee at -0.5 and left elbow at 0.7."""
    unit = [1.0, 0.0, 0.0, 0.0]
    row = [duration, 0.02 * t, 0.85, 0.0, *unit]
    row += unit + unit
    row += [*unit, -0.5, *unit, *unit, 0.0]
    row += [*unit, 0.0, *unit, *unit, 0.7]
    return row


def deepmimic_text(rows: list[list[float]] | None = None, loop: str = "none") -> str:
    rows = [deepmimic_row(t) for t in range(6)] if rows is None else rows
    lines = ",\n".join(json.dumps(r) for r in rows)
    return f'{{\n"Loop": "{loop}",\n"Frames":\n[\n{lines}\n]\n}}\n'


def put(folder: Path, name: str, text: str | bytes) -> Path:
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path
