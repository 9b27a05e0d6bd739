"""Uses that look unusual and are right: none of them may be refused."""

import numpy as np
import ufl
from dolfinx import fem

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


def with_elasticity(s, dx=None, **arguments):
    elastic = tfeti.Elasticity(s.d, **{"E": 1.0, **arguments})
    a = elastic.a(s.u, s.v, dx)
    return solved(s, a=a, stress=elastic.stress, thickness=elastic.thickness)


def function(s, *element):
    E = fem.Function(s.space(*element))
    E.x.array[:] = 1.0
    return E


def options(s, **given):
    return s.problem(petsc_options=given).options


ACCEPTED = {
    "conditions and contacts in tuples": lambda s: solved(s, bcs=(s.clamp(),), contacts=(s.floor,)),
    "u on an equal space": lambda s: solved(s, u=fem.Function(s.twin)),
    "forms of several integrals": lambda s: solved(
        s, L=s.L + traction(s, s.ds(), 4) + traction(s, s.ds(), 2) + 2 * s.L
    ),
    "ds with a list for data": lambda s: solved(
        s, L=traction(s, s.ds([(2, pairs(s, "right")), (4, pairs(s, "top"))]), 4)
    ),
    "a graded foundation": lambda s: solved(
        s, a=s.a + s.u[0] * s.v[0] / (1 + ufl.SpatialCoordinate(s.d.mesh)[0]) * s.dx
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
    "the same law twice on a surface": lambda s: solved(
        s,
        contacts=[
            tfeti.Obstacle("bottom", s.floor.shape, friction=tfeti.Tresca(0.1)) for _ in range(2)
        ],
    ),
    "an integral over a volume beside one over all": lambda s: solved(
        s, a=s.a + ufl.inner(s.u, s.v) * s.dx(subdomain_data=s.d.cell_tags)(5)
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
}
