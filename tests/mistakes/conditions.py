"""Mistakes in conditions, in u, the stress, the decomposition, and options of the compiler."""

import numpy as np
import ufl
from dolfinx import fem
from dolfinx import mesh as dmesh
from scenes import hooke

from mistakes.scene import raising


def in_space(s, V, at=None):
    """The problem with a condition on another space."""
    dofs = s.on(V=V if at is None else at)
    size = V.dofmap.index_map_bs if not V._cpp_object.component() else 1
    value = np.zeros(size) if size > 1 else 0.0
    return s.problem(bcs=[fem.dirichletbc(value, dofs, V)])


def untorn(s):
    V = s.untorn_space(*s.vector)
    facets = s.facet_tags.find(1)
    return fem.dirichletbc(np.zeros(2), fem.locate_dofs_topological(V, 1, facets), V)


def exterior(s):
    """A condition on facets that are exterior to DOLFINx, which those on tears are, too."""
    facets = dmesh.exterior_facet_indices(s.d.mesh.topology)
    return fem.dirichletbc(np.zeros(2), fem.locate_dofs_topological(s.V, 1, facets), s.V)


def of_untorn_function(s):
    """DOLFINx does not look whether the value's mesh is that of the space."""
    return fem.dirichletbc(fem.Function(s.untorn_space(*s.vector)), [s.on(), s.on()], s.V)


BCS = {
    r"bcs is a DirichletBC": lambda s: s.problem(bcs=s.clamp()),
    r"Dirichlet condition 1 is None; expected a dolfinx.fem.DirichletBC": lambda s: s.problem(
        bcs=[s.clamp(), None]
    ),
    r"Dirichlet condition 0 is on a space of degree 2 with 2 unknowns per node; expected the "
    r"space of a, a space of degree 1 with 2": lambda s: in_space(s, s.space("Lagrange", 2, (2,))),
    r"Dirichlet condition 0 is on another mesh; expected .*the torn mesh": lambda s: s.problem(
        bcs=[untorn(s)]
    ),
    r"value of Dirichlet condition 0 is a function on another mesh;": lambda s: s.problem(
        bcs=[of_untorn_function(s)]
    ),
    r"Dirichlet condition 1 prescribes 2 facets that lie on tears inside a body.*expected "
    r"facets of the boundary: decomposition.boundary, decomposition.facets\(name\) or": lambda s: (
        s.problem(bcs=[s.clamp(), exterior(s)])
    ),
    r"Dirichlet condition 0 prescribes the unknown \d+, but this rank has \d+;": lambda s: in_space(
        s, s.V, at=s.space("Lagrange", 3, (2,))
    ),
    r"Dirichlet condition 1 holds nowhere": lambda s: s.problem(
        bcs=[s.clamp(), s.clamp(side="nothing")]
    ),
    r"Dirichlet condition 0 has a value that is not finite": lambda s: s.problem(
        bcs=[s.clamp(np.nan)]
    ).solve(),
    r"Dirichlet conditions contradict each other: component \d of a node is": lambda s: s.problem(
        bcs=[s.clamp(0.0), s.clamp(0.1, "bottom")]
    ).solve(),
}

U = {
    r"u is from a space of degree 1 with 2 .* on another mesh; expected the space of a": lambda s: (
        s.problem(u=fem.Function(s.untorn_space(*s.vector)))
    ),
}

STRESS = {
    r"stress is an expression; expected a callable": lambda s: s.problem(
        stress=hooke()(fem.Function(s.V))
    ),
    r"stress\(u\) has shape \(2, 2\); expected \(3, 3\)": lambda s: s.problem(
        stress=lambda u: ufl.sym(ufl.grad(u))
    ),
    r"stress\(u\): ZeroDivisionError: no such place": lambda s: s.problem(stress=raising),
    r"stress\(u\) is 1; expected a UFL tensor": lambda s: s.problem(stress=lambda u: 1),
}

OTHERS = {
    r"decomposition is None; expected what decompose or read_gmsh return": lambda s: s.problem(
        decomposition=None
    ),
}

TABLES = ("BCS", "U", "STRESS", "OTHERS")
