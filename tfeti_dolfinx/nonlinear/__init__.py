"""Nonlinear bodies in contact: materials with and without a memory, small and finite strain."""
