"""Stiffness where conditions hold flat parts: the same solution, whatever it is, in fewer steps."""

from dataclasses import replace

import numpy as np
import pytest
import ufl
from bodies import boxes
from dolfinx import fem
from dolfinx import mesh as dmesh
from mpi4py import MPI
from scenes import displacement, hooke, strain

import tfeti_dolfinx as tfeti
from benchmarks.stress.judge import run_scene
from benchmarks.stress.meshes import grid
from benchmarks.stress.package import solve_scene
from benchmarks.stress.random_scenes import random_scene
from benchmarks.stress.scene import Body, Held, Load, Scene
from tfeti_dolfinx.constraints.stiffening import held_flat_sides
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.subdomains.block import candidate_modes
from tfeti_dolfinx.subdomains.sparse_block import holds_firmly

NU, PULL, THICK = 0.3, 1e-3, 1e-3
SUBDOMAINS = 4


class Strip:
    """A strip a thousand times as long as thick, in 2D, that lies on rollers and is pulled along.

    Args:
        stiffening: What the option is.
        wall: Whether a wall without a gap holds the left end in the place of a condition.
        lift: By how much the rollers lift it.
        thick: Its thickness.
        qp_type: The solver.
    """

    def __init__(self, stiffening, wall=False, lift=0.0, thick=THICK, qp_type="auto"):
        strip = ("strip", (0.0, 0.0), (1.0, thick), (16, 1))
        mesh, tags, names = boxes("quadrilateral", [strip])
        d = tfeti.decompose(mesh, SUBDOMAINS, facet_tags=tags, surfaces=names)
        V = fem.functionspace(d.mesh, ("Lagrange", 1, (2,)))
        u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
        ds = ufl.Measure("ds", domain=d.mesh, subdomain_data=d.facet_tags)
        self.lift = fem.Constant(d.mesh, lift)
        held = [self._held(V, d, "strip bottom", 1, self.lift)]
        plane = tfeti.Plane((0.0, 0.0), (1.0, 0.0))
        held += [] if wall else [self._held(V, d, "strip left", 0, fem.Constant(d.mesh, 0.0))]
        self.sign = -1.0 if wall else 1.0
        self.problem = tfeti.ContactProblem(
            ufl.inner(hooke(1.0, NU)(u), strain(v)) * ufl.dx,
            self.sign * PULL * v[0] * ds(d.surface("strip right")),
            held,
            [tfeti.Obstacle("strip left", plane)] if wall else [],
            d,
            petsc_options={"stiffening": stiffening, "rtol": 1e-8, "qp_type": qp_type},
        )

    @staticmethod
    def _held(V, d, side, component, value):
        part = V.sub(component)
        dofs = fem.locate_dofs_topological(part, 1, d.facets(side))
        return fem.dirichletbc(value, dofs, part)

    def errors(self):
        """Largest errors of both components, over what the strip moves by."""
        x, u = displacement(self.problem)
        along = self.sign * PULL * (1.0 - NU**2)
        across = -self.sign * PULL * NU * (1.0 + NU)
        exact = np.column_stack((along * x[:, 0], float(self.lift.value) + across * x[:, 1]))
        return np.abs(u - exact).max(axis=0) / np.abs(exact).max()

    def solve(self):
        """Multiplications by F and by the preconditioner."""
        self.problem.solve()
        report = self.problem.report
        return report.F_multiplications + report.preconditioner_multiplications


@pytest.mark.parametrize("wall", [False, True], ids=["held", "pressed"])
@pytest.mark.parametrize("stiffening", [1.0, 1e3, 1e6])
def test_the_same_solution(stiffening, wall):
    strip = Strip(stiffening, wall)
    strip.solve()
    assert strip.errors().max() <= 1e-7


def test_fewer_multiplications():
    scene = random_scene(0)  # sheets a thousand times as wide as thick, in torn pieces
    counts = []
    for stiffening in (0.0, 10.0):
        options = {"tfeti_rtol": 1e-4, "tfeti_stiffening": stiffening}
        outcome = solve_scene(replace(scene, options=options), grid(scene), MPI.COMM_WORLD)
        assert not outcome.error
        counts.append(outcome.report["F"] + outcome.report["S"])
    assert counts[1] <= 0.6 * counts[0]


def test_values_that_are_not_0_are_left_alone():
    plain, stiffened = Strip(0.0, lift=1e-4), Strip(1e3, lift=1e-4)
    for scene in (plain, stiffened):
        scene.solve()
        assert scene.errors().max() <= 1e-7
    diagonals = [scene.problem.dual.subdomains.diagonal for scene in (plain, stiffened)]
    assert np.array_equal(*diagonals)


@pytest.mark.parametrize("qp_type", ["auto", "newton", "smalse"])
def test_a_value_that_becomes_0_and_back(qp_type):
    """The kernel becomes smaller and larger again, and with it μ of the last solve."""
    strip = Strip(1e3, lift=1e-4, wall=qp_type != "auto", qp_type=qp_type)
    for lift, assembled in ((1e-4, 1), (2e-4, 0), (0.0, 1), (0.0, 0), (1e-4, 1)):
        strip.lift.value = lift
        strip.solve()
        assert strip.errors().max() <= 1e-7
        assert strip.problem.report.assemblies == assembled


