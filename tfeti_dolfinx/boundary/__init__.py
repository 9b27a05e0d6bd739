"""Boundary elements: the Steklov–Poincaré operator of an isotropic body on its surface."""
