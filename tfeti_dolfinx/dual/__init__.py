"""The dual problem: F, G, d, e, coarse projectors, preconditioners, recovery."""
