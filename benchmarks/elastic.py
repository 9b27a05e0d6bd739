"""Elastic bodies on a torn mesh: loads and conditions are added by the names of surfaces."""

from __future__ import annotations

from typing import Any

import basix.ufl
import numpy as np
import ufl
from dolfinx import fem
from dolfinx import mesh as dmesh
from mpi4py import MPI

import tfeti_dolfinx as tfeti


def triangles(points: Any, cells: Any) -> dmesh.Mesh:
    """A mesh of triangles, shapes ``(n, 2)`` and ``(m, 3)``."""
    element = basix.ufl.element("Lagrange", "triangle", 1, shape=(2,))
    return dmesh.create_mesh(MPI.COMM_WORLD, cells=cells.astype(np.int64), x=points, e=element)


def gathered(*parts: Any) -> list[Any]:
    """Arrays, each of them the rows of all ranks. Collective."""
    return [np.concatenate(MPI.COMM_WORLD.allgather(part)) for part in parts]


class Elastic:
    """Elastic bodies with their space.

    Args:
        decomposition: The torn mesh.
        E: Young's modulus, or moduli of volumes.
        nu: Poisson's ratio.
        model: As for ``Elasticity``.
        degree: Of the displacement.
    """

    def __init__(
        self, decomposition: tfeti.Decomposition, E: Any, nu: float, model: str, degree: int = 1
    ) -> None:
        self.decomposition = d = decomposition
        self.gdim = d.mesh.geometry.dim
        self.elastic = tfeti.Elasticity(d, E=E, nu=nu, model=model)
        self.V = fem.functionspace(d.mesh, ("Lagrange", degree, (self.gdim,)))
        self.u, self.v = ufl.TrialFunction(self.V), ufl.TestFunction(self.V)
        self._ds = ufl.Measure("ds", domain=d.mesh, subdomain_data=d.facet_tags)
        self.bcs: list[fem.DirichletBC] = []
        self.L: Any = ufl.ZeroBaseForm((self.v,))

    def constant(self, *values: float) -> fem.Constant:
        """A number, or a vector, that may be changed without compiling anything."""
        return fem.Constant(self.decomposition.mesh, values if len(values) > 1 else values[0])

    def ds(self, surface: str) -> Any:
        """The measure of a surface."""
        return self._ds(self.decomposition.surface(surface))

    def dofs(self, surface: str, axis: int) -> Any:
        """Dofs of a component on a surface."""
        facets = self.decomposition.facets(surface)
        return fem.locate_dofs_topological(self.V.sub(axis), self.gdim - 1, facets)

    def hold(self, surface: str, axis: int, value: float = 0.0) -> fem.Constant:
        """Prescribe a component; returns what its value may be changed by."""
        given = self.constant(value)
        self.bcs.append(fem.dirichletbc(given, self.dofs(surface, axis), self.V.sub(axis)))
        return given

    def load(self, surface: str, traction: Any) -> None:
        """Add a traction, a vector in UFL."""
        self.L += self.elastic.thickness * ufl.dot(traction, self.v) * self.ds(surface)

    def parts(self, contacts: list[Any]) -> dict[str, Any]:
        """Arguments of the linear problem."""
        return {
            "a": self.elastic.a(self.u, self.v),
            "L": self.L,
            "bcs": self.bcs,
            "contacts": contacts,
            "decomposition": self.decomposition,
            "stress": self.elastic.stress,
            "thickness": self.elastic.thickness,
        }

    def problem(self, contacts: list[Any], **options: Any) -> tfeti.ContactProblem:
        """The linear problem, to rtol 1e-8."""
        return tfeti.ContactProblem(**self.parts(contacts), petsc_options={"rtol": 1e-8, **options})

    def plastic(
        self, contacts: list[Any], rtol: float, **law: float
    ) -> tuple[tfeti.J2Plasticity, tfeti.NonlinearContactProblem]:
        """J2 plasticity of these numbers, and its problem."""
        u = fem.Function(self.V)
        steel = tfeti.J2Plasticity(self.elastic, u, **law)
        given, options = (u, self.bcs, contacts, self.decomposition), {"rtol": rtol}
        F = steel.residual(self.v)
        return steel, tfeti.NonlinearContactProblem(F, *given, petsc_options=options)
