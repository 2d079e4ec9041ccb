"""Morphometrics on studies of S4A: an extension made of public names of ``s4a`` only."""
