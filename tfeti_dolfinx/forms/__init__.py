"""Forms of a user: checks, assembly, elasticity, stress fields, steps in time."""
