"""Results of the verbs of `import poise`: a motion, its score, the sentences about it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import NamedTuple

from poise.formats import check_writable, names_file, write_clip
from poise.jobs.keep import claimed, may_deliver, may_write, refusing
from poise.kinematics.rate import read_clip
from poise.motion import Clip
from poise.score import ScoreCard
from poise.score import table as rows_of
from poise.score.report.svg import result_html


class ResultView(NamedTuple):
    """What a result shows of itself.

    clip: the motion on the skeleton that came in. source: what came in. card: the score of the
    simulation, None where nothing was simulated. notes: sentences. keys: frames that stand out.
    """

    clip: Clip
    source: Clip
    card: ScoreCard | None
    notes: tuple[str, ...]
    keys: tuple[int, ...] = ()


class Result(ABC):
    """A motion that a verb made. Each has `clip`, `card`, `notes`, and what its own class says."""

    @abstractmethod
    def _shown(self) -> ResultView: ...

    @abstractmethod
    def _save_all(self, folder: Path) -> dict[str, Path]: ...

    def save(self, path: str | Path, *, force: bool = False) -> dict[str, Path]:
        """Writes the motion into the file `path`, or all there is into the folder `path`; what was
        written, by name.

        Args:
            force: what is there already may be written over.

        Raises:
            PoiseError: a suffix of no motion format, something is there already, or nothing can be
                written there.
        """
        path = Path(path)
        with refusing(path):
            to_file = names_file(path) and not path.is_dir()
            if to_file:
                check_writable(path)
                may_write(path, force, flag="force=True")
            else:
                may_deliver(path, None, force, flag="force=True")
        if to_file:
            write_clip(self._shown().clip, path)
            return {"motion": path}
        with claimed(path):
            return self._save_all(path)

    def __repr__(self) -> str:
        _, source, card, _, _ = self._shown()
        said = f"{type(self).__name__}({source.name!r}, {source.seconds:.1f} s"
        if card is not None:
            said += f", success {card.succ:.0%}, {card.mpjpe_mm:.0f} mm"
            said += f", help {card.help.force_mean_n:.1f} N"
        return said + ")"

    def _repr_html_(self) -> str:
        """A picture and a table for notebooks, self-contained."""
        clip, source, card, notes, keys = self._shown()
        rows = () if card is None else rows_of(card)
        return result_html(source.name, clip, source, rows, notes, keys)


def clip_of(motion: Clip | str | Path) -> Clip:
    """A clip as it is, or that in a file.

    Raises:
        PoiseError: the file cannot be read.
    """
    return motion if isinstance(motion, Clip) else read_clip(motion)
