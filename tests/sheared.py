"""A block that is pressed on a rough plane and sheared: uniform stress, one slip."""

import numpy as np
import ufl
from bodies import clamped, drawn, two_body_problem
from dolfinx import fem
from scenes import curved_obstacle, decomposed, elastic, roller, vectors

import tfeti_dolfinx as tfeti

# of E = 1, ν = 0: σ_xx does not follow from σ_yy, and simple shear leaves the sides where they are
MU, BOUND, PRESSED = 0.5, 0.02, 0.01


def tops(path):
    """Shear and slip, step by step, of a block whose top goes along a path, in closed form."""
    shear, slip, found = 0.0, 0.0, []
    for before, after in zip([0.0, *path[:-1]], path, strict=True):
        wanted = shear + MU * (after - before)
        new = np.clip(wanted, -BOUND, BOUND)
        step = (wanted - new) / MU
        shear, slip = new, slip + step
        found.append((shear, step, slip))
    return found


class Sheared:
    """The block; ``top`` is where its upper side is held."""

    def __init__(self, cell="quadrilateral", n=4, subdomains=3, **options):
        d = decomposed(cell, n, subdomains)
        gdim = d.mesh.geometry.dim
        last, fdim = gdim - 1, gdim - 1
        V, u, v = vectors(d)
        self.top = fem.Constant(d.mesh, 0.0)
        W, _ = V.sub(last).collapse()
        down = fem.Function(W)
        down.interpolate(lambda x: -PRESSED * x[last])
        sides = np.unique(np.concatenate([d.facets(name) for name in ("left", "right", "top")]))
        dofs = fem.locate_dofs_topological((V.sub(last), W), fdim, sides)
        bcs = [fem.dirichletbc(down, dofs, V.sub(last))]
        for k in range(last):
            bcs.append(roller(V, k, d.facets("top"), self.top if k == 0 else 0.0))
        plane = tfeti.Plane(np.zeros(gdim), np.eye(gdim)[last])
        contacts = [tfeti.Obstacle("bottom", plane, friction=tfeti.Tresca(BOUND))]
        given = elastic(u, v, nu=0.0), ufl.ZeroBaseForm((v,)), bcs, contacts, d
        self.problem = tfeti.ContactProblem(*given, petsc_options={"rtol": 1e-10, **options})


FRICTION = tfeti.Tresca(0.01)


class Driven:
    """A box on a curved obstacle or a rough plane, clamped on the left, under a traction."""

    def __init__(
        self, cell="quadrilateral", n=8, subdomains=5, rough=True, friction=FRICTION, **options
    ):
        d = decomposed(cell, n, subdomains)
        gdim = d.mesh.geometry.dim
        self.load = fem.Constant(d.mesh, np.zeros(gdim))
        if rough:
            plane = tfeti.Plane(np.zeros(gdim), np.eye(gdim)[-1])
            contact = tfeti.Obstacle("bottom", plane, friction=friction)
        else:  # rows come later
            contact = tfeti.Obstacle("bottom", curved_obstacle(gdim), reach=0.022)
        given = drawn(d, "top", self.load), clamped(d, "left")
        self.problem = two_body_problem(d, *given, [contact], **options)

    def apply(self, problem, t):
        """To and fro, pressed more and more."""
        self.load.value[0] = 0.06 * np.sin(0.5 * np.pi * t)
        self.load.value[-1] = -0.03 - 0.01 * t
