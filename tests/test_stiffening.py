"""Stiffness where conditions hold flat parts: the same solution, whatever it is, in fewer steps."""

from dataclasses import replace

import numpy as np
import pytest
import ufl
from bodies import boxes
from dolfinx import fem
from mpi4py import MPI
from scenes import displacement, hooke, strain

import tfeti_dolfinx as tfeti
from benchmarks.stress.meshes import grid
from benchmarks.stress.package import solve_scene
from benchmarks.stress.random_scenes import random_scene

NU, PULL, THICK = 0.3, 1e-3, 1e-3
SUBDOMAINS = 4


class Strip:
    """A strip a thousand times as long as thick, in 2D, that lies on rollers and is pulled along.

    Args:
        stiffening: What the option is.
        wall: Whether a wall without a gap holds the left end in the place of a condition.
        lift: By how much the rollers lift it.
    """

    def __init__(self, stiffening, wall=False, lift=0.0):
        strip = ("strip", (0.0, 0.0), (1.0, THICK), (16, 1))
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
            petsc_options={"stiffening": stiffening, "rtol": 1e-8},
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
    for stiffening in (0.0, 1.0):
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
    # ρ on the left end, which is held at 0 along the strip, and nowhere on the rollers
    more = MPI.COMM_WORLD.allreduce(int(np.sum(diagonals[1] > 2.0 * diagonals[0])))
    assert 0 < more <= 4


def test_a_value_that_becomes_0_and_back():
    strip = Strip(1e3, lift=1e-4)
    for lift, assembled in ((1e-4, 1), (2e-4, 0), (0.0, 1), (0.0, 0), (1e-4, 1)):
        strip.lift.value = lift
        strip.solve()
        assert strip.errors().max() <= 1e-7
        assert strip.problem.report.assemblies == assembled
