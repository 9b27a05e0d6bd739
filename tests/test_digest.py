"""What a checkpoint knows of a problem: another one is named, whatever ranks it is on."""

import json

import pytest
import ufl
from dolfinx import fem
from moving import Thrown
from mpi4py import MPI
from scenes import clamp, decomposed, forms

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.common.agreement import check_same_problem


def of_points(x):
    return 0.01 + 0.0 * x[0]


class Given:
    """A square on a rough floor, with a load and a prescribed value that are functions."""

    def __init__(self, comm=MPI.COMM_WORLD, subdomains=2, plane=0.01, rise=lambda t: 0, **contact):
        d = decomposed("quadrilateral", 4, subdomains, comm)
        self.V, self.a, L = forms(d.mesh, d.facet_tags, (0, -0.05), d.surface("top"))
        self.weight, self.held = fem.Function(self.V), fem.Function(self.V)
        self.factor = fem.Constant(d.mesh, 1.0)
        v = self.a.arguments()[0]
        self.L = L + self.factor * ufl.inner(self.weight, v) * ufl.dx
        plane = tfeti.Plane((0, -plane), (0, 1))
        shape = tfeti.RigidBody(plane, displacement=lambda t: (0, rise(t)), name="floor")
        floor = tfeti.Obstacle("bottom", shape, **{"friction": tfeti.Coulomb(0.3), **contact})
        bcs = [clamp(self.V, d.facets("left"), self.held)]
        self.problem = tfeti.ContactProblem(self.a, self.L, bcs, [floor], d)
        self.apply(1.0)

    def apply(self, t, weight=1.0, held=1.0):
        """Set the loads of a time."""
        self.weight.interpolate(lambda x: (0 * x[0], -weight * t * x[1]))
        self.held.interpolate(lambda x: (1e-3 * held * t * x[1], 0 * x[0]))

    def digest(self, t=None, **loads):
        if t is not None:
            self.apply(t, **loads)
        return json.loads(json.dumps(self.problem.digest()))


def stiffer(given):
    given.problem.update(stiffness=given.a + given.a)
    return given.digest()


def moved(given):
    given.V.mesh.geometry.x[:, 1] += 1e-3
    return given.digest()


def factor(given):
    given.factor.value = 2.0
    return given.digest()


OTHERS = {
    "contacts[0]: friction: coefficient is 0.4, and was 0.3 when the checkpoint was written": (
        lambda: Given(friction=tfeti.Coulomb(0.4)).digest()
    ),
    "gap is the callable of_points, and was 'geometry'": lambda: Given(gap=of_points).digest(),
    "shape: shape: point[1] is -0.02, and was -0.01": lambda: Given(plane=0.02).digest(),
    "floor: motion and load[0][1] is 0.004": lambda: Given(rise=lambda t: 0.004).digest(),
    "a: structure is": lambda: stiffer(Given()),
    "L: constants[1] is 2.0, and was 1.0": lambda: factor(Given()),
    "sums over functions: bcs: function 0[0][0] is": lambda: Given().digest(1.0, held=1.1),
    "mesh: points[0][0] is": lambda: moved(Given()),
}


@pytest.mark.parametrize("says", OTHERS)
def test_another_problem_is_named(says):
    kept = Given().digest()
    check_same_problem(kept, Given().digest())
    with pytest.raises(tfeti.InputError) as found:
        check_same_problem(kept, OTHERS[says]())
    assert says in str(found.value)
    assert "expected the same problem" in str(found.value)


def test_it_is_the_same_on_any_ranks_and_another_mass_is_named(comm):
    check_same_problem(Given(MPI.COMM_SELF, 4).digest(), Given(comm, 4).digest())
    kept, other = (Thrown(n=2, subdomains=2, mass=mass).problem.digest() for mass in (1.0, 2.0))
    with pytest.raises(tfeti.InputError, match=r"mass: constants\[0\] is 2.0, and was 1.0"):
        check_same_problem(kept, other)


def test_a_digest_does_not_grow_with_the_mesh():
    sizes = [len(json.dumps(Thrown(n=n, subdomains=2).problem.digest())) for n in (2, 8)]
    assert abs(sizes[1] - sizes[0]) <= 0.1 * sizes[0]
    assert max(sizes) < 4000
