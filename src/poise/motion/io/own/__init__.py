"""Poise's own files, npz and CSV: everything that a clip holds, without loss."""

from poise.motion.io.own.csv import looks_like_csv, read_csv, write_csv
from poise.motion.io.own.npz import read_poise_npz, write_poise_npz

__all__ = ["looks_like_csv", "read_csv", "read_poise_npz", "write_csv", "write_poise_npz"]
