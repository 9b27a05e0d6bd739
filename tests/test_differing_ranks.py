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
from scenes import clamp, decomposed, forms, hooke

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.common.agreement import agreeing, described
from tfeti_dolfinx.output import write_vtx, write_xdmf
from tfeti_dolfinx.plot import plot_deformed, plot_pressure

pytestmark = pytest.mark.timeout(100)

COMM = MPI.COMM_WORLD
# on one rank nobody is odd
ODD = 0 < COMM.rank == COMM.size - 1
UP = tfeti.Plane((0, -0.01), (0, 1))


def floor(**given):
    return tfeti.Obstacle("bottom", UP, **given)


class Scene:
    """A square, clamped on the left, above a floor; parts of the decomposition are made once."""

    def __init__(self):
        self.d = decomposed("quadrilateral", 3, 2)
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
        problem = self.problem(**given)
        problem.solve()
        return problem


def contacts(usual, odd):
    """Solve with other contacts on one rank."""
    return lambda s, folder: s.solved(contacts=odd if ODD else usual)


def raising(u):
    if ODD:
        raise ZeroDivisionError("no such place")
    return hooke()(u)


def update_on_one(s, folder):
    problem = s.solved(contacts=[floor()])
    if ODD:
        problem.update(gap={0: 0.02})
    problem.solve()


def updates(**made):
    """Update with something that is made with whether this rank is the odd one."""

    def do(s, folder):
        problem = s.solved(contacts=[floor()])
        problem.update(**{name: make(s) for name, make in made.items()})
        problem.solve()

    return do


def stress_that_fails_later(s, folder):
    fails = []

    def stress(u):
        return raising(u) if fails else hooke()(u)

    problem = s.solved(stress=stress)
    fails.append(True)
    problem.solve()


def another_constant(s, folder):
    problem = s.solved(contacts=[floor()])
    s.traction.value[1] = -0.06 if ODD else -0.07
    problem.solve()


def another_value(s, folder):
    value = fem.Constant(s.d.mesh, (0.0, 0.0))
    dofs = fem.locate_dofs_topological(s.V, 1, s.d.facets("left"))
    problem = s.solved(bcs=[fem.dirichletbc(value, dofs, s.V)])
    value.value[0] = 0.01 if ODD else 0.02
    problem.solve()


def steps(s, folder, **given):
    problem = s.problem(contacts=[floor()])

    def apply(problem, t):
        s.traction.value[1] = -0.05 * t

    times = given.pop("times", [0.5, 1.0])
    return tfeti.LoadSteps(problem, apply, times, checkpoint=folder / "c", **given)


def resumed_on_one(s, folder):
    steps(s, folder).run()
    steps(s, folder).run(resume=not ODD)


def run_on_one(s, folder):
    series = steps(s, folder)
    if not ODD:
        series.run()
    else:
        series._problem.solve()


def broken(**names):
    """Restore a state of which an array is broken on one rank."""

    def do(s, folder):
        problem = s.solved(contacts=[floor()])
        problem.accept()
        state, other = problem.state(), s.problem(contacts=[floor()])
        if ODD:
            state = replace(state, **{n: damage(getattr(state, n)) for n, damage in names.items()})
        other.restore(state)

    return do


def state_on_one(s, folder):
    problem = s.solved(contacts=[floor()])
    problem.accept()
    state = problem.state()
    s.problem(contacts=[floor()]).restore(None if ODD else state)


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


def other(usual, odd):
    return lambda s: odd(s) if ODD else usual(s)


def constantly(depth):
    return lambda x: depth + 0 * x[0]


def of_depth(x, depth):
    return depth + 0 * x[0]


class Floor:
    """An obstacle of one's own."""

    def __init__(self, low):
        self.low = low

    def distance(self, x):
        return x[1] + self.low

    def gradient(self, x):
        return np.stack((0 * x[0], 1 + 0 * x[0], 0 * x[0]))


def constant_beside_a_large_one(s, folder):
    E, nu = fem.Constant(s.d.mesh, 1e11), fem.Constant(s.d.mesh, 0.4 if ODD else 0.3)
    tfeti.ContactProblem(E * nu * s.a, s.load(), [s.held()], [], s.d)


