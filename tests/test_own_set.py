"""A feasible set of one's own, a half space per row: glue that lets go at a limit."""

import numpy as np
import pytest
from scenes import curved_obstacle, decomposed, problem

from tfeti_dolfinx import NoSolutionError, Obstacle, Plane
from tfeti_dolfinx.extensions import Extensions
from tfeti_dolfinx.qp.sets import Bounds, Face, Product, Status
from tfeti_dolfinx.testing import check_feasible_set


class HalfSpaces:
    def __init__(self, a, b):
        self.a, self.b = a, b

    def project(self, x):
        return np.where(self.a * x > self.b, self.b / self.a, x)

    def _bound(self, x):
        return self.a * x >= self.b - 1e-14 * np.abs(self.b)

    def max_step(self, x, p):
        down = self.a * p < 0.0
        return np.min((self.a * x - self.b)[down] / (self.a * p)[down], initial=np.inf)

    def face(self, x, g):
        off = ~self._bound(x)
        beta = np.where(off, 0.0, np.minimum(g, 0.0))
        return Face(off, np.where(off, Status.TOUCHING, Status.OPEN), beta=beta)

    def onto(self, x, status):
        return np.where(status == Status.OPEN, self.b / self.a, self.project(x))


class WithSplit(HalfSpaces):
    def split(self, x, g):
        return np.where(self._bound(x), 0.0, g), super().face(x, g).beta

    def face(self, x, g):
        return Face(~self._bound(x), super().face(x, g).status)


KINDS = pytest.mark.parametrize("kind", [HalfSpaces, WithSplit])


@KINDS
def test_it_conforms(kind):
    check_feasible_set(kind(-np.arange(1.0, 11.0), np.linspace(-1.0, 2.0, 10)), 10)


def glued(cell, n, subdomains, limit, kind=HalfSpaces):
    """A box whose contact pulls up to the limit that a function says."""

    def pulling(constraints):
        half_spaces = kind(-constraints.scale, np.full(len(constraints.scale), limit()))
        return Product([(constraints.sets.normals, half_spaces)])

    d = decomposed(cell, n, subdomains)
    obstacle = Obstacle("bottom", curved_obstacle(d.mesh.geometry.dim))
    own = Extensions(feasible_set=pulling)
    return problem(d, contacts=[obstacle], extensions=own, rtol=1e-9)


@KINDS
@pytest.mark.parametrize("limit", [1e-4, 1e6])
def test_glue_that_lets_go_at_a_limit(limit, kind):
    p = glued("hexahedron", 4, 6, lambda: limit, kind)
    noise = 1e-7 * p.solve().x.petsc_vec.norm(3)
    rows = p.solution.gluing.constraints.contact.normals
    force, gap = p.solution.force[rows], p.solution.remaining_gap[rows]
    assert np.all(gap >= -noise)
    assert np.allclose(force[gap > noise], -limit, rtol=1e-9)
    residuals, allowed = p.report.residuals, p.report.tolerances
    assert residuals["tension"] <= 1e-12 * limit
    assert residuals["complementarity"] <= allowed["complementarity"] + noise * limit
    both = p.dofs.comm.allgather((np.any(force < -1e-12), np.any(gap > noise)))
    assert np.any(both, axis=0).tolist() == [True, limit < 1.0]


def test_a_set_that_changes_is_asked_for_before_each_solve():
    limit, found = [1e6], []
    p = glued("triangle", 3, 3, lambda: limit[0])
    for limit[0] in (1e6, 0.0):
        p.solve()
        found.append(p.dofs.comm.allreduce(p.solution.force.min(initial=0.0), op=min))
    assert found[0] < -1e-3
    assert found[1] >= -1e-12


def test_glue_alone_holds_a_block_up_to_its_limit():
    """By a strength on an area of 1, and a load of 0.05: that is seen before a multiplication."""
    limit = [0.04]
    own = Extensions(
        feasible_set=lambda B: Product([(B.sets.normals, Bounds(-limit[0] * B.area / B.scale))])
    )
    ceiling = Obstacle("top", Plane((0, 0, 1), (0, 0, -1)))
    d = decomposed("hexahedron", 3, 4)
    p = problem(d, (0, 0, -0.05), [ceiling], clamped=(), loaded="bottom", extensions=own)
    with pytest.raises(NoSolutionError, match="feasible_set has no forces that balance the load"):
        p.solve()
    limit[0] = 0.06
    p.solve()
    assert p.solution.contact(0).resultant.force == pytest.approx([0, 0, 0.05], abs=1e-7)
