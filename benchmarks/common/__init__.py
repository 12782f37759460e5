"""Parts that suites share: sets of clips, policies, rows, rules of success, starts, the runner."""
