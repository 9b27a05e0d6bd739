"""Quadratic programming: vectors, operators and feasible sets, nothing of meshes."""
