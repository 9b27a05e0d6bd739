"""Where the Schur complements are dear to make, the lumped preconditioner begins a solve."""

from functools import partial

import pytest
from petsc4py import PETSc
from scenes import apart, curved_obstacle, decomposed, problem
from test_repeated import Repeated

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.extensions import Extensions
from tfeti_dolfinx.feti.operator import PreconditionerChoice, chosen_preconditioner
from tfeti_dolfinx.subdomains import sparse_block

SUBDOMAINS = 4


def solved(contact=True, n=4, **options):
    """Of a clamped block: solver, factorisations of a subdomain, multiplications by S, and u."""
    obstacles = [tfeti.Obstacle("bottom", curved_obstacle(3), reach=0.2)] if contact else []
    d = decomposed("hexahedron", n, SUBDOMAINS)
    p = problem(d, contacts=obstacles, tfeti_local_type="implicit", **options)
    p.solve()
    report, u = p.report, p.solution.u
    p.destroy()
    factors = report.factorizations // SUBDOMAINS
    return report.solver, factors, report.preconditioner_multiplications, u


def late(steps):
    """S is dear everywhere, and pays after so many multiplications."""
    choice = PreconditionerChoice(dear=0.0, steps=steps)
    return Extensions(preconditioner=partial(chosen_preconditioner, choice=choice))


@pytest.mark.parametrize("contact", [True, False])
def test_S_comes_after_some_multiplications_and_the_answer_is_the_same(contact):
    _, _, fewest, u = solved(contact, tfeti_pc_type="dirichlet", tfeti_rtol=1e-9)
    _, _, most, _ = solved(contact, tfeti_pc_type="lumped", tfeti_rtol=1e-9)
    for steps, factors in ((0, 2), (4, 2), (1000, 1)):
        solver, made, count, found = solved(contact, extensions=late(steps), tfeti_rtol=1e-9)
        assert solver == f"{'newton' if contact else 'pcpg'} + late dirichlet"
        assert made == factors
        assert apart(found, u) <= 1e-7
        assert count == {0: fewest, 1000: most}.get(steps, count)
        assert count <= most


def test_more_solves_make_S_as_soon_as_they_multiply_by_it():
    scene = Repeated(extensions=late(1000), local_type="implicit")
    scene.solve()
    report = scene.problem.report
    count, first = report.factorizations, report.preconditioner_multiplications
    scene.solve()
    assert scene.problem.report.factorizations == 0
    scene.solve(load=-0.08)
    assert scene.problem.report.factorizations == count
    assert 0 < scene.problem.report.preconditioner_multiplications < first
    assert apart(scene.problem.solution.u, scene.fresh(load=-0.08).u) <= 1e-8


def test_it_is_chosen_for_large_subdomains_in_space_alone():
    """Beside soft springs, too; not for a few cells, not for what is asked for."""
    names = [
        solved(True, 16)[0],
        solved(True, 16, springs=0.1)[0],
        solved(True, 4)[0],
        solved(True, 16, tfeti_pc_type="dirichlet")[0],
    ]
    assert names == [*["newton + late dirichlet"] * 2, *["newton + dirichlet"] * 2]


def test_factors_that_come_late_read_the_options_of_the_problem(monkeypatch):
    given, name, seen = sparse_block.regularised, "pc_factor_mat_solver_type", []

    def watched(K, R, fixing, prefix, *others):
        seen.append(PETSc.Options(prefix).getString(name, "none"))
        return given(K, R, fixing, prefix, *others)

    monkeypatch.setattr(sparse_block, "regularised", watched)
    solved(extensions=late(4), tfeti_sub_pc_factor_mat_solver_type="mumps")
    assert seen
    assert set(seen) == {"mumps"}


def test_what_rounding_stops_begins_again_with_S_once():
    """No tolerance is met: the lumped solve and that with S both end by rounding."""
    _, made, alone, u = solved(tfeti_pc_type="lumped", tfeti_rtol=1e-20)
    assert made == 1
    _, made, count, found = solved(extensions=late(1000), tfeti_rtol=1e-20)
    assert made == 2
    assert alone < count < 3 * alone
    assert apart(found, u) <= 1e-12