def sides(cell, size, held, degree=1):
    """Nodes on sides of flat cells whose components are held, and how many nodes there are."""
    kind = getattr(dmesh.CellType, cell)
    n = [4] * len(size)
    create = dmesh.create_rectangle if len(size) == 2 else dmesh.create_box
    d = tfeti.decompose(create(MPI.COMM_WORLD, [(0.0,) * len(size), size], n, kind), 2)
    dofs = TornDofs(fem.functionspace(d.mesh, ("Lagrange", degree, (len(size),))), d)
    x = dofs.V.tabulate_dof_coordinates()
    flags = np.zeros((dofs.num_nodes, dofs.bs), dtype=bool)
    flags[:, 0] = np.isclose(x[:, held], 0.0)
    return held_flat_sides(dofs, flags), flags


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("cell", ["triangle", "quadrilateral", "tetrahedron", "hexahedron"])
def test_what_is_held_on_wide_sides_of_flat_cells_alone(cell, degree):
    gdim = 2 if cell in ("triangle", "quadrilateral") else 3
    flat = (1.0,) * (gdim - 1) + (0.01,)
    wide, held = sides(cell, flat, gdim - 1, degree)
    assert np.array_equal(wide, held)
    assert MPI.COMM_WORLD.allreduce(int(held.sum())) >= 5
    assert not np.any(sides(cell, flat, 0, degree)[0])
    assert not np.any(sides(cell, (1.0,) * gdim, 0, degree)[0])


def test_what_holds_motions_softly_is_not_added():
    x = np.stack(np.meshgrid(np.linspace(0.0, 1.0, 5), [0.0, 1e-3], indexing="ij"), -1)
    x = x.reshape(-1, 2)
    modes = candidate_modes(x, 2, x.mean(axis=0), 0.5)
    bottom, end = np.zeros((2, *x.shape))
    bottom[x[:, 1] == 0.0, 1] = 1.0  # holds a translation and the rotation
    end[x[:, 0] == 0.0] = 1.0  # the rotation by a lever of 1e-3 alone
    soft = bottom * np.where(x[:, :1] == 0.0, 1.0, 1e-6)
    diagonal = np.ones(x.size)
    assert holds_firmly(modes, bottom.ravel(), diagonal)
    assert holds_firmly(modes, np.zeros(x.size), diagonal)
    assert not holds_firmly(modes, soft.ravel(), diagonal)
    assert not holds_firmly(modes, 1e-3 * bottom.ravel(), diagonal)
    along = bottom[:, ::-1].ravel()
    assert holds_firmly(modes, along, diagonal)
    turned = x + 1e-6 * x[:, :1] * (0.0, 1.0)
    assert not holds_firmly(candidate_modes(turned, 2, x.mean(axis=0), 0.5), along, diagonal)
    assert not holds_firmly(modes, end.ravel() * np.tile([1.0, 0.0], len(x)), diagonal)


@pytest.mark.parametrize("curvature", [2.5e-7, 1e-6, 2.5e-6])
def test_what_a_slight_curve_holds_is_not_added(curvature, comm):
    """A strip held along a side that is not quite straight, which alone keeps it from turning.

    K with that rotation held by 1e-13 of its entries is neither singular nor of full rank.
    """
    strip = Body((0.0, 0.0), (1.0, THICK), (3, 1))
    held = Held((0, 1, 0), (0,)), Held((0, 0, 0), (1,)), Held((0, 0, 1), (1,))
    load, bent = Load((0, 1, 1), (0.0, -1e-10)), ("arch", 1.0 / curvature)
    scene = Scene("quadrilateral", (strip,), held, (load,), (), (), subdomains=2, bent=bent)
    row = run_scene(replace(scene, options={"tfeti_rtol": 1e-7}), comm)
    if comm.rank == 0:
        assert row["class"] == "right", row
        assert row["u"] <= 1e-6
        assert not any("springs" in warning for warning in row["warnings"])


def test_cells_that_are_not_flat_are_left_alone():
    """A side that is held, of cells as wide as thick: the same K, bit by bit."""
    diagonals = []
    for stiffening in (0.0, 10.0):
        strip = Strip(stiffening, thick=1.0 / 16)
        strip.solve()
        assert strip.errors().max() <= 1e-7
        diagonals.append(strip.problem.dual.subdomains.diagonal)
    assert np.array_equal(*diagonals)


def test_elastic_forces_know_nothing_of_what_is_added():
    """Those of a motion are 0, also of one that is held; of a stretch they are K u."""
    scene = Strip(1e3)
    scene.solve()
    plain = Strip(0.0)
    plain.solve()
    blocks = (s.problem.dual.subdomains.blocks for s in (scene, plain))
    for stiffened, other in zip(*blocks, strict=True):
        u = np.random.default_rng(0).standard_normal(len(other.load))
        size = np.abs(other.multiply(u)).max()
        assert np.abs(stiffened.elastic(u) - other.elastic(u)).max() <= 1e-9 * size
        assert np.abs(stiffened.modes.T @ stiffened.elastic(u)).max() <= 1e-12 * size * len(u)
