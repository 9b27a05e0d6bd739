"""Uses that look unusual and are right: none of them may be refused."""

import numpy as np
import ufl
from dolfinx import fem
from dolfinx import mesh as dmesh
from scenes import hooke

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.mesh.untorn import cell_facets


def solved(s, **changes):
    """Solve the scene with some changes; a displacement that is not zero."""
    u = s.problem(**changes).solve().x.array
    return s.comm.allreduce(float(np.sum(np.abs(u)))) > 0.0


def traction(s, ds, tag):
    return ufl.inner(s.f, s.v) * ds(tag)


def pairs(s, name):
    """Facets of a surface as DOLFINx's pairs of a cell and its local facet."""
    facets = cell_facets(s.d.mesh)
    cell, local = np.nonzero(np.isin(facets, s.d.facets(name)))
    return np.stack((cell, local), axis=1).astype(np.int32).ravel()


def inside(s, marker):
    """A condition on unknowns that a geometric search finds."""
    return fem.dirichletbc(np.zeros(2), fem.locate_dofs_geometrical(s.V, marker), s.V)


def on_facets(s, facets):
    return fem.dirichletbc(np.zeros(2), fem.locate_dofs_topological(s.V, 1, facets), s.V)


def of_degree(s, degree):
    V = s.space("Lagrange", degree, (2,))
    bc = fem.dirichletbc(np.zeros(2), s.on(V=V), V)
    dx = ufl.dx(domain=s.d.mesh)
    L = ufl.inner(s.f, ufl.TestFunction(V)) * dx
    return solved(s, a=s.a_on(V, dx), L=L, bcs=[bc], contacts=[s.floor], stress=hooke())


def laplacian(s):
    V = s.space("Lagrange", 1)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    return solved(
        s,
        a=ufl.inner(ufl.grad(u), ufl.grad(v)) * s.dx,
        L=fem.Constant(s.d.mesh, 1.0) * v * s.dx,
        bcs=[fem.dirichletbc(0.0, s.on(V=V), V)],
    )


def without_load(s, L):
    return solved(s, L=L, bcs=[s.clamp(), s.clamp(0.1, "right")])


def with_modulus(s, E):
    return solved(s, a=E * ufl.inner(ufl.grad(s.u), ufl.grad(s.v)) * s.dx)


def with_elasticity(s, dx=None, **arguments):
    elastic = tfeti.Elasticity(s.d, **{"E": 1.0, **arguments})
    a = elastic.a(s.u, s.v, dx)
    return solved(s, a=a, stress=elastic.stress, thickness=elastic.thickness)


def function(s, *element):
    E = fem.Function(s.space(*element))
    E.x.array[:] = 1.0
    return E


def with_friction(s, law):
    return solved(s, contacts=(tfeti.Obstacle("bottom", s.floor.shape, friction=law),))


def with_shape(s, shape):
    return solved(s, contacts=(tfeti.Obstacle("bottom", shape),))


def square_distance(x):
    """Not of unit length, but its gradient is its own."""
    return 0.5 * ((x[0] - 0.5) ** 2 + (x[1] + 1.0) ** 2 - 0.9)


def square_gradient(x):
    return np.stack((x[0] - 0.5, x[1] + 1.0))


def submesh(s):
    """All cells but the last of this rank's, of a mesh that DOLFINx has cut out of another."""
    tdim = s.mesh.topology.dim
    whole = s.mesh.topology.index_map(tdim).size_local
    cells = np.arange(whole if s.comm.rank else whole - 1, dtype=np.int32)
    return dmesh.create_submesh(s.mesh, tdim, cells)[0], s.comm.allreduce(len(cells))


def decomposed_submesh(s, subdomains):
    mesh, count = submesh(s)
    d = tfeti.decompose(mesh, subdomains)
    ids = np.concatenate(s.comm.allgather(d.original_cells))
    volume = fem.assemble_scalar(fem.form(fem.Constant(d.mesh, 1.0) * ufl.dx(domain=d.mesh)))
    whole = s.comm.allreduce(volume)
    return len(np.unique(ids)) == len(ids) == count and np.isclose(whole, count / 4)


def options(s, **given):
    return s.problem(petsc_options=given).options


