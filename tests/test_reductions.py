"""Global reductions of a step of conjugate gradients, and pickled messages, counted."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from bodies import held, pressed, sided, stacked, two_body_problem
from mpi4py import MPI
from scenes import curved_obstacle, decomposed, problem, solved
from test_solvability import dual_of

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.extensions import Extensions
from tfeti_dolfinx.qp.krylov import pcpg
from tfeti_dolfinx.qp.problem import ConvergedReason, Steps, StoppingRule, homogenise
from tfeti_dolfinx.qp.sets import Face, Status
from tfeti_dolfinx.solve.coulomb import solve_with_friction

COLLECTIVE = ("allreduce", "Allreduce", "reduce", "Reduce", "bcast", "Bcast", "allgather", "gather")


class Counted:
    """A communicator that counts its global calls."""

    def __init__(self, comm):
        self._comm, self.calls = comm, 0

    def __getattr__(self, name):
        self.calls += name in COLLECTIVE
        return getattr(self._comm, name)


@pytest.fixture(scope="module", params=[0.0, 1e-3], ids=["floating", "springs"])
def dual(request):
    d = decomposed("hexahedron", 4, subdomains=6)
    obstacle = tfeti.Obstacle("bottom", curved_obstacle(3))
    options = {"tfeti_pc_type": "dirichlet", "tfeti_qp_type": "newton"}
    p = problem(d, contacts=[obstacle], springs=request.param, **options)
    made = dual_of(p)
    made.coarse.comm = Counted(made.coarse.comm)
    yield made
    made.coarse.comm = made.coarse.comm._comm
    p.destroy()


def count(qp, num_steps):
    """Global calls of so many steps, with what comes before and after them."""
    start, steps = homogenise(qp).at, Steps()
    before = qp.coarse.comm.calls
    _, reason = pcpg(qp, start, StoppingRule(0.0), steps, num_steps)
    assert reason == ConvergedReason.DIVERGED_ITS
    assert steps.cg == num_steps
    return qp.coarse.comm.calls - before


@pytest.mark.parametrize(("on_face", "preconditioned"), [(False, False), (True, True)])
def test_a_step_of_pcpg_makes_three_reductions(dual, on_face, preconditioned):
    qp = dual.qp()
    free = np.ones(dual.constraints.num_rows, dtype=bool)
    free[dual.constraints.sets.normals[::2]] = False
    face = Face(free, np.where(free, Status.TOUCHING, Status.OPEN))
    preconditioner = qp.preconditioner_on(face) if on_face else qp.preconditioner
    if on_face:
        qp = replace(qp, coarse=qp.coarse.on_face(face))
    qp = replace(qp, preconditioner=preconditioner if preconditioned else None)
    assert count(qp, 7) - count(qp, 2) == 5 * 3


@pytest.fixture
def pickled(monkeypatch):
    """What is sent pickled while a solver runs, as lower-case calls of mpi4py do."""
    found, runs = [], [False]

    def dumps(item, *protocol):
        if runs[0]:
            found.append(item)
        return pickle.dumps(item, *protocol)

    def watched(*arguments, **keywords):
        runs[0] = True
        try:
            return solve_with_friction(*arguments, **keywords)
        finally:
            runs[0] = False

    monkeypatch.setattr("tfeti_dolfinx.problem.solve_with_friction", watched)
    MPI.pickle.__init__(dumps, pickle.loads)
    yield found
    MPI.pickle.__init__(pickle.dumps, pickle.loads)


@pytest.mark.parametrize("friction", [None, tfeti.Tresca(0.01), tfeti.Coulomb(0.3)])
@pytest.mark.parametrize("qp_type", ["newton", "smalse"])
def test_solvers_send_no_pickled_messages(pickled, qp_type, friction):
    """Starts, looks and Newton's method on Coulomb's law are counted, too."""
    d = stacked("quadrilateral", 4, 5)
    pair = sided("upper bottom", "lower top", friction=friction)
    sides = held(d, "lower bottom", "lower left", "upper left", ("upper top", -0.01))
    p = solved(two_body_problem(d, pressed(d), sides, [pair], tfeti_qp_type=qp_type))
    assert p.report.F_multiplications > 5
    assert pickled == []


def test_clusters_send_no_pickled_messages_which_would_be_seen(pickled):
    pressed = tfeti.Obstacle("bottom", curved_obstacle(3))
    p = solved(problem(decomposed("hexahedron", 4, 8), contacts=[pressed], clusters=4))
    assert p.report.F_multiplications > 5
    assert pickled == []
    # those of a monitor that sends a number, in each step
    seen = Extensions(monitor=lambda *_: MPI.COMM_WORLD.allreduce(1))
    solved(problem(decomposed("quadrilateral", 6, 4), extensions=seen))
    assert len(pickled) > 5
