"""Ranks that are given different things, or make different calls: a named error on all, no hang.

On one rank the same calls are right. A case that hangs ends all ranks.
"""

import re
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import ufl
from dolfinx import fem
from moving import Thrown
from mpi4py import MPI
from scenes import box, clamp, decomposed, forms, hooke, solved

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.common.agreement import agreeing, as_json
from tfeti_dolfinx.extensions import Extensions
from tfeti_dolfinx.io.output import write_xdmf
from tfeti_dolfinx.io.plot import plot_pressure

pytestmark = pytest.mark.timeout(100)

COMM = MPI.COMM_WORLD
# on one rank nobody is odd
ODD = 0 < COMM.rank == COMM.size - 1
UP = tfeti.Plane((0, -0.01), (0, 1))
floor = partial(tfeti.Obstacle, "bottom", UP)


class Scene:
    """A square, clamped on the left, above a floor; parts of the decomposition are made once."""

    def __init__(self):
        self.d = decomposed("quadrilateral", 3, 4)
        self.V, self.a, _ = forms(self.d.mesh, self.d.facet_tags, (0, 0), self.d.surface("top"))
        self.v = self.a.arguments()[0]

    def load(self, down=-0.05):
        ds = ufl.Measure("ds", domain=self.d.mesh, subdomain_data=self.d.facet_tags)
        self.traction = fem.Constant(self.d.mesh, (0.0, down))
        return ufl.dot(self.traction, self.v) * ds(self.d.surface("top"))

    def held(self, value=0.0, side="left"):
        return clamp(self.V, self.d.facets(side), value)

    def problem(self, L=None, bcs=None, contacts=(), **others):
        bcs = [self.held()] if bcs is None else bcs
        return tfeti.ContactProblem(self.a, L or self.load(), bcs, list(contacts), self.d, **others)

    def solved(self, **given):
        return solved(self.problem(**given))


def contacts(usual, odd):
    """Solve with other contacts on one rank."""
    return lambda s, folder: s.solved(contacts=odd if ODD else usual)


def decomposed_on_one(s, folder):
    mesh, tags, names = box("quadrilateral", 4)
    surfaces = {"left": of_side} if ODD else names
    tfeti.decompose(mesh, 2, facet_tags=tags, surfaces=surfaces)


def raising(u):
    if ODD:
        raise ZeroDivisionError("no such place")
    return hooke()(u)


def update_on_one(s, folder):
    problem = s.solved(contacts=[floor()])
    if ODD:
        problem.update(gap={0: 0.02})
    problem.solve()


def another_constant(s, folder):
    problem = s.solved(contacts=[floor()])
    s.traction.value[1] = -0.06 if ODD else -0.07
    problem.solve()


def other_times_on_one(s, folder):
    problem = s.problem(contacts=[floor()])

    def apply(problem, t):
        s.traction.value[1] = -0.05 * t

    times = [0.5, 1.0, 1.5] if ODD else [0.5, 1.0]
    tfeti.LoadSteps(problem, apply, times, checkpoint=folder / "c").run()


def broken(s, folder):
    """Restore a state of which an array is cut on one rank."""
    problem = s.solved(contacts=[floor()])
    problem.accept()
    state, other = problem.state(), s.problem(contacts=[floor()])
    other.restore(replace(state, u=state.u[:-1]) if ODD else state)


def apply_that_fails_before_an_update(s, folder):
    def apply(problem, t):
        if ODD:
            raise ZeroDivisionError("no such place")
        problem.update(gap={0: 0.02})

    tfeti.LoadSteps(s.problem(contacts=[floor()]), apply, [1.0]).run()


def accepted_on_one(s, folder):
    problem = s.solved(contacts=[floor(friction=tfeti.Coulomb(0.3))])
    if not ODD:
        problem.accept()
    problem.solve()


def thrown(**given):
    """Two steps of a body with mass, something of which one rank has in another way."""

    def do(s, folder):
        odd = {name: value[1] if ODD else value[0] for name, value in given.items()}
        step = odd.pop("step", 0.1)
        Thrown(n=2, subdomains=2, **odd).step(step, 2)

    return do


def pictured(s, folder):
    """Draw the pressure of another contact on one rank."""
    solution = s.solved(contacts=[floor(), floor()]).solution
    plot_pressure(folder / "a.png", solution, lambda x: x[0], contact=int(ODD))


