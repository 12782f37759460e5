"""Four papers, each a short package over the engine: what only its tables and its own scenes need.

The engine never imports them; the command line may. What has a verb for any motion and what ships is in
the engine.
"""
