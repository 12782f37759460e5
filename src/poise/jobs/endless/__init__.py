"""Motion without end: a kinematic policy that goes on from its past, and a character that does it."""
