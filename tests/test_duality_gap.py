"""The bound of the algebraic error is one, and is near."""

from dataclasses import replace

import numpy as np
import pytest
from bodies import drawn, held, sided, stacked, stiffer_above, two_body_problem
from scenes import CELLS, curved_obstacle, decomposed, problem, solved

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.solve.solver import solve_dual

LAWS = (
    None,
    lambda rng: tfeti.Tresca(10.0 ** rng.uniform(-4, -2)),
    lambda rng: tfeti.Coulomb(rng.uniform(0.05, 0.8)),
)
SOLVERS = (
    ({"qp_type": "newton"}, {"qp_type": "newton", "pc_type": "lumped"}),
    ({"qp_type": "smalse"}, {"qp_type": "smalse"}),
)


def made(seed):
    """A block on a block that does not match it: a problem of a seed, and rtol."""
    rng = np.random.default_rng([seed, 11])
    cell = CELLS[seed % 4]
    flat = seed % 4 < 2
    n = rng.integers(2, 9 if flat else 5, size=2)
    d = stacked(cell, *n.tolist(), int(rng.integers(1, 9)), (0.1, 0.9), gap=rng.uniform(0, 1e-3))
    law = LAWS[seed % 3]
    sides = ("upper bottom", "lower top") if rng.random() < 0.5 else ("lower top", "upper bottom")
    pair = sided(*sides, friction=None if law is None else law(rng))
    force = rng.uniform(-5e-3, 5e-3, d.mesh.geometry.dim)
    force[-1] = -(10.0 ** rng.uniform(-3, -1.5))
    clamped = ["lower bottom", "upper left"] + ([] if flat else ["upper front"])
    bcs = held(d, *clamped, "lower left") if rng.random() < 0.5 else held(d, *clamped)
    if not flat or law is None:
        force[:-1] = 0.0
    rtol = 10.0 ** rng.uniform(-7, -2)
    stress = stiffer_above(d, 10.0 ** rng.uniform(-2, 3), rng.uniform(0.0, 0.45))
    options = SOLVERS[int(rng.random() < 0.3)][int(rng.random() < 0.3)]
    options = {**options, "rtol": rtol, "error_if_not_converged": False}
    return two_body_problem(d, drawn(d, "upper top", force), bcs, [pair], stress=stress, **options)


def norm(p, u):
    """‖u‖_K."""
    subdomains = p.dual.subdomains
    return np.sqrt(max(subdomains.comm.allreduce(sum(subdomains.energies(u))), 0.0))


def exact(p):
    """The displacement of the same program, bounds of friction included, as exact as can be."""
    start = (p.solution.lam, np.zeros(p.dual.coarse.dimension))
    options = replace(p.options, rtol=1e-13, qp_type="newton", error_if_not_converged=False)
    result, rule = solve_dual(p.dual, options, start)
    return rule.u


@pytest.mark.parametrize(
    "seed", [pytest.param(s, marks=[] if s < 12 else [pytest.mark.slow]) for s in range(50)]
)
def test_the_bound_is_one_and_at_most_twenty_times_the_error(seed):
    p = solved(made(seed))
    reported = p.report.residuals["energy_error"]
    assert reported <= p.report.tolerances["energy_error"]
    found, error = p.estimate(), norm(p, p.solution.u - exact(p))
    size = norm(p, p.solution.u)
    assert found.energy == pytest.approx(size)
    assert found.algebraic >= error * (1 - 1e-6) - 1e-11 * size
    assert found.algebraic <= 20 * error + 1e-11 * size
    assert reported * size >= 0.8 * error
    if p.options.qp_type == "newton":
        # of Newton's iterates on friction: ψ|q| − τᵀq of a long slip q is far above ½‖u − u*‖²_K
        assert reported * size <= 2 * found.algebraic + 1e-11 * size


def test_it_is_the_same_for_all_preconditioners_and_costs_what_it_says():
    """The Dirichlet preconditioner has the factors; without it they are made once."""
    floor = tfeti.Obstacle("bottom", curved_obstacle(2), reach=0.2)
    bounds = []
    for kind in ("dirichlet", "lumped"):
        p = solved(problem(decomposed("triangle", 6, 4), contacts=[floor], pc_type=kind))
        before = p.report.F_multiplications
        bounds.append(p.estimate())
        assert p.report.estimates["algebraic"] == bounds[-1].algebraic
        assert p.report.F_multiplications == before == p.dual.F.count
        assert bounds[-1].lifting_multiplications == 1
        assert (bounds[-1].factorizations > 0) == (kind == "lumped")
        assert p.estimate().factorizations == 0
    for found in bounds:
        assert 0.0 < found.relative_algebraic < 1e-5


def of_estimates(p):
    return [warning for warning in p.report.warnings if warning.startswith("estimates: ")]


def test_a_bound_that_says_nothing_is_warned_of():
    """Forces a hundred times too large stand for such that have no digits left."""
    p = solved(made(0))
    p.estimate()
    assert of_estimates(p) == []
    others, right = list(p.report.warnings), p.solution.lam.copy()
    for _ in range(2):
        p.solution.lam[:] = 100.0 * right
        found = p.estimate()
        assert found.algebraic > 50.0 * found.energy
        (warning,) = of_estimates(p)
        assert f"is {found.relative_algebraic:.0e} times the energy norm" in warning
        assert p.report.warnings == [*others, warning]
    p.solution.lam[:] = right
    p.estimate()
    assert p.report.warnings == others


def test_it_needs_a_solution():
    p = problem(decomposed("triangle", 2, 2))
    with pytest.raises(tfeti.InputError, match="there is no solution yet"):
        p.estimate()
    p.solve()
    p.destroy()
    with pytest.raises(tfeti.InputError, match="nothing has been made yet"):
        p.estimate()