ACCEPTED = {
    "conditions and contacts in tuples": lambda s: solved(s, bcs=(s.clamp(),), contacts=(s.floor,)),
    "conditions that a generator gives": lambda s: solved(s, bcs=(s.clamp() for _ in range(1))),
    "conditions on components": lambda s: solved(
        s,
        bcs=[fem.dirichletbc(0.0, s.on(V=s.V.sub(i)), s.V.sub(i)) for i in range(2)],
    ),
    "conditions on a component with a function": lambda s: solved(
        s,
        bcs=[
            s.clamp(),
            fem.dirichletbc(
                fem.Function(s.V.sub(1).collapse()[0]),
                fem.locate_dofs_topological(
                    (s.V.sub(1), s.V.sub(1).collapse()[0]), 1, s.d.facets("right")
                ),
                s.V.sub(1),
            ),
        ],
    ),
    "conditions by a geometric search": lambda s: solved(
        s,
        bcs=[
            fem.dirichletbc(
                np.zeros(2),
                fem.locate_dofs_geometrical(s.V, lambda x: np.isclose(x[0], 0.0)),
                s.V,
            )
        ],
    ),
    "conditions on a region inside": lambda s: solved(
        s.finer, bcs=[inside(s.finer, lambda x: x[0] < 0.3)]
    ),
    "conditions on a plane that is a tear": lambda s: solved(
        s.finer, bcs=[s.finer.clamp(), inside(s.finer, lambda x: np.isclose(x[0], 0.5))]
    ),
    "conditions by a broad marker": lambda s: solved(
        s.finer, bcs=[on_facets(s.finer, s.finer.d.locate_facets(lambda x: x[0] < 0.6))]
    ),
    "u on an equal space": lambda s: solved(s, u=fem.Function(s.twin)),
    "a space of degree 2": lambda s: of_degree(s, 2),
    "a space of degree 3": lambda s: of_degree(s, 3),
    "a scalar problem": laplacian,
    "no load, by UFL's zero": lambda s: without_load(s, ufl.ZeroBaseForm((s.v,))),
    "forms of several integrals": lambda s: solved(
        s, L=s.L + traction(s, s.ds(), 4) + traction(s, s.ds(), 2) + 2 * s.L
    ),
    "ds of several tags": lambda s: solved(s, L=traction(s, s.ds(), (1, 2))),
    "ds of a tag on one rank alone": lambda s: solved(s, L=traction(s, s.ds(), 3)),
    "ds with a list for data": lambda s: solved(
        s, L=traction(s, s.ds([(2, pairs(s, "right")), (4, pairs(s, "top"))]), 4)
    ),
    "dx with a list for data": lambda s: solved(
        s,
        L=traction(
            s, s.dx(subdomain_data=[(5, np.arange(len(s.d.cell_subdomain), dtype=np.int32))]), 5
        ),
    ),
    "a derivative of an energy": lambda s: solved(
        s,
        a=ufl.derivative(
            ufl.derivative(
                0.5 * ufl.inner(ufl.grad(s.twin_u), ufl.grad(s.twin_u)) * s.dx, s.twin_u, s.v
            ),
            s.twin_u,
            s.u,
        ),
    ),
    "a modulus in each cell": lambda s: with_modulus(s, function(s, "DG", 0)),
    "a load along normals": lambda s: solved(
        s, L=ufl.inner(-ufl.FacetNormal(s.d.mesh), s.v) * s.ds()(4)
    ),
    "a plane of integers": lambda s: with_shape(s, tfeti.Plane((0, -1), [0, 3])),
    "a ball of numpy's numbers": lambda s: with_shape(
        s, tfeti.Sphere(np.array([0.5, -1.0]), np.float32(0.9), inside=np.bool_(False))
    ),
    "a cylinder across the plane": lambda s: with_shape(
        s, tfeti.Cylinder((0.5, -1.0), (0, 0, 1), np.int64(1))
    ),
    "a distance that is not of unit length": lambda s: with_shape(
        s, tfeti.SignedDistance(square_distance, square_gradient)
    ),
    "a distance of two planes": lambda s: with_shape(
        s,
        tfeti.SignedDistance(
            lambda x: np.minimum(x[1] + 0.1, x[1] - x[0] + 0.7),
            lambda x: np.where(x[0] < 0.6, [[0.0], [1.0], [0.0]], [[-1.0], [1.0], [0.0]]),
        ),
    ),
    "friction that is a function of DOLFINx on cells": lambda s: with_friction(
        s, tfeti.Tresca(function(s, "DG", 0))
    ),
    "friction that is a function of points": lambda s: with_friction(
        s, tfeti.Tresca(lambda x: 0.1 * x[0])
    ),
    "friction of 0": lambda s: with_friction(s, tfeti.Tresca(0)),
    "the same law twice on a surface": lambda s: solved(
        s,
        contacts=[
            tfeti.Obstacle("bottom", s.floor.shape, friction=tfeti.Tresca(0.1)) for _ in range(2)
        ],
    ),
    "a contact of the solution by its name": lambda s: (
        s.comm.allreduce(len(s.solved.contact("obstacle of surface 'bottom'").force)) == 3
    ),
    "a sheet that keeps its volume": lambda s: with_elasticity(s, nu=0.5, model="plane_stress"),
    "a material that grows thicker": lambda s: with_elasticity(s, nu=-0.5, model="plane_strain"),
    "moduli by tags that numpy made": lambda s: with_elasticity(
        s, E={np.int32(5): np.float32(1.0)}, nu=np.float64(0.3), model="plane_strain"
    ),
    "a thickness that is a function": lambda s: with_elasticity(
        s, nu=0.3, model="plane_stress", thickness=function(s, "Lagrange", 1)
    ),
    "options of other types": lambda s: (
        options(
            s, rtol=np.float32(0.5), max_it=100.0, monitor=0, smalse_M=1, norm_steps=np.int64(9)
        ).max_it
        == 100
    ),
    "options of text": lambda s: options(s, tfeti_rtol="1e-8", tfeti_max_it="7").max_it == 7,
    "a preconditioner without contact": lambda s: solved(
        s, petsc_options={"tfeti_pc_type": "lumped"}
    ),
    "a prefix of one's own": lambda s: (
        s.problem(petsc_options={"ring_rtol": 1e-8}, petsc_options_prefix="ring_").options.rtol
        == 1e-8
    ),
    "options of the compiler": lambda s: solved(
        s, form_compiler_options={}, jit_options={"timeout": 200}
    ),
    "names with tags that numpy made": lambda s: (
        tfeti.decompose(
            s.mesh, 2, facet_tags=s.facet_tags, surfaces={"bottom": np.int32(3)}
        ).surface("bottom")
        == 3
    ),
    "subdomains by truth": lambda s: (
        tfeti.decompose(s.mesh, lambda x: x[0] > 0.5).num_subdomains == 2
    ),
    "a mesh that was cut out of another": lambda s: decomposed_submesh(s, 2),
    "a path that is text": lambda s: tfeti.Report().write(str(s.folder / "r.json"), s.comm) is None,
}
