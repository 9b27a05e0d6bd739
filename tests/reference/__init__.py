"""Independent solvers: nothing of the package is in them but the meshes of the scenes."""
