"""The suites, a module each: `PARTS` are what the runner measures."""
