"""A small scene in which one thing at a time is done wrong."""

from functools import cached_property

import numpy as np
import ufl
from dolfinx import fem
from dolfinx import mesh as dmesh
from mpi4py import MPI
from scenes import box, hooke, solved, strain

import tfeti_dolfinx as tfeti


class Scene:
    """A square of quadrilaterals, or a cube of hexahedra, in two subdomains; everything is lazy."""

    def __init__(self, cell="quadrilateral", n=2):
        self.cell, self.n = cell, n
        self.comm = MPI.COMM_WORLD

    @cached_property
    def cube(self):
        return Scene("hexahedron")

    @cached_property
    def box(self):
        return box(self.cell, self.n)

    @property
    def mesh(self):
        """The mesh before it is torn."""
        return self.box[0]

    @property
    def facet_tags(self):
        """Facet tags before the mesh is torn."""
        return self.box[1]

    @cached_property
    def cell_tags(self):
        """Cell tags before the mesh is torn: all 5."""
        tdim = self.mesh.topology.dim
        cells = np.arange(self.mesh.topology.index_map(tdim).size_local, dtype=np.int32)
        return dmesh.meshtags(self.mesh, tdim, cells, np.full_like(cells, 5))

    @cached_property
    def d(self):
        names = {**self.box[2], "nothing": 99}
        return tfeti.decompose(
            self.mesh, 2, self.cell_tags, self.facet_tags, surfaces=names, volumes={"steel": 5}
        )

    @cached_property
    def inner(self):
        """The same with a surface 1, "middle", that lies inside the body."""
        tdim = self.mesh.topology.dim
        facets = dmesh.locate_entities(self.mesh, tdim - 1, lambda x: np.isclose(x[tdim - 1], 0.5))
        tags = dmesh.meshtags(self.mesh, tdim - 1, facets, np.full_like(facets, 1))
        other = Scene(self.cell)
        other.__dict__["d"] = tfeti.decompose(self.mesh, 1, facet_tags=tags, surfaces={"middle": 1})
        return other

    @property
    def gdim(self):
        return self.mesh.geometry.dim

    @property
    def vector(self):
        """Element of displacements."""
        return ("Lagrange", 1, (self.gdim,))

    @cached_property
    def V(self):
        return self.space(*self.vector)

    def space(self, *element):
        return fem.functionspace(self.d.mesh, element)

    def untorn_space(self, *element):
        return fem.functionspace(self.mesh, element)

    @cached_property
    def twin(self):
        """A space that is equal to V, but another one."""
        return self.space(*self.vector)

    @cached_property
    def twin_u(self):
        return fem.Function(self.twin)

    @property
    def u(self):
        return ufl.TrialFunction(self.V)

    @property
    def v(self):
        return ufl.TestFunction(self.V)

    @property
    def dx(self):
        return ufl.Measure("dx", domain=self.d.mesh, metadata={"quadrature_degree": 2})

    def ds(self, data=None):
        data = self.d.facet_tags if data is None else data
        return ufl.Measure("ds", domain=self.d.mesh, subdomain_data=data)

    def a_on(self, V, dx=None):
        u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
        return ufl.inner(hooke()(u), strain(v)) * (dx or self.dx)

    @cached_property
    def a(self):
        return self.a_on(self.V)

    @cached_property
    def mass(self):
        return ufl.inner(self.u, self.v) * self.dx

    @property
    def f(self):
        return fem.Constant(self.d.mesh, np.r_[np.zeros(self.gdim - 1), -0.05])

    @cached_property
    def L(self):
        return ufl.inner(self.f, self.v) * self.dx

    def on(self, side="left", V=None):
        """Unknowns of a space on a side of the torn mesh."""
        return fem.locate_dofs_topological(V or self.V, self.gdim - 1, self.d.facets(side))

    def clamp(self, value=0.0, side="left"):
        return fem.dirichletbc(np.full(self.gdim, value), self.on(side), self.V)

    @property
    def floor(self):
        up = np.r_[np.zeros(self.gdim - 1), 1.0]
        return tfeti.Obstacle("bottom", tfeti.Plane(-0.01 * up, up))

    def problem(self, **changes):
        """The problem, with some of its arguments changed."""
        usual = {
            "a": lambda: self.a,
            "L": lambda: self.L,
            "bcs": lambda: [self.clamp()],
            "contacts": list,
            "decomposition": lambda: self.d,
        }
        missing = {name: make() for name, make in usual.items() if name not in changes}
        return tfeti.ContactProblem(**missing, **changes)

    def with_contacts(self, *contacts, **options):
        """Solve with contacts."""
        return self.problem(contacts=list(contacts), petsc_options=options).solve()

    def with_shape(self, shape):
        """Solve with an obstacle below the body."""
        return self.with_contacts(tfeti.Obstacle("bottom", shape))

    def options(self, **options):
        """The problem with some options."""
        return self.problem(petsc_options=options)

    @cached_property
    def solved(self):
        """A solution with a contact and a stress."""
        return solved(self.problem(contacts=[self.floor], stress=hooke())).solution

    @cached_property
    def twice(self):
        """A solution with two contacts of one name."""
        return solved(self.problem(contacts=[self.floor, self.floor])).solution

    @cached_property
    def bare(self):
        """A solution without contacts and stress."""
        return solved(self.problem()).solution


def raising(*_):
    raise ZeroDivisionError("no such place")
