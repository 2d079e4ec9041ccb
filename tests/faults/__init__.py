"""Faults of meshes, made anew for every test: what is wrong, and what must become of it."""
