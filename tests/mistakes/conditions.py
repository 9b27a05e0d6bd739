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


def exterior(s, component=None, marker=None):
    """A condition on facets that are exterior to DOLFINx, which those on tears are, too."""
    mesh = s.d.mesh
    facets = dmesh.exterior_facet_indices(mesh.topology)
    if marker is not None:
        facets = dmesh.locate_entities_boundary(mesh, 1, marker)
    V = s.V if component is None else s.V.sub(component)
    value = np.zeros(2) if component is None else 0.0
    return fem.dirichletbc(value, fem.locate_dofs_topological(V, 1, facets), V)


def of_untorn_function(s):
    """DOLFINx does not look whether the value's mesh is that of the space."""
    return fem.dirichletbc(fem.Function(s.untorn_space(*s.vector)), [s.on(), s.on()], s.V)


def modulus_before(s):
    E = fem.Function(s.untorn_space("DG", 0), name="E")
    return lambda u: E * hooke()(u)


BCS = {
    "bcs is None": (lambda s: s.problem(bcs=None), r"bcs is None; expected a list"),
    "bcs has None": (
        lambda s: s.problem(bcs=[s.clamp(), None]),
        r"Dirichlet condition 1 is None; expected a dolfinx.fem.DirichletBC",
    ),
    "a condition of degree 2": (
        lambda s: in_space(s, s.space("Lagrange", 2, (2,))),
        r"Dirichlet condition 0 is on a space of degree 2 with 2 unknowns per node; expected the "
        r"space of a, a space of degree 1 with 2",
    ),
    "a condition on a third component in 2D": (
        lambda s: in_space(s, s.space("Lagrange", 1, (3,)).sub(2)),
        r"Dirichlet condition 0 is on a component of a space of degree 1 with 3 unknowns",
    ),
    "a condition on the mesh before it is torn": (
        lambda s: s.problem(bcs=[untorn(s)]),
        r"Dirichlet condition 0 is on another mesh; expected .*the torn mesh",
    ),
    "a value that is a function on the mesh before it is torn": (
        lambda s: s.problem(bcs=[of_untorn_function(s)]),
        r"value of Dirichlet condition 0 is a function on another mesh; .*from_original\(g\)",
    ),
    "all facets that are exterior to DOLFINx": (
        lambda s: s.problem(bcs=[s.clamp(), exterior(s)]),
        r"Dirichlet condition 1 prescribes 2 facets that lie on tears inside a body.*expected "
        r"facets of the boundary: decomposition.boundary, decomposition.facets\(name\) or decomp",
    ),
    "a component on all facets that are exterior to DOLFINx": (
        lambda s: s.problem(bcs=[exterior(s, 1)]),
        r"Dirichlet condition 0 prescribes 2 facets that lie on tears",
    ),
    "unknowns that were located in another space": (
        lambda s: in_space(s, s.V, at=s.space("Lagrange", 3, (2,))),
        r"Dirichlet condition 0 prescribes the unknown \d+, but this rank has \d+; expected",
    ),
    "a condition that holds nowhere": (
        lambda s: s.problem(bcs=[s.clamp(), s.clamp(side="nothing")]),
        r"Dirichlet condition 1 holds nowhere",
    ),
    "a value that is nan": (
        lambda s: s.problem(bcs=[s.clamp(np.nan)]).solve(),
        r"Dirichlet condition 0 has a value that is not finite",
    ),
    "conditions that contradict each other": (
        lambda s: s.problem(bcs=[s.clamp(0.0), s.clamp(0.1, "bottom")]).solve(),
        r"Dirichlet conditions contradict each other: component \d of a node is prescribed as 0",
    ),
}

U = {
    "u is on the mesh before it is torn": (
        lambda s: s.problem(u=fem.Function(s.untorn_space(*s.vector))),
        r"u is from a space of degree 1 with 2 .* on another mesh; expected the space of a",
    ),
    "u is a trial function": (lambda s: s.problem(u=s.u), r"u is a Argument; expected a dolfinx"),
}

STRESS = {
    "the stress is an expression": (
        lambda s: s.problem(stress=hooke()(fem.Function(s.V))),
        r"stress is an expression; expected a callable",
    ),
    "the stress is a number": (lambda s: s.problem(stress=1.0), r"stress is 1.0; expected a call"),
    "the stress has two rows": (
        lambda s: s.problem(stress=lambda u: ufl.sym(ufl.grad(u))),
        r"stress\(u\) has shape \(2, 2\); expected \(3, 3\)",
    ),
    "the stress returns None": (
        lambda s: s.problem(stress=lambda u: None),
        r"stress\(u\) is None; expected a UFL tensor of shape \(3, 3\)",
    ),
    "the stress takes no argument": (
        lambda s: s.problem(stress=lambda: None),
        r"stress\(u\): TypeError: .*takes 0 positional arguments",
    ),
    "the stress fails": (
        lambda s: s.problem(stress=raising),
        r"stress\(u\): ZeroDivisionError: no such place",
    ),
    "the stress has E on the mesh before it is torn": (
        lambda s: s.problem(stress=modulus_before(s)),
        r"stress: the function 'E' is on another mesh",
    ),
}

OTHERS = {
    "the decomposition is None": (
        lambda s: s.problem(decomposition=None),
        r"decomposition is None; expected what decompose or read_gmsh return",
    ),
    "form_compiler_options is a list": (
        lambda s: s.problem(form_compiler_options=["-O2"]),
        r"form_compiler_options is \['-O2'\]; expected a dictionary",
    ),
}

TABLES = ("BCS", "U", "STRESS", "OTHERS")
