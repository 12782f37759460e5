"""Where simulated motion goes: a file, VMC. Each takes what it can and never makes the loop wait."""
