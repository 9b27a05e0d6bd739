"""Geometry of contact surfaces: facets, who meets whom, clipping, layers, integrals."""