def of_depth(x, depth):
    return depth + 0 * x[0]


def of_solution(usual, odd=None):
    """Ask a solution for something, one rank for something else."""

    def do(s, folder):
        problem = s.solved(stress=hooke(), contacts=[floor(), floor(name="again")])
        (odd if ODD and odd else usual)(problem.solution)

    return do


def a_field_on_one(s, folder):
    problem = s.solved()
    (s.d.to_original if ODD else s.d.locate_facets)(problem.u if ODD else of_side)


def nonlinear(load_on_one=False, **given):
    def do(s, folder):
        u, held, L = fem.Function(s.V), [s.held()], s.load()
        F = ufl.action(s.a, u) - L
        problem = tfeti.NonlinearContactProblem(F, u, held, [floor()], s.d, **given)
        problem.update(load=L if load_on_one and ODD else None)
        problem.solve()

    return do


def free_body_on_one(s, folder):
    body = tfeti.RigidBody(UP, free=("y",) if ODD else ())
    tfeti.ContactDynamics(s.a, s.load(), [], [tfeti.Obstacle("bottom", body)], s.d, mass=1.0)


def of_side(x):
    return x[0] < 0.1


COULOMB = tfeti.Coulomb(0.3)
ON, WHERE = r" on rank \d and ", "where rank 0 has called"
CASES = {
    "friction on one": (
        contacts([floor()], [floor(friction=COULOMB)]),
        rf"contacts\[0\]: friction is a Coulomb{ON}None on rank 0; expected the same on all",
    ),
    "another μ on one": (
        contacts([floor(friction=COULOMB)], [floor(friction=tfeti.Coulomb(0.4))]),
        rf"contacts\[0\]: friction: coefficient is 0.4{ON}0.3 on rank 0",
    ),
    "other bound arguments on one": (
        contacts(
            *([floor(friction=tfeti.Coulomb(partial(of_depth, depth=d)))] for d in (0.1, 0.2))
        ),
        rf"coefficient: depth is 0.2{ON}0.1 on rank 0",
    ),
    "stress on one": (
        lambda s, folder: s.solved(stress=hooke() if ODD else None),
        rf"stress is the callable hooke.*{ON}None on rank 0",
    ),
    "a stress that raises on one": (
        lambda s, folder: s.problem(stress=raising),
        r"stress\(u\): ZeroDivisionError: no such place",
    ),
    "update on one": (update_on_one, rf"rank \d has called update {WHERE} solve"),
    "other times on one": (other_times_on_one, rf"the number of times is 3{ON}2 on rank 0"),
    "a state that is cut on one": (broken, r"the state has \d+ displacements on this rank"),
    "a condition of another value on one": (
        lambda s, folder: s.solved(bcs=[s.held(0.01 if ODD else 0.0)]),
        rf"bcs\[0\]: value\[0\] is 0.01{ON}0.0 on rank 0",
    ),
    "a file of another name on one": (
        lambda s, folder: write_xdmf(folder / f"{'ab'[ODD]}.xdmf", s.solved().solution),
        rf"path is '.*b.xdmf'{ON}'.*a.xdmf' on rank 0",
    ),
    "a picture of another contact on one": (pictured, rf"contact is 1{ON}0 on rank 0"),
    "surfaces on others": (decomposed_on_one, rf"surfaces: left is the callable of_side{ON}1 on"),
    "an extension on one": (
        lambda s, folder: s.problem(extensions=Extensions(monitor=print) if ODD else None),
        rf"extensions: monitor is .*{ON}",
    ),
    "no form on one": (lambda s, folder: s.solved(L=5 if ODD else None), rf"L is 5{ON}a Form"),
    "a constant of another value on one": (another_constant, r"L: constants\[0\]\[1\] is -0.06"),
    "accept on others": (accepted_on_one, rf"rank \d has called solve {WHERE} accept"),
    "an apply that fails before an update": (apply_that_fails_before_an_update, "no such place"),
    "data of another contact on one": (
        of_solution(lambda of: of.contact(0), lambda of: of.contact("again")),
        rf"contact is 1{ON}0 on rank 0",
    ),
    "data of an unknown contact on one": (
        of_solution(lambda of: of.contact(0), lambda of: of.contact(3 if ODD else 0)),
        "contact 3: there is none; expected a position",
    ),
    "the reaction of another surface on one": (
        of_solution(lambda of: of.reaction("left"), lambda of: of.reaction("right")),
        rf"surface is \d{ON}\d on rank 0",
    ),
    "other points on one": (
        of_solution(lambda of: of.at([[0.5, 0.5]]), lambda of: of.at([[0.5, 0.5], [0.6, 0.5]])),
        rf"the number of points is 2{ON}1 on rank 0",
    ),
    "a form of another mesh on one": (
        lambda s, folder: s.problem().update(stiffness=(s.a, Scene().a)[ODD]),
        "the space is on another mesh",
    ),
    "a field on one": (a_field_on_one, rf"rank \d has called to_original {WHERE} locate_facets"),
    "tolerances of Newton's method on one": (
        nonlinear(tolerances=tfeti.NewtonTolerances(max_it=9 if ODD else 8)),
        rf"tolerances: max_it is 9{ON}8 on rank 0",
    ),
    "a load of a nonlinear problem on one": (nonlinear(load_on_one=True), "load and stiffness are"),
    "a free rigid body on one": (free_body_on_one, rf"shape: free is 1{ON}0 on rank 0"),
    "an update that raises on one": (nonlinear(update=lambda: 1 / (not ODD)), "update: ZeroDiv"),
    "a law of another value on one": (
        contacts(*[[floor(displacement=lambda t: (0.0, 0.02 if ODD else 0.01))]] * 2),
        rf"motion and load\[0\]\[1\] is 0.02{ON}0.01 on rank 0",
    ),
    "stabilised on one": (thrown(stabilised=(False, True)), rf"stabilised is True{ON}False"),
    "a step of another size on one": (thrown(step=(0.1, 0.2)), rf"step is 0.2{ON}0.1 on rank 0"),
    "no step on one": (thrown(step=(0.1, np.nan)), "step=nan"),
}


