"""Jobs: what a verb does from file to file, and the run folders."""
