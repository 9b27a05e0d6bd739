"""Global reductions of a step of conjugate gradients, counted."""

from dataclasses import replace

import numpy as np
import pytest
from petsc4py import PETSc
from scenes import curved_obstacle, decomposed, problem
from test_solvable_lp import dual_of

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.common.parallel import summed
from tfeti_dolfinx.qp.homogenised import homogenise
from tfeti_dolfinx.qp.krylov import pcpg
from tfeti_dolfinx.qp.problem import ConvergedReason, Point, ResidualRule, Steps
from tfeti_dolfinx.qp.sets import Status, face_of

# what PETSc logs of vectors; each is a reduction on more ranks than one
EVENTS = ("VecDot", "VecTDot", "VecMDot", "VecMTDot", "VecNorm", "VecDotNorm2")
COLLECTIVE = ("allreduce", "Allreduce", "reduce", "Reduce", "bcast", "Bcast", "allgather", "gather")


class Counted:
    """A communicator that counts its global calls."""

    def __init__(self, comm):
        self._comm, self.calls = comm, 0

    def __getattr__(self, name):
        self.calls += name in COLLECTIVE
        return getattr(self._comm, name)


@pytest.fixture(scope="module")
def dual():
    d = decomposed("hexahedron", 4, subdomains=6)
    obstacle = tfeti.Obstacle("bottom", curved_obstacle(3))
    p = problem(d, contacts=[obstacle], tfeti_pc_type="dirichlet", tfeti_qp_type="newton")
    made = dual_of(p)
    made.coarse.comm = Counted(made.coarse.comm)
    PETSc.Log.begin()
    yield made
    made.coarse.comm = made.coarse.comm._comm
    p.destroy()


def face_with_half_of_the_contacts(dual):
    free = np.ones(dual.constraints.num_rows, dtype=bool)
    free[dual.constraints.sets.normals[::2]] = False
    return face_of(free, np.where(free, Status.TOUCHING, Status.OPEN))


def logged_calls():
    return sum(PETSc.Log.Event(name).getPerfInfo()["count"] for name in EVENTS)


@pytest.fixture
def sums(monkeypatch):
    """Calls of the one function that adds arrays up over ranks."""
    calls = []

    def counted(comm, values):
        calls.append(len(values))
        return summed(getattr(comm, "_comm", comm), values)

    for module in ("tfeti_dolfinx.qp.krylov", "tfeti_dolfinx.qp.coarse"):
        monkeypatch.setattr(f"{module}.summed", counted)
    return calls


def count(dual, qp, sums, num_steps):
    """Global calls of so many steps, with what comes before and after them."""
    start = homogenise(qp)
    point, steps = Point(start.lam_bar.copy(), start.gradient.copy()), Steps()
    before = len(sums) + dual.coarse.comm.calls + logged_calls()
    reason = pcpg(qp, point, ResidualRule(0.0), steps, num_steps)
    after = len(sums) + dual.coarse.comm.calls + logged_calls()
    assert reason == ConvergedReason.DIVERGED_ITS
    assert steps.cg == num_steps
    point.destroy()
    start.destroy()
    return after - before


@pytest.mark.parametrize(("on_face", "preconditioned"), [(False, False), (True, True)])
def test_a_step_of_pcpg_makes_three_reductions(dual, sums, on_face, preconditioned):
    qp = dual.qp()
    face = face_with_half_of_the_contacts(dual)
    preconditioner = qp.preconditioner_on(face) if on_face else qp.preconditioner
    if on_face:
        qp = replace(qp, coarse=qp.coarse.on_face(face))
    qp = replace(qp, preconditioner=preconditioner if preconditioned else None)
    assert count(dual, qp, sums, 7) - count(dual, qp, sums, 2) == 5 * 3
