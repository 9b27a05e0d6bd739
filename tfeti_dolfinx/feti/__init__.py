"""The dual problem: F, G, preconditioners, coarse space, recovery, the stopping rule."""
