"""A feasible set of one's own, a half space per row, solves a scene."""

import numpy as np
import pytest
from scenes import curved_obstacle, decomposed, problem

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.dual.dual import Dual
from tfeti_dolfinx.options import Options
from tfeti_dolfinx.qp.conformance import check_feasible_set
from tfeti_dolfinx.qp.faces import Status, face_of
from tfeti_dolfinx.qp.feasible_sets import Product
from tfeti_dolfinx.solver import solve_dual


class HalfSpaces:
    """a_i x_i ≤ b_i, a_i < 0: a force may pull up to a limit, and then lets go."""

    def __init__(self, a, b):
        self.a, self.b = a, b

    def project(self, x):
        return np.where(self.a * x > self.b, self.b / self.a, x)

    def _bound(self, x):
        return self.a * x >= self.b - 1e-14 * np.abs(self.b)

    def split(self, x, g):
        bound = self._bound(x)
        return np.where(bound, 0.0, g), np.where(bound, np.minimum(g, 0.0), 0.0)

    def reduced(self, x, phi, alpha):
        return np.minimum(phi, (x - self.b / self.a) / alpha)

    def max_step(self, x, p):
        down = self.a * p < 0.0
        return np.min((self.a * x - self.b)[down] / (self.a * p)[down], initial=np.inf)

    def shifted(self, shift):
        return HalfSpaces(self.a, self.b - self.a * shift)

    def face(self, x, g):
        off = ~self._bound(x)
        return face_of(off, np.where(off, Status.TOUCHING, Status.OPEN))


def pulling(limit):
    """At most this force at each node, s_i λ_i ≥ −limit."""

    def law(constraints):
        scale = constraints.scale
        half_spaces = HalfSpaces(-scale, np.full(len(scale), float(limit)))
        return Product([(constraints.sets.normals, half_spaces)])

    return law


@pytest.fixture(scope="module")
def solved():
    obstacle = tfeti.Obstacle("bottom", curved_obstacle(3))
    p = problem(decomposed("hexahedron", 4, 6), contacts=[obstacle], tfeti_rtol=1e-9)
    p.solve()
    yield p
    p.destroy()


def with_law(p, law):
    """λ, u, flags of the rows that carry a force, and c − B u."""
    d, dual = p.decomposition, p._system.dual
    names = d.body_names, list("abcdef")
    own = Dual(dual.constraints, dual.subdomains, *names, "none", feasible=law)
    result, accuracy = solve_dual(own, Options(rtol=1e-9), "smalse")
    assert result.reason > 0
    u, lam = accuracy.u, np.array(result.lam.array_r)
    carrying = result.face.carrying
    trace, left = dual.constraints.B.createVecRight(), dual.d.duplicate()
    trace.array[:] = u[dual.constraints.trace]
    dual.constraints.B.mult(trace, left)
    left.aypx(-1.0, dual.constraints.c)
    result.destroy()
    own.destroy()
    return lam, u, carrying, np.array(left.array_r)


def test_it_conforms():
    check_feasible_set(HalfSpaces(-np.arange(1.0, 11.0), np.linspace(-1.0, 2.0, 10)), 10)


def test_without_pulling_it_is_contact(solved):
    lam, u, carrying, _ = with_law(solved, pulling(0.0))
    exact = solved.dofs.to_primal(solved.u.x.array)
    assert np.allclose(u, exact, atol=1e-7 * solved.u.x.petsc_vec.norm())
    assert np.allclose(lam, solved.solution.lam, atol=1e-5 * np.abs(lam).max(initial=1e-30))
    assert np.array_equal(carrying, solved.solution.carrying)


@pytest.mark.parametrize("limit", [1e-4, np.inf])
def test_glue_that_lets_go_at_a_limit(solved, limit):
    """Nodes are on the obstacle, or pull with the limit and are off it."""
    lam, u, carrying, left = with_law(solved, pulling(min(limit, 1e6)))
    constraints, comm = solved._system.dual.constraints, solved.decomposition.comm
    rows = constraints.sets.normals
    force, gap = constraints.scale * lam[rows], left[rows] / constraints.scale
    size = comm.allreduce(float(np.abs(u).max(initial=0.0)), op=max)
    assert comm.allreduce(int(np.sum(force < 0.0))) > 0
    assert np.all(np.abs(gap[carrying[rows]]) <= 1e-7 * size)
    assert np.all(gap >= -1e-7 * size)
    open_rows = ~carrying[rows]
    assert np.allclose(force[open_rows], -limit, rtol=1e-9)
    assert (comm.allreduce(int(np.sum(open_rows))) > 0) == (limit < 1.0)
