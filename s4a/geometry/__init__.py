"""Surfaces as arrays (3.1): triangles, normals, areas, distances, rigid motions."""
