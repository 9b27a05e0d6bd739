"""Tolerances of the search for contact and of its integrals."""

from dataclasses import dataclass

from tfeti_dolfinx.common.arrays import EPSILON


@dataclass(frozen=True)
class SearchTolerances:
    """Tolerances of facets, segments and conditions; lengths and areas are over the facet's own."""

    sliver: float = 1e-12  # common parts below it are what rounding leaves where facets touch
    # cosine of 20°: facets that turn by twice that at a vertex have an edge there, others are those
    # of a smooth surface, with ten facets or more around a pin
    edge: float = 0.94
    # of surfaces with edges: facets that face each other by less than the best ones there beside an
    # edge of the secondary side, elsewhere by less than this share of them, count by a power of
    # what they lack: a side that bulges by 10° towards what its edge meets counts a thousandth, by
    # 30° a sixteenth
    aslant: float = 0.5
    aside: float = 4.0
    # how much farther a normal is turned beside a plane of symmetry than on it, where the surface
    # bends towards it: twice on an arc of equal facets, 1 on a plane that meets it at a slant
    bends: float = 1.2
    at_edge: float = 1e-3  # of a facet's radius: a vertex so near an edge of a shape lies on it
    # of a cosine: facets that turn by less are parts of a plane
    turned: float = 8.0 * EPSILON
    # curvatures that are known by less of a neighbour's weight are taken to be 0
    unknown: float = 0.05
    # steps of Newton's method to reference coordinates; facets that are not folded take 3 or 4
    newton_steps: int = 20
    close: float = 1e-14  # where that method ends
    far: float = 1e-8  # a point that is nearer than this where the method stalls is taken, too
    # covered share below which hats are nearly dependent, and conditions would be divided by
    # slivers
    hardly_covered: float = 1e-6
    # in finite strain covered share below which dual multipliers pass into hats: over strips they
    # extrapolate gaps; hats alone are nearly dependent
    extrapolated: float = 0.3
    # of a facet: how far a mean of gaps may be below all of them. Where nearly flat faces press
    # each other, far less would let rows change by much for gaps that change by little
    below: float = 1e-3
    # covered share from which on a node's pressure is believed: those of nodes with less were 5 to
    # 40 000 times those beside them, of blocks on flat faces
    believed: float = 0.02
    # |n_x| from which on the first tangent follows the y axis. No choice of tangents is continuous
    # everywhere (hairy ball); this one switches 26° from the x axis, where hardly a plane surface
    # lies, so that rounding of a normal does not turn its tangents
    axis_switch: float = 0.9
    # components of a unit normal that need not be prescribed where a vertex is held; shares of hats
    # that what is held may lack
    held: float = 1e-6
    same_layer: float = 1e-9  # distances closer than this are those of facets of one layer
    # cosine, of about 92°: facets seen from the side have only slivers in common
    facing: float = -0.03
    # quadrilaterals that are farther from parallelograms have rational hats
    parallel: float = 1e-10
    rational_degree: int = 12  # degree of quadrature for those; none is exact
    curved_degree: int = 2  # degrees more on curved facets, where areas are no polynomials
    uncovered: float = 1e-6  # share of a facet that rounding may leave uncovered, or cover twice
    # of the square (in 2D: the length) of a facet's radius: smaller areas are rounding, and the
    # facet has no normal
    degenerate: float = 1e-12
    # of the longest side of a triangle of a tool: what is less high has sides whose determinant, a
    # square, is rounding, and so is the nearest point
    thin: float = 1e-7
    # ratio up to which meshes are of one size: an irrational number, so that rounding decides
    # nowhere between counts of equal facets
    same_size: float = 2 ** (1 / 6)
    same_stiffness: float = 1.01  # ratio up to which materials are of one stiffness per area
    # ratio of stiffness per area from which on a finer secondary side shows in the pressure
    much_stiffer: float = 2.0
    # of ∫φ_i: smaller weights are what rounding leaves of biorthogonality
    negligible: float = 1e-13
    # of the largest coordinate: a smaller gap is rounding. A body that nothing loads would else
    # have it for its displacement
    no_gap: float = 1e-14
    # one looks so many times as far as the reach, so that facets at its edge are covered wholly,
    # and overlaps that are too deep are seen
    seen: float = 3.0
    # the reach that is not given, over the extent of the smaller surface: few nodes farther off
    # ever touch in small strains, and those that do are taken in later
    reach: float = 0.05
    wider: float = 4.0  # factor of the reach in a round that looks for what may hold a body
    least: float = 0.01  # how far one looks then at least, over the scene's length
    # step of differences of a shape's distance, over the scene's length: curvature and rounding are
    # both far below what is looked for
    difference: float = 1e-5
    # points of each rank, those next to the shape, where its gradient is compared: a wrong one is
    # wrong nearly everywhere
    samples: int = 16
    same_direction: float = 0.5  # cosine of 60°, up to which a gradient may be off the difference
    same_length: float = 100.0  # factor up to which its length may be
    # how deep a rigid body may lie in a surface at the start, over the surface's extent: facets of
    # a curved surface reach that far into what touches it
    inside: float = 0.01
    along: float = 1e-3  # a direction whose tangential part is shorter does not say where it points


SEARCH = SearchTolerances()
