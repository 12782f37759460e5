"""Training of the perpetual controller in stages, in a run folder."""
