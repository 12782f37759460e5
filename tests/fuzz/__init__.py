"""Damaged files of every format that is read: `python -m tests.fuzz --minutes 30`."""
