"""The page of `poise open`: motions, their faults, jobs that mend them and give them a body, one project."""
