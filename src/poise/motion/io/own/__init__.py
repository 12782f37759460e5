"""Poise's own files, npz and CSV: everything that a clip holds, without loss."""