@pytest.fixture(scope="module")
def scene():
    return Scene()


@pytest.mark.parametrize("case", CASES)
def test_it_is_named_on_all_ranks(case, scene, shared_tmp, comm):
    do, says = CASES[case]
    error = None
    try:
        do(scene, shared_tmp)
    except Exception as caught:
        error = caught
    if comm.size == 1:
        assert error is None
        return
    answers = comm.allgather((type(error).__name__, str(error)))
    assert all(re.search(says, text) for _, text in answers), answers
    kinds = {"InputError", "ZeroDivisionError"} if "apply" in case else {"InputError"}
    assert {kind for kind, _ in answers} <= kinds


def test_a_call_that_differs_changes_nothing(scene, comm):
    """Nothing was accepted, so ``go_back`` would leave no solution on its rank."""
    problem = scene.solved(contacts=[floor()])
    try:
        (problem.go_back if ODD else problem.accept)()
    except tfeti.InputError:
        assert comm.size > 1
    assert comm.allreduce(np.abs(problem.solution.u).max(initial=0.0), op=MPI.MAX) > 0.0


def test_rounding_is_no_difference(comm):
    """Processors of different kinds may round a function of the time in different ways."""
    one = 0.1 * (1.0 + 1e-15 * comm.rank)
    with agreeing(comm, "here") as given:
        given |= {"number": one, "vector": [one, 1e-17 * comm.rank], "name": "same"}


def test_counters_of_ufl_are_no_difference(scene, comm):
    """A rank may have made more constants, for a plot of its own: UFL sorts them as texts."""
    if ODD:  # the next ones have 9..9 and 10..0
        count = fem.Constant(scene.d.mesh, 0.0).count()
        for _ in range(10 ** len(str(count)) - 2 - count):
            fem.Constant(scene.d.mesh, 0.0)
    E, nu, rho = (fem.Constant(scene.d.mesh, value) for value in (1.0, 0.3, 2.0))
    i, j = ufl.indices(2)
    sigma = hooke(E * nu + rho)(scene.a.arguments()[1])
    a = rho * E * nu * sigma[i, j] * ufl.grad(scene.v)[i, j] * ufl.dx(domain=scene.d.mesh)
    a += nu * ufl.inner(rho * sigma, E * sigma + nu * sigma) * ufl.dx(domain=scene.d.mesh)
    told = comm.allgather(as_json(a))
    assert told[0]["structure"]
    assert all(other == told[0] for other in told)
