"""Other programs on the scenes of the benchmarks."""
