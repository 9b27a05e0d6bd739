"""Tolerances of the search for contact and of its integrals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class SearchTolerances:
    """Tolerances of facets, segments and conditions; lengths and areas are over the facet's own.

    Attributes:
        sliver: Common parts below it are what rounding leaves where facets touch.
        edge: Cosine of 20°: facets that turn by twice that at a vertex have an edge there, others
            are those of a smooth surface, with nine facets or more around a pin.
        turned: Of a cosine: facets that turn by less are parts of a plane.
        unknown: Curvatures that are known by less of a neighbour's weight are taken to be 0.
        newton_steps: Steps of Newton's method to reference coordinates; facets that are not folded
            take 3 or 4.
        close: Where that method ends.
        far: A point that is nearer than this where the method stalls is taken, too.
        hardly_covered: Covered share below which hats are nearly dependent, and conditions would be
            divided by slivers.
        axis_switch: |n_x| from which on the first tangent follows the y axis. No choice of tangents
            is continuous everywhere (hairy ball); this one switches 26° from the x axis, where
            hardly a plane surface lies, so that rounding of a normal does not turn its tangents.
        same_layer: Distances closer than this are those of facets of one layer.
        covered_twice: Common parts that exceed a facet by less are one layer.
        facing: Cosine, of about 92°: facets seen from the side have only slivers in common.
        parallel: Quadrilaterals that are farther from parallelograms have rational hats.
        rational_degree: Degree of quadrature for those; none is exact.
        curved_degree: Degrees more on curved facets, where areas are no polynomials.
        uncovered: Share of a facet that rounding may leave uncovered.
        degenerate: Of the square (in 2D: the length) of a facet's radius: smaller areas are
            rounding, and the facet has no normal.
        crease: Cosine of about 40°: facets that make more with the averaged normal are at an edge.
        same_size: Ratio up to which meshes are of one size: an irrational number, so that rounding
            decides nowhere between counts of equal facets.
        same_stiffness: Ratio up to which materials are of one stiffness per area.
        much_stiffer: Ratio of stiffness per area from which on a finer secondary side shows in the
            pressure.
        negligible: Of ∫φ_i: smaller weights are what rounding leaves of biorthogonality.
        no_gap: Of the largest coordinate: a smaller gap is rounding. A body that nothing loads
            would else have it for its displacement.
        seen: One looks so many times as far as the reach, so that facets at its edge are covered
            wholly, and overlaps that are too deep are seen.
        reach: The reach that is not given, over the extent of the smaller surface: few nodes
            farther off ever touch in small strains, and those that do are taken in later.
        wider: Factor of the reach in a round that looks for what may hold a body.
        least: How far one looks then at least, over the scene's length.
        difference: Step of differences of a shape's distance, over the scene's length: curvature
            and rounding are both far below what is looked for.
        samples: Points of each rank, those next to the shape, where its gradient is compared: a
            wrong one is wrong nearly everywhere.
        same_direction: Cosine of 60°, up to which a gradient may be off the difference.
        same_length: Factor up to which its length may be.
        inside: How deep a rigid body may lie in a surface at the begin, over the surface's extent:
            facets of a curved surface reach that far into what touches it.
        along: A direction whose tangential part is shorter does not say where it points.
    """

    sliver: float = 1e-12
    edge: float = 0.94
    turned: float = 8.0 * float(np.finfo(float).eps)
    unknown: float = 0.05
    newton_steps: int = 20
    close: float = 1e-14
    far: float = 1e-8
    hardly_covered: float = 1e-6
    axis_switch: float = 0.9
    same_layer: float = 1e-9
    covered_twice: float = 1e-6
    facing: float = -0.03
    parallel: float = 1e-10
    rational_degree: int = 12
    curved_degree: int = 2
    uncovered: float = 1e-6
    degenerate: float = 1e-12
    crease: float = 0.75
    same_size: float = 2 ** (1 / 6)
    same_stiffness: float = 1.01
    much_stiffer: float = 2.0
    negligible: float = 1e-13
    no_gap: float = 1e-14
    seen: float = 3.0
    reach: float = 0.05
    wider: float = 4.0
    least: float = 0.01
    difference: float = 1e-5
    samples: int = 16
    same_direction: float = 0.5
    same_length: float = 100.0
    inside: float = 0.01
    along: float = 1e-3


SEARCH = SearchTolerances()
