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


def of_degree(s, degree):
    V = s.space("Lagrange", degree, (2,))
    bc = fem.dirichletbc(np.zeros(2), s.on(V=V), V)
    dx = ufl.dx(domain=s.d.mesh)
    L = ufl.inner(s.f, ufl.TestFunction(V)) * dx
    return solved(s, a=s.a_on(V, dx), L=L, bcs=[bc], contacts=[s.floor], stress=hooke())


def without_load(s, L):
    return solved(s, L=L, bcs=[s.clamp(), s.clamp(0.1, "right")])


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
    "conditions on a region inside": lambda s: solved(
        s.finer, bcs=[inside(s.finer, lambda x: x[0] < 0.3)]
    ),
    "conditions on a plane that is a tear": lambda s: solved(
        s.finer, bcs=[s.finer.clamp(), inside(s.finer, lambda x: np.isclose(x[0], 0.5))]
    ),
    "u on an equal space": lambda s: solved(s, u=fem.Function(s.twin)),
    "a space of degree 2": lambda s: of_degree(s, 2),
    "no load, by UFL's zero": lambda s: without_load(s, ufl.ZeroBaseForm((s.v,))),
    "forms of several integrals": lambda s: solved(
        s, L=s.L + traction(s, s.ds(), 4) + traction(s, s.ds(), 2) + 2 * s.L
    ),
    "ds with a list for data": lambda s: solved(
        s, L=traction(s, s.ds([(2, pairs(s, "right")), (4, pairs(s, "top"))]), 4)
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
    "a cylinder across the plane": lambda s: with_shape(
        s, tfeti.Cylinder((0.5, -1.0), (0, 0, 1), np.int64(1))
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
    "the same law twice on a surface": lambda s: solved(
        s,
        contacts=[
            tfeti.Obstacle("bottom", s.floor.shape, friction=tfeti.Tresca(0.1)) for _ in range(2)
        ],
    ),
    "a sheet that keeps its volume": lambda s: with_elasticity(s, nu=0.5, model="plane_stress"),
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
    "a prefix of one's own": lambda s: (
        s.problem(petsc_options={"ring_rtol": 1e-8}, petsc_options_prefix="ring_").options.rtol
        == 1e-8
    ),
    "options of the compiler": lambda s: solved(
        s, form_compiler_options={}, jit_options={"timeout": 200}
    ),
    "a mesh that was cut out of another": lambda s: decomposed_submesh(s, 2),
}
