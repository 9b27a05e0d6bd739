"""Extreme eigenvalues of B D⁻¹ Bᵀ: bounded whatever h, H and jumps of stiffness are."""

import numpy as np
import pytest
from bodies import held, pressed, sided, sides_of, stacked, stiffer_above, two_body_problem
from scenes import solved
from scipy.sparse import csr_array

# the rows alone matter: no step of the solver is made
ROWS_ONLY = dict(max_it=0, norm_steps=1, error_if_not_converged=False)
UP, DOWN = ("upper bottom", "lower top"), ("lower top", "upper bottom")  # secondary, primary


def extremes(cell, n, subdomains, scaling="stiffness", pair=UP, stiffness=1.0):
    """Of a box on a box, n = (cells of the lower, cells of the upper), the upper one stiffer."""
    d = stacked(cell, *n, subdomains)
    stress = stiffer_above(d, stiffness)
    given = d, pressed(d), held(d, *sides_of(cell)), [sided(*pair)]
    p = solved(two_body_problem(*given, stress=stress, scaling=scaling, **ROWS_ONLY))
    indptr, indices, data = p.dual.constraints.B.getValuesCSR()
    B = csr_array((data, indices, indptr), shape=p.dual.constraints.B.getSize())
    values = np.linalg.eigvalsh(((B / p.dual.constraints.weights) @ B.T).toarray())
    p.destroy()
    return values[0], values[-1]


SCENES = {
    "quadrilateral": [((6, 8), 4), ((12, 16), 4), ((12, 16), 32)],
    "hexahedron": [((2, 3), 4), ((4, 6), 4), ((4, 6), 16)],
}


@pytest.mark.parametrize(
    ("cell", "scaling", "low", "high"),
    [
        ("quadrilateral", "stiffness", 0.55, 1.4),
        ("quadrilateral", "multiplicity", 0.5, 1.5),
        ("hexahedron", "stiffness", 0.64, 1.8),
        ("hexahedron", "multiplicity", 0.38, 2.4),
    ],
)
def test_bounds_depend_neither_on_h_nor_on_H(cell, scaling, low, high, serial_only):
    for scene in SCENES[cell]:
        least, largest = extremes(cell, *scene, scaling)
        assert low <= least <= largest <= high


def test_a_jump_of_stiffness_does_not_matter_where_the_softer_body_is_secondary(serial_only):
    for jump in (1.0, 1e3, 1e6):
        least, largest = extremes("quadrilateral", (6, 8), 8, pair=DOWN, stiffness=jump)
        assert 0.95 <= least <= largest <= 1.1


def test_a_stiff_and_fine_secondary_has_nearly_dependent_rows(serial_only):
    """In D⁻¹ its rows live on the primary side, which has fewer nodes than there are rows."""
    least, _ = extremes("quadrilateral", (6, 8), 8, stiffness=1e3)
    assert 1e-4 < least < 1e-2
