"""Motion made from motion: transitions between keyframes, in files' own skeletons."""
