"""What a second solve costs, and what may be put into solvers from outside."""

import numpy as np
import pytest
from scenes import curved_obstacle, decomposed, problem

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.options import Options
from tfeti_dolfinx.qp.homogenised import (
    LastProduct,
)
from tfeti_dolfinx.solve.solver import solve_dual


def scene(contacts, **options):
    obstacle = tfeti.Obstacle("bottom", curved_obstacle(3))
    p = problem(decomposed("hexahedron", 4, 6), contacts=[obstacle] * contacts, **options)
    p.solve()
    return p, p._start[1:]


def cost(p, qp_type, start, **options):
    """Multiplications that the solver is charged with, the power method's, and the answer."""
    dual, counts = p.dual, p.dual.F.count
    before = counts["solver"], counts["power method"]
    result, accuracy = solve_dual(dual, Options(**options), qp_type, start)
    assert result.reason > 0
    result.destroy()
    u = accuracy.u
    return counts["solver"] - before[0], counts["power method"] - before[1], u


def forget(p):
    """As if the dual problem were new."""
    for _, found in p.dual._images.values():
        found.destroy()
    p.dual._images.clear()
    p.dual.last = LastProduct()


@pytest.mark.parametrize(("qp_type", "contacts"), [("pcpg", 0), ("smalse", 1), ("newton", 1)])
def test_a_solve_from_its_own_solution(qp_type, contacts):
    """PCPG and Newton multiply once, SMALSE-M twice; once less if F λ̄, or F λ, is known."""
    p, start = scene(contacts, tfeti_qp_type=qp_type)
    u = p.dofs.to_primal(p.u.x.array)
    multiplied, power, again = cost(p, qp_type, start)
    assert (multiplied, power) == (0 if qp_type == "newton" else 1, 0)
    assert np.allclose(again, u, rtol=0.0, atol=1e-8 * np.abs(u).max(initial=0.0))
    forget(p)
    multiplied, power, again = cost(p, qp_type, start)
    assert (multiplied, power) == (2 if qp_type == "smalse" else 1, 0)
    assert np.allclose(again, u, rtol=0.0, atol=1e-8 * np.abs(u).max(initial=0.0))
    p.destroy()


@pytest.mark.parametrize(("qp_type", "contacts"), [("pcpg", 0), ("smalse", 1)])
def test_a_monitor_of_one_s_own(qp_type, contacts):
    p, _ = scene(contacts, tfeti_qp_type=qp_type)
    seen = []

    def monitor(steps, step, x, projected_gradient, equality):
        seen.append((step, projected_gradient))

    result, _ = solve_dual(p.dual, Options(), qp_type, monitor=monitor)
    inner = [size for step, size in seen if step not in ("start", "outer")]
    assert len(inner) == result.steps.inner > 3
    assert inner[-1] < 0.1 * max(inner)
    result.destroy()
    p.destroy()
