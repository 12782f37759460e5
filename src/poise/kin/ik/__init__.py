"""Inverse kinematics: the paper's analytic equations, and a numeric polish of what they leave."""
