"""Estimates of errors, and warnings about answers that cannot be trusted."""
