"""gmsh's files: one or split, and from memory."""
