"""Boundary elements for bodies in the place of finite ones."""
