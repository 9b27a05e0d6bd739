"""Rows of B and c: interfaces, Dirichlet values, contact."""
