"""Recorded motion: its files, onto our skeleton, and what is trained on it."""
