"""Rows of B and their right sides: interfaces, Dirichlet conditions, contact."""
