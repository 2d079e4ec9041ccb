"""Faults of meshes, made again for every test: what is wrong, and what must become of it."""
