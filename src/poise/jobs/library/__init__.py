"""A folder of motion files as one library on one humanoid: read, cleaned, cut, retargeted."""

from poise.jobs.library.clips import LibraryConfig
from poise.jobs.library.folder import Split, library_of, split
from poise.jobs.library.report import ClipNote, LibraryReport

__all__ = ["ClipNote", "LibraryConfig", "LibraryReport", "Split", "library_of", "split"]