def written(write, usual, odd, **given):
    """Write what was solved to another name on one rank."""

    def do(s, folder):
        write(folder / (odd if ODD else usual), s.solved(stress=hooke()).solution, **given)

    return do


def call_on_one(usual, odd):
    """Make another call on one rank."""

    def do(s, folder):
        problem = s.solved(contacts=[floor()])
        (odd if ODD else usual)(problem, folder)
        problem.solve()

    return do


TRESCA, COULOMB = tfeti.Tresca(0.01), tfeti.Coulomb(0.3)
ON = r" on rank \d and "
HUNG = {
    "friction on one": (
        contacts([floor()], [floor(friction=COULOMB)]),
        rf"contacts\[0\]: friction is a Coulomb{ON}None on rank 0; expected the same on all",
    ),
    "stress on one": (
        lambda s, folder: s.solved(stress=hooke() if ODD else None),
        rf"stress is the callable hooke.*{ON}None on rank 0",
    ),
    "contacts on one": (contacts([], [floor()]), rf"the number of contacts is 1{ON}0 on rank 0"),
    "update on one": (update_on_one, r"rank \d has called update where rank 0 has called solve"),
    "a stress that raises on one": (
        lambda s, folder: s.problem(stress=raising),
        r"stress\(u\): ZeroDivisionError: no such place",
    ),
    "other times on one": (
        lambda s, folder: steps(s, folder, times=[0.5, 1.0, 1.5] if ODD else [0.5, 1.0]).run(),
        rf"the number of times is 3{ON}2 on rank 0",
    ),
    "another time on one": (
        lambda s, folder: steps(s, folder, times=[0.5, 1.5] if ODD else [0.5, 1.0]).run(),
        rf"times\[1\] is 1.5{ON}1.0 on rank 0",
    ),
    "resume on one": (resumed_on_one, rf"resume is False{ON}True on rank 0"),
    "a state that is cut on one": (broken(u=lambda u: u[:-1]), "the state is broken: u has"),
    "a state that is NaN on one": (broken(u=lambda u: np.nan * u), "the state is broken: u has"),
    "no state on one": (state_on_one, "state is None; expected what ContactProblem.state"),
}
SILENT = {
    "another load on one": (
        lambda s, folder: s.solved(L=s.load(-0.06 if ODD else -0.05)),
        rf"L: constants\[0\]\[1\] is -0.06{ON}-0.05 on rank 0",
    ),
    "another gap on one": (
        contacts([floor(gap=0.01)], [floor(gap=0.02)]),
        rf"contacts\[0\]: gap is 0.02{ON}0.01 on rank 0",
    ),
    "another μ on one": (
        contacts([floor(friction=COULOMB)], [floor(friction=tfeti.Coulomb(0.4))]),
        rf"contacts\[0\]: friction: coefficient is 0.4{ON}0.3 on rank 0",
    ),
    "another law on one": (
        contacts([floor(friction=COULOMB)], [floor(friction=TRESCA)]),
        rf"contacts\[0\]: friction: type is 'Tresca'{ON}'Coulomb' on rank 0",
    ),
    "a condition of another value on one": (
        lambda s, folder: s.solved(bcs=[s.held(0.01 if ODD else 0.0)]),
        rf"bcs\[0\]: value\[0\] is 0.01{ON}0.0 on rank 0",
    ),
    "a condition more on one": (
        lambda s, folder: s.solved(bcs=[s.held(), s.held(side="right")][: 2 if ODD else 1]),
        rf"the number of bcs is 2{ON}1 on rank 0",
    ),
}
MORE = {
    "another form on one": (
        lambda s, folder: s.solved(L=s.load() + s.load() if ODD else s.load()),
        rf"L: structure is '\w+'{ON}'\w+' on rank 0",
    ),
    "no form on one": (lambda s, folder: s.solved(L=5 if ODD else None), rf"L is 5{ON}a Form"),
    "another obstacle on one": (
        contacts([floor()], [tfeti.Obstacle("bottom", tfeti.Plane((0, -0.02), (0, 1)))]),
        rf"contacts\[0\]: shape: point\[1\] is -0.02{ON}-0.01 on rank 0",
    ),
    "contacts that are none on one": (
        contacts([floor()], ["floor"]),
        "expected obstacles and pairs, got 'floor'",
    ),
    "an option that is none on one": (
        lambda s, folder: s.problem(petsc_options={"tfeti_rtoll": 1e-8} if ODD else None),
        "unknown option -tfeti_rtoll",
    ),
    "another modulus on one": (
        lambda s, folder: tfeti.Elasticity(
            s.d, E=2.0 if ODD else 1.0, nu=0.3, model="plane_strain"
        ),
        rf"E is 2.0{ON}1.0 on rank 0",
    ),
    "a model that is none on one": (
        lambda s, folder: tfeti.Elasticity(
            s.d, E=1.0, nu=0.3, model="flat" if ODD else "plane_strain"
        ),
        "model='flat': expected in 2D one of",
    ),
    "another thickness on one": (
        lambda s, folder: s.problem(thickness=2.0 if ODD else 1.0),
        rf"thickness is 2.0{ON}1.0 on rank 0",
    ),
    "another stress on one": (
        lambda s, folder: s.problem(stress=hooke(2.0 if ODD else 1.0)),
        rf"stress: lmbda is .*{ON}",
    ),
    "a stress that raises on one, later": (
        stress_that_fails_later,
        r"stress\(u\): ZeroDivisionError: no such place",
    ),
    "a constant of another value on one": (another_constant, r"L: constants\[0\]\[1\] is -0.06"),
    "a prescribed value of another size on one": (another_value, r"bcs\[0\]: value\[0\] is 0.01"),
    "another gap in update on one": (
        updates(gap=other(lambda s: {0: 0.01}, lambda s: {0: 0.02})),
        rf"gap: 0 is 0.02{ON}0.01 on rank 0",
    ),
    "another load in update on one": (
        updates(load=other(lambda s: s.load(), lambda s: s.load(-0.1))),
        rf"load: constants\[0\]\[1\] is -0.1{ON}-0.05 on rank 0",
    ),
    "a load in update on one": (
        updates(load=other(lambda s: s.load(), lambda s: None)),
        rf"load is None{ON}a Form on rank 0",
    ),
    "a solve on one where others run": (
        run_on_one,
        r"rank \d has called solve where rank 0 has called LoadSteps.run",
    ),
    "accept on others": (
        accepted_on_one,
        r"rank \d has called solve where rank 0 has called accept",
    ),
    "an apply that fails before an update": (apply_that_fails_before_an_update, "no such place"),
    "a checkpoint on one": (
        lambda s, folder: tfeti.LoadSteps(
            s.problem(), print, [1.0], checkpoint=folder if ODD else None
        ),
        rf"checkpoint is '.*'{ON}None on rank 0",
    ),
    "a state with another reach on one": (
        broken(reach=lambda reach: 2.0 * reach),
        rf"state: reach\[0\] is .*{ON}",
    ),
    "a state without an image on one": (broken(image=lambda x: x[:0]), "is broken: image has"),
    "a mass of another size on one": (thrown(mass=(1.0, 2.0)), rf"mass is 2.0{ON}1.0 on rank 0"),
    "stabilised on one": (thrown(stabilised=(False, True)), rf"stabilised is True{ON}False"),
    "stabilised by something on one": (thrown(stabilised=(False, 5)), "stabilised=5: expected T"),
    "a step of another size on one": (thrown(step=(0.1, 0.2)), rf"step is 0.2{ON}0.1 on rank 0"),
}
HUNG_LATER = {
    "a file of another kind on one": (
        written(write_vtx, "a.bp", "a.vtu"),
        "a.vtu: expected a name that ends with .bp",
    ),
    "a file of another name on one": (
        written(write_xdmf, "a.xdmf", "b.xdmf"),
        rf"path is '.*b.xdmf'{ON}'.*a.xdmf' on rank 0",
    ),
    "fields inside on one": (
        written(write_vtx, "a.bp", "a.bp", interior=ODD),
        rf"interior is True{ON}False on rank 0",
    ),
    "a picture of another kind on one": (
        written(plot_deformed, "a.png", "a.pdf"),
        "a.pdf: expected a name that ends with .png",
    ),
    "a picture of another contact on one": (
        lambda s, folder: plot_pressure(
            folder / "a.png",
            s.solved(contacts=[floor(), floor()]).solution,
            lambda x: x[:, 0],
            contact=int(ODD),
        ),
        rf"contact is 1{ON}0 on rank 0",
    ),
    "a file on others": (
        call_on_one(lambda p, folder: write_vtx(folder / "a.bp", p.solution), lambda p, folder: 0),
        r"rank \d has called solve where rank 0 has called write_vtx",
    ),
    "destroy on one": (
        call_on_one(lambda p, folder: 0, lambda p, folder: p.destroy()),
        r"rank \d has called destroy where rank 0 has called solve",
    ),
}
SILENT_LATER = {
    "another closure on one": (
        contacts([floor(gap=constantly(0.01))], [floor(gap=constantly(0.02))]),
        rf"contacts\[0\]: gap: depth is 0.02{ON}0.01 on rank 0",
    ),
    "other bound arguments on one": (
        contacts(
            *([floor(friction=tfeti.Coulomb(partial(of_depth, depth=d)))] for d in (0.1, 0.2))
        ),
        rf"coefficient: depth is 0.2{ON}0.1 on rank 0",
    ),
    "another obstacle of one's own on one": (
        contacts(*([tfeti.Obstacle("bottom", Floor(low))] for low in (0.01, 0.02))),
        rf"contacts\[0\]: shape: low is 0.02{ON}0.01 on rank 0",
    ),
    "a constant beside a large one on one": (
        constant_beside_a_large_one,
        rf"a: constants\[1\] is 0.4{ON}0.3 on rank 0",
    ),
}
CASES = {**HUNG_LATER, **SILENT_LATER, **HUNG, **SILENT, **MORE}


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


