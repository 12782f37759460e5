"""Parts that only the tables and scenes of four papers need; no other package but `cli` imports it.

The engine holds whatever has a verb for any motion, and whatever ships.
"""
