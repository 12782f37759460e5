"""Compliance measured and played: a character that stands, what is thrown at it, how stiff it is."""