class Counted:
    """A communicator that counts its calls."""

    def __init__(self, comm):
        self._comm, self.calls = comm, []

    def __getattr__(self, name):
        if name[0].isupper() or name in ("allreduce", "bcast", "allgather"):
            self.calls.append(name)
        return getattr(self._comm, name)


def test_agreement_is_one_message_and_none_on_one_rank(comm):
    counted = Counted(comm)
    with agreeing(counted, "here") as given:
        given["some numbers"] = [1.0, 2.0]
    assert counted.calls == (["Allgather"] if comm.size > 1 else [])


def test_rounding_is_no_difference(comm):
    """Processors of different kinds may round a function of the time in different ways."""
    one = 0.1 * (1.0 + 1e-15 * comm.rank)
    with agreeing(comm, "here") as given:
        given |= {"number": one, "vector": [one, 1e-17 * comm.rank], "name": "same"}


def test_rounding_in_a_form_or_a_function_is_no_difference(scene):
    share = 0.3 if ODD else 0.1 + 0.2
    contact = floor(gap=constantly(0.1 * share))
    tfeti.ContactProblem(share * scene.a, scene.load(), [scene.held()], [contact], scene.d).solve()


def test_a_table_of_a_rank_in_a_function_is_no_difference(scene, comm):
    """Nor are counters, nor what a closure gets later."""
    x, calls = np.linspace(0, 1, 3 + comm.rank), comm.rank

    def gap(points):
        nonlocal calls
        calls += 1
        return np.interp(points[0], x, np.full(len(x), depth))

    friction = tfeti.Coulomb(partial(np.interp, xp=x, fp=0 * x + 0.3))
    with pytest.raises(tfeti.InputError):  # np.interp takes no points of shape (3, n)
        scene.problem(contacts=[floor(friction=friction)]).solve()
    problem = scene.problem(contacts=[floor(gap=gap)])
    depth = 0.01
    problem.solve()


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
    told = comm.allgather(described(a))
    assert told[0]["structure"]
    assert all(other == told[0] for other in told)
