"""Benchmarks: they report, tests never assert a time."""
