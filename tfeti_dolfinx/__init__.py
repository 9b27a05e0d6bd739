"""Multi-body elastic contact by Total FETI, as a FEniCSx application.

Example:
    An elastic square falls on a floor, which bears its weight.

    >>> import numpy as np
    >>> import ufl
    >>> from dolfinx import fem
    >>> from dolfinx import mesh as dmesh
    >>> from mpi4py import MPI
    >>> import tfeti_dolfinx as tfeti
    >>> comm = MPI.COMM_WORLD
    >>> square = dmesh.create_unit_square(comm, 8, 8)
    >>> facets = dmesh.locate_entities_boundary(square, 1, lambda x: np.isclose(x[1], 0))
    >>> tags = dmesh.meshtags(square, 1, facets, np.full_like(facets, 1))
    >>> decomposition = tfeti.decompose(square, 4, facet_tags=tags, surfaces={"bottom": 1})
    >>> elastic = tfeti.Elasticity(decomposition, E=1.0, nu=0.3, model="plane_strain")
    >>> V = fem.functionspace(decomposition.mesh, ("Lagrange", 1, (2,)))
    >>> u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    >>> weight = fem.Constant(decomposition.mesh, (0.0, -0.1))
    >>> floor = tfeti.Obstacle("bottom", tfeti.Plane((0, -0.1), normal=(0, 1)), name="floor")
    >>> problem = tfeti.ContactProblem(
    ...     elastic.a(u, v), ufl.dot(weight, v) * ufl.dx, [], [floor], decomposition
    ... )
    >>> uh = problem.solve()
    >>> force = comm.allreduce(problem.solution.contact("floor").force.sum())
    >>> print(f"{force:.6f}")
    0.100000
"""

from typing import TYPE_CHECKING, Any

from tfeti_dolfinx.contact.friction import Coulomb, Tresca
from tfeti_dolfinx.contact.partner import Contact, Obstacle
from tfeti_dolfinx.contact.records import ContactData, ContactStatus
from tfeti_dolfinx.contact.rigid_body import RigidBody
from tfeti_dolfinx.contact.shapes import (
    Cylinder,
    Plane,
    SignedDistance,
    Sphere,
    SurfaceMesh,
    read_surface,
)
from tfeti_dolfinx.errors import (
    ConvergenceError,
    FactorError,
    InputError,
    NoSolutionError,
    TfetiError,
)
from tfeti_dolfinx.extensions import PLUGINS, plugin
from tfeti_dolfinx.forms.elasticity import Elasticity
from tfeti_dolfinx.io.output import write_pvd, write_vtx, write_xdmf
from tfeti_dolfinx.io.plot import plot_deformed, plot_friction, plot_pressure
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dolfinx_input import decompose
from tfeti_dolfinx.mesh.gmsh_input import read_gmsh
from tfeti_dolfinx.nonlinear.finite_plasticity import FiniteJ2Plasticity
from tfeti_dolfinx.nonlinear.hyperelasticity import NeoHooke, SaintVenantKirchhoff
from tfeti_dolfinx.nonlinear.materials import J2Plasticity
from tfeti_dolfinx.nonlinear.newton import NewtonTolerances
from tfeti_dolfinx.nonlinear.problem import NonlinearContactProblem
from tfeti_dolfinx.problem import ContactProblem
from tfeti_dolfinx.report import Report
from tfeti_dolfinx.solution import Solution
from tfeti_dolfinx.steps.dynamics import ContactDynamics, NonlinearContactDynamics
from tfeti_dolfinx.steps.load_steps import LoadSteps

__version__ = "0.1.0.dev0"

if TYPE_CHECKING:
    from tfeti_dolfinx.bem.boundary_elements import BoundaryElements

__all__ = [
    "BoundaryElements",
    "Contact",
    "ContactData",
    "ContactDynamics",
    "ContactProblem",
    "ContactStatus",
    "ConvergenceError",
    "Coulomb",
    "Cylinder",
    "Decomposition",
    "Elasticity",
    "FactorError",
    "FiniteJ2Plasticity",
    "InputError",
    "J2Plasticity",
    "LoadSteps",
    "NeoHooke",
    "NewtonTolerances",
    "NoSolutionError",
    "NonlinearContactDynamics",
    "NonlinearContactProblem",
    "Obstacle",
    "Plane",
    "Report",
    "RigidBody",
    "SaintVenantKirchhoff",
    "SignedDistance",
    "Solution",
    "Sphere",
    "SurfaceMesh",
    "TfetiError",
    "Tresca",
    "__version__",
    "decompose",
    "plot_deformed",
    "plot_friction",
    "plot_pressure",
    "read_gmsh",
    "read_surface",
    "write_pvd",
    "write_vtx",
    "write_xdmf",
]


def __getattr__(name: str) -> Any:
    """Return a name of an optional part, imported when it is asked for."""
    if name in __all__ and name in PLUGINS:
        return plugin(name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
