"""Each verb from file to file: track, imitate, train, complete, dream; run folders and results."""
