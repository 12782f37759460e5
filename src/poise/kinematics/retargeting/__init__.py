"""Motion on another skeleton: the pose that skeletons share, the passage, contacts that are kept."""
