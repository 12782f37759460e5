"""Four papers, each a short package over the engine: what only its tables and its own scenes need.

The engine never imports them; the command line may. The engine holds whatever has a verb for any
motion, and whatever ships.
"""
