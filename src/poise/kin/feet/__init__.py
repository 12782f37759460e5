"""Feet: when they are in contact, and how they are held there."""
