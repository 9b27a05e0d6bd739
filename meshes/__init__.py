"""gmsh scripts."""
