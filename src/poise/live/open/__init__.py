"""The page of `poise open`: motions and their faults, jobs on them, one project."""
