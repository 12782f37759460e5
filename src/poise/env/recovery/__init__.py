"""Recovery: falls and far starts in episodes, recovery clips, and the planner that leads back."""
