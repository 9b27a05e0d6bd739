"""A box with mass that is thrown at a plane, or at a box below it."""

import numpy as np
import ufl
from bodies import stacked
from dolfinx import fem
from scenes import accepted, decomposed, elastic, vectors

import tfeti_dolfinx as tfeti


def thrown_velocity(gdim, x, above, speed, along, spin):
    """A velocity at points."""
    v = np.zeros((gdim, x.shape[1]))
    v[-1] = -speed * (x[gdim - 1] > above) - spin * (x[0] - 0.4)
    v[0] += along + spin * x[gdim - 1] ** 2
    return v


class Thrown:
    """A unit box, E = ρ = 1, with a velocity that is not rigid, above a plane, or a box on it.

    ``thrown``: speed downwards, along, and of a part that turns and shears. ``begin``: displacement
    along at the start; the plane has the opposite one. Keywords are those of ``ContactDynamics``;
    others are options.
    """

    def __init__(
        self,
        cell="quadrilateral",
        n=4,
        gap=0.02,
        friction=None,
        below=False,
        nu=0.3,
        weight=0.0,
        thrown=(0.3, 0.1, 0.05),
        begin=0.0,
        subdomains=4,
        reach=1.0,
        **keywords,
    ):
        d = stacked(cell, 2, 3, 4, gap=gap) if below else decomposed(cell, n, subdomains)
        self.gdim = gdim = d.mesh.geometry.dim
        V, u, v = vectors(d)
        self.weight = fem.Constant(d.mesh, -weight * np.eye(gdim)[-1])
        velocity = fem.Function(V)
        velocity.interpolate(lambda x: thrown_velocity(gdim, x, gap / 2 if below else -1, *thrown))
        low, up = (-1.0 if below else -gap), np.eye(gdim)[-1]
        at = fem.Function(V)
        at.x.array[::gdim] = begin
        plane = tfeti.Plane(low * up, up)
        plane = tfeti.RigidBody(plane, displacement=(-begin, 0.0)) if begin else plane
        bottom = "lower bottom" if below else "bottom"
        contacts = [tfeti.Obstacle(bottom, plane, friction=friction, reach=reach, name="plane")]
        if below:
            contacts.append(tfeti.Contact("upper bottom", "lower top", reach=1.0))
        own = {k: keywords.pop(k) for k in ("mass", "stabilised", "lumped") if k in keywords}
        given = elastic(u, v, nu=nu), ufl.dot(self.weight, v) * ufl.dx(domain=d.mesh), [], contacts
        own = {"mass": 1.0, **own, "petsc_options": {"rtol": 1e-10, **keywords}}
        self.problem = tfeti.ContactDynamics(*given, d, velocity=velocity, u=at, **own)

    def apply(self, problem, t):
        """Pushed more and more."""
        self.weight.value[0] = 0.02 * t

    def step(self, size, count=1):
        """Go on, and give the reports of the steps."""
        self.problem.take_step(size)
        reports = (accepted(self.problem) for _ in range(count))
        return [(dict(report.motion), report.contact_forces) for report in reports]
