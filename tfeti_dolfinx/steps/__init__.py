"""Series of solves: load steps, dynamics, checkpoints."""
