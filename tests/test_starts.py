"""What a second solve costs, and what may be put into solvers from outside."""

import numpy as np
import pytest
from scenes import curved_obstacle, decomposed, problem
from test_qp import Counted, bounds_on, matrix, random_program, to, vector

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.options import Options
from tfeti_dolfinx.qp.coarse import DenseCoarse
from tfeti_dolfinx.qp.homogenised import (
    LastProduct,
    homogenise,
    natural,
    operator_product,
    scale_at,
    scale_near,
)
from tfeti_dolfinx.qp.newton import first_point, newton
from tfeti_dolfinx.qp.problem import QP
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
    if p.dual._image is not None:
        p.dual._image[1].destroy()
    p.dual._image = None
    p.dual.last = LastProduct()


@pytest.mark.parametrize("qp_type", ["pcpg", "smalse", "newton"])
@pytest.mark.parametrize("contacts", [0, 1])
def test_a_solve_from_its_own_solution(qp_type, contacts):
    """PCPG and Newton multiply once, SMALSE-M twice; once less if F λ̄, or F λ, is known."""
    if qp_type == "pcpg" and contacts:
        pytest.skip("PCPG keeps no bounds")
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


def test_pcpg_from_multipliers_that_do_not_balance_the_load():
    """Gλ = e is restored without a multiplication."""
    p, (lam, mu) = scene(0)
    u = p.dofs.to_primal(p.u.x.array)
    cold, _, _ = cost(p, "pcpg", None)
    start = (lam * (1.0 + 1e-4 * np.cos(np.arange(len(lam)))), mu)
    warm, _, again = cost(p, "pcpg", start)
    assert 1 < warm < cold
    assert np.allclose(again, u, rtol=0.0, atol=1e-5 * p.u.x.petsc_vec.norm())
    p.destroy()


def test_known_images_cost_nothing():
    F, d, G, e, bounded = random_program(3)
    counted = Counted(matrix(F))
    qp = QP(counted, vector(d), DenseCoarse(G, e), bounds_on(bounded))
    at = operator_product(qp.F, natural(qp.coarse, qp.d))
    assert counted.count == 1
    from_image, cold = homogenise(qp, at), homogenise(qp)
    assert counted.count == 2
    assert np.array_equal(from_image.b.array_r, cold.b.array_r)
    assert from_image.scale == cold.scale
    assert np.allclose(from_image.gradient.array_r, F @ at.x.array_r - d)
    other = operator_product(qp.F, vector(np.linalg.lstsq(G, e, rcond=None)[0]))
    assert homogenise(qp, other, scale_at(qp, at)).scale == cold.scale
    near = scale_near(qp, other)
    assert counted.count == 3
    assert near.reference >= np.linalg.norm(homogenise(qp, other).b.array_r) / 2


def test_the_last_image_is_that_of_a_look():
    """Else that of the gradient; what another solver passes on stands for what is near."""
    F, d, G, e, bounded = random_program(3)
    counted = Counted(matrix(F))
    qp = QP(counted, vector(d), DenseCoarse(G, e), bounds_on(bounded))
    homogenised = homogenise(qp, operator_product(qp.F, first_point(qp)))
    result, last = newton(qp, homogenised, to(1e-9, homogenised)), LastProduct()
    comm, lam = qp.d.getComm().tompi4py(), np.array(result.lam.array_r)
    last.keep(result, qp)
    assert np.allclose(last.known(comm, lam), F @ lam, rtol=0, atol=1e-6)
    exact = F @ lam - d
    last.look(result.lam, exact)
    result.gradient.array[:] += 1.0
    last.keep(result, qp)
    assert np.array_equal(last.known(comm, lam), exact + d)
    last.look(qp.d, exact)
    last.keep(result, qp)
    assert not np.allclose(last.known(comm, lam), F @ lam, rtol=0, atol=0.5)
    before, way = counted.count, np.zeros(len(lam))
    way[0] = 1e-3
    last.pass_on(lam, F @ lam, 2e-3)
    near = last.image(counted, vector(lam + way))
    assert counted.count == before
    assert np.array_equal(near.Fx.array_r, F @ lam)
    assert last.known(comm, lam + way).size == 0
    far = last.image(counted, vector(lam + 3.0 * way))
    assert counted.count == before + 1
    assert np.allclose(far.Fx.array_r, F @ (lam + 3.0 * way), rtol=0, atol=1e-12)
    last.keep(result, qp)
    last.image(counted, vector(lam + way))
    assert counted.count == before + 2


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
