"""The chosen solver, and Coulomb's law around it."""
