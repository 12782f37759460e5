"""The figures that Perpetual Humanoid Control (Luo et al. 2023) prints, to stand beside one's own."""

from __future__ import annotations

from dataclasses import dataclass

NAN = float("nan")


@dataclass(frozen=True)
class PaperRow:
    """One row of a published table.

    clips: how many sequences. help: whether a residual force helps at test time. succ: percent. The
    errors are in mm, mm/frame and mm/frame^2 at 30 Hz, NaN where none is printed. note: what is odd.
    """

    source: str
    method: str
    data: str
    clips: int
    help: bool
    succ: float
    g_mpjpe: float
    mpjpe: float
    acc: float = NAN
    vel: float = NAN
    note: str = ""


_TRAIN, _TEST, _H36M = ("AMASS-Train", 11313), ("AMASS-Test", 140), ("H36M-Motion", 140)
_VIDEO = ("H36M-Test-Video, noisy", 160)
_SWAPPED = "global below root-relative: the paper's two columns are likely swapped here"


def _mocap(
    method: str, data: tuple[str, int], succ: float, g: float, m: float, acc: float, vel: float,
    help: bool = False, note: str = "",
) -> PaperRow:  # fmt: skip
    return PaperRow("PHC table 1", method, *data, help, succ, g, m, acc, vel, note)


def _video(method: str, succ: float, g: float, m: float, help: bool = False) -> PaperRow:
    return PaperRow("PHC table 2", method, *_VIDEO, help, succ, g, m)


#: Succ, g-MPJPE, MPJPE, acceleration, velocity. The paper does not say whether failed sequences are in
#: the errors, nor how they are weighted; its code pools the frames of all clips.
PHC_ROWS: tuple[PaperRow, ...] = (
    _mocap("PHC", _TRAIN, 98.9, 37.5, 26.9, 3.3, 4.9),
    _mocap("PHC keypoints", _TRAIN, 98.7, 40.7, 32.3, 3.5, 5.5),
    _mocap("UHC", _TRAIN, 84.5, 62.7, 39.6, 10.9, 10.9),
    _mocap("UHC", _TRAIN, 97.0, 36.4, 25.1, 4.4, 5.9, help=True),
    _mocap("PHC", _TEST, 96.4, 47.4, 30.9, 6.8, 9.1),
    _mocap("PHC keypoints", _TEST, 97.1, 53.1, 39.5, 7.5, 10.4),
    _mocap("UHC", _TEST, 62.6, 58.2, 98.1, 22.8, 21.9, note=_SWAPPED),
    _mocap("UHC", _TEST, 96.4, 50.0, 31.2, 9.7, 12.1, help=True),
    _mocap("PHC", _H36M, 92.9, 50.3, 33.3, 3.7, 5.5),
    _mocap("PHC keypoints", _H36M, 95.7, 49.5, 39.2, 3.7, 5.8),
    _mocap("UHC", _H36M, 23.6, 133.14, 67.4, 14.9, 17.2),
    _mocap("UHC", _H36M, 87.0, 59.7, 35.4, 4.9, 7.4, help=True),
    _video("PHC, HybrIK and MeTRAbs root", 88.7, 55.4, 34.7),
    _video("PHC keypoints, HybrIK and MeTRAbs root", 90.0, 55.8, 41.0),
    _video("PHC keypoints, MeTRAbs", 91.9, 55.7, 41.1),
    _video("UHC, HybrIK and MeTRAbs root", 18.1, 126.1, 67.1),
    _video("UHC, HybrIK and MeTRAbs root", 58.1, 75.5, 49.3, help=True),
)


@dataclass(frozen=True)
class RecoveryRow:
    """Percent of 1,000 trials that are back on the reference in time (PHC table 4)."""

    method: str
    start: str
    succ_5s: float
    succ_10s: float


PHC_RECOVERY: tuple[RecoveryRow, ...] = (
    RecoveryRow("PHC", "fallen", 95.0, 98.8),
    RecoveryRow("PHC", "far", 83.7, 99.5),
    RecoveryRow("PHC", "fallen and far", 93.4, 98.8),
    RecoveryRow("PHC keypoints", "fallen", 92.5, 94.6),
    RecoveryRow("PHC keypoints", "far", 95.1, 96.0),
    RecoveryRow("PHC keypoints", "fallen and far", 79.4, 93.2),
)


def paper_rows(*data: str) -> tuple[PaperRow, ...]:
    """PHC's rows on these data sets ("AMASS-Test"), all of them by default."""
    return tuple(r for r in PHC_ROWS if not data or r.data in data)
