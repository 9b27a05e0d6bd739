"""Layer integrals against those of ngsolve.bem, where that is installed (pip install ngsolve)."""

import numpy as np
import pytest
from panels import SPACE

from tfeti_dolfinx.bem.integrals import layers_3d
from tfeti_dolfinx.bem.steklov import IsotropicLaw, single_layer

ngsolve = pytest.importorskip("ngsolve")
bem = pytest.importorskip("ngsolve.bem")
pytestmark = pytest.mark.slow


def surface_mesh(panels):
    """The same triangles in NGSolve."""
    from netgen.meshing import Element2D, FaceDescriptor, Mesh, MeshPoint, Pnt

    mesh = Mesh(dim=3)
    points = [mesh.Add(MeshPoint(Pnt(*x))) for x in panels.x.tolist()]
    face = mesh.Add(FaceDescriptor(surfnr=1, domin=1, domout=0, bc=1))
    for nodes in panels.nodes.tolist():
        mesh.Add(Element2D(face, [points[k] for k in nodes]))
    return ngsolve.Mesh(mesh)


def dense(operator):
    """The matrix of an operator, column by column."""
    matrix = operator.mat
    x, y = matrix.CreateRowVector(), matrix.CreateColVector()
    out = np.empty((len(y), len(x)))
    for j in range(len(x)):
        x[:] = 0.0
        x[j] = 1.0
        y.data = matrix * x
        out[:, j] = y.FV().NumPy()
    return out


@pytest.fixture(scope="module", params=["cube", "ball"])
def both(request):
    panels = SPACE[request.param]()
    mesh = surface_mesh(panels)
    return panels, layers_3d(panels), mesh


def spaces(mesh):
    constant = ngsolve.SurfaceL2(mesh, order=0, dual_mapping=False)
    return constant, ngsolve.H1(mesh, order=1)


def near(a, b, bound):
    return np.abs(a - b).max() < bound * np.abs(b).max()


def test_laplace_single_and_double_layer(both):
    panels, layers, mesh = both
    constant, linear = spaces(mesh)
    u, v = constant.TnT()
    ds = ngsolve.ds(bonus_intorder=12)
    single = dense(bem.LaplaceSL(u * ds, use_fmm=False) * v * ds)
    scale = np.linalg.norm(single) / np.linalg.norm(layers.single)
    assert scale == pytest.approx(1.0, abs=1e-3)
    assert near(layers.single, single, 1e-4)
    trial = linear.TrialFunction()
    double = dense(bem.LaplaceDL(trial * ds, use_fmm=False) * v * ds)
    assert near(layers.double, double, 1e-4)


def test_lame_single_layer(both):
    panels, layers, mesh = both
    law = IsotropicLaw(0.4, 0.3)
    constant, _ = spaces(mesh)
    space = constant**3
    u, v = space.TnT()
    ds = ngsolve.ds(bonus_intorder=12)
    E = 2 * law.mu * (1 + law.nu)
    lame = dense(bem.LameSL(u * ds, E, law.nu, use_fmm=False) * v * ds)
    assert near(single_layer(layers, law), lame, 1e-4)
