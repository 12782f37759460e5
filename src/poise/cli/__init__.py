"""The command line: parsing, printing and progress live here and nowhere else."""
