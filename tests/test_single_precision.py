"""Factors in single precision: solves as exact as ever, and answers with them."""

import numpy as np
import pytest
import scenes
from petsc4py import PETSc
from scenes import apart, clamp, curved_obstacle, decomposed, hooke
from scipy.sparse import eye_array
from test_blocks import block, stiffness

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.subdomains.factor import CholeskyFactor
from tfeti_dolfinx.subdomains.kplus import InverseFactory
from tfeti_dolfinx.subdomains.mixed import MIXED, MixedFactor, cholmod

if cholmod() is None:
    pytest.skip("CHOLMOD is older than 5.1, or not where it is looked for", allow_module_level=True)


@pytest.mark.parametrize("units", [1.0, 1e-40, 1e40])
def test_a_refined_solve_is_exact(units):
    """Single precision alone leaves seven digits, and has no such units."""
    K, x = stiffness("hexahedron", 9)
    one, other = (block(units * K, x, 3, InverseFactory(mixed=m)) for m in (True, False))
    assert (one.stiffness.mixed, other.stiffness.mixed) == (True, False)
    assert 0.8 < one.stiffness.entries / other.stiffness.entries < 1.25
    b = 1e-60 * np.random.default_rng(1).standard_normal((len(one.load), 3))
    exact = other.stiffness.solve(b)
    assert apart(one.stiffness.solve(b), exact) <= 1e-11
    assert 1e-8 < apart(one.stiffness.roughly(b), exact) < 1e-4
    assert not one.solve(np.zeros(len(b))).any()
    w = np.ones(len(one.trace_dofs))
    assert apart(one.apply_schur(w), other.apply_schur(w)) <= 1e-4
    for _ in range(MIXED.solves):
        found = one.solve(b[:, 0])
    assert apart(found, exact[:, 0]) <= 1e-13  # many have made a factor in double precision
    assert one.stiffness.factory.factorizations == 1 + other.stiffness.factory.factorizations


def test_where_single_precision_does_not_do_the_factor_is_petsc_s():
    """With options for it, and where a matrix is ill conditioned; or indefinite."""
    K, factory = stiffness("hexahedron", 9)[0], InverseFactory(mixed=True)
    one = eye_array(K.shape[0], format="csr")
    PETSc.Options()["tfeti_one_mat_cholmod_print"] = 0
    assert type(factory.factor(K + one, "tfeti_one_")) is CholeskyFactor
    PETSc.Options().delValue("tfeti_one_mat_cholmod_print")
    assert type(factory.factor(K + one, "tfeti_one_")) is MixedFactor
    assert type(factory.factor(K + 1e-9 * one, "tfeti_one_")) is CholeskyFactor
    assert not factory.mixed  # the next is not tried
    with pytest.raises(ArithmeticError):
        MixedFactor(K - 1e-2 * one, cholmod(), CholeskyFactor)


@pytest.mark.parametrize("law", ["linear", "tresca"])
def test_answers_are_the_same(law):
    """Loaded, loaded more, unloaded and loaded again, at the least tolerance that has it."""
    found, counts, forms = [], [], []
    d = decomposed("tetrahedron", 15, 4, grading=1.2)
    V, a, L = scenes.forms(d.mesh, d.facet_tags, (0.0, 0.0, -0.05), d.surface("top"))
    (traction,) = L.constants()
    rough = tfeti.Obstacle("bottom", curved_obstacle(3), reach=0.2, friction=tfeti.Tresca(0.01))
    given = [clamp(V, d.facets("left"))], [rough] * (law == "tresca"), d
    for without in ({"tfeti_without": "mixed_precision"}, {}):
        options = {"tfeti_rtol": MIXED.rtol, **without}
        p = tfeti.ContactProblem(a, L, *given, stress=hooke(), petsc_options=options)
        for traction.value[2] in (-0.05, -0.1, 0.0, -0.05):
            found.append(p.solve().x.array.copy())
            counts.append(p.report.F_multiplications)
            forms.append(p.report.local_operators)
        p.destroy()
    assert forms[4]["F_mixed"] == 4
    assert apart(np.concatenate(found[4:]), np.concatenate(found[:4])) <= 5 * MIXED.rtol
    assert sum(counts[4:]) <= 1.2 * sum(counts[:4])
