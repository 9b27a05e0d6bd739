"""Meshes in, subdomains out: gmsh input, partitioning, tearing, tags."""
