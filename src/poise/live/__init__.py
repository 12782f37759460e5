"""Live: streams of motion in, simulated characters out, in a browser and in other programs."""
