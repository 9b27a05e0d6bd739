"""What conjugate gradients were slow in on one face helps the next: a coarse space for them."""

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc

from tfeti_dolfinx.qp.coarse import DenseCoarse
from tfeti_dolfinx.qp.directions import Directions
from tfeti_dolfinx.qp.faces import Status, face_of
from tfeti_dolfinx.qp.feasible_sets import Product
from tfeti_dolfinx.qp.pcpg import pcpg
from tfeti_dolfinx.qp.problem import QP, Point, Steps
from tfeti_dolfinx.qp.slow_directions import HIGH, WRONG, SlowDirections
from tfeti_dolfinx.qp.stopping import TargetRule

n = 60
HIGHEST = [30.0, 40.0, 60.0]


class Diagonal:
    """An approximate inverse of F on a face."""

    def __init__(self, values, face):
        self._values, self._face = values, face

    def mult(self, x, y):
        y.array[:] = self._face.restricted(self._values * x.array_r)

    def dependent(self, x):
        return None

    def destroy(self):
        pass


def all_free(but=(), status=Status.FREE):
    free = np.ones(n, dtype=bool)
    free[list(but)] = False
    return face_of(free, np.full(n, status))


def program(highest=HIGHEST):
    """A program, F, M and its eigenvectors: MF has eigenvalues in [1, 3] and a few large ones."""
    rng = np.random.default_rng(1)
    M = rng.uniform(0.5, 2.0, n)
    V = np.linalg.qr(rng.standard_normal((n, n)))[0]
    values = np.append(np.linspace(1.0, 3.0, n - len(highest)), highest)
    F = (V * values) @ V.T / np.sqrt(np.outer(M, M))
    F = 0.5 * (F + F.T)
    mat = PETSc.Mat().createDense((n, n), array=F, comm=PETSc.COMM_SELF)
    d = PETSc.Vec().createWithArray(rng.standard_normal(n), comm=PETSc.COMM_SELF)
    qp = QP(mat, d, DenseCoarse(np.zeros((0, n)), np.zeros(0)), Product())
    return qp, F, M


def solved(qp, M, slow, face):
    """Steps of a solve on a face to 1e-8, of which something is learnt."""
    on = QP(
        qp.F,
        qp.d,
        DenseCoarse(np.eye(n)[np.flatnonzero(face.held)], np.zeros(int(face.held.sum()))),
        qp.feasible,
        preconditioner=slow.beside(Diagonal(M, face), face),
    )
    point, steps, own = Point(qp.d.duplicate(), qp.d.duplicate()), Steps(), Directions(qp.d)
    point.lam.set(0.0)
    point.refresh(qp)
    pcpg(on, point, TargetRule(1e-8), steps, 1000, directions=own)
    return steps.cg, slow.learn(own.kept, face)


def matrix(operator, rows=n):
    x, columns = PETSc.Vec().createSeq(n, comm=PETSc.COMM_SELF), []
    for i in range(rows):
        x.set(0.0)
        x.setValue(i, 1.0)
        y = x.duplicate()
        operator.mult(x, y)
        columns.append(y.array_r.copy())
    return np.array(columns).T


def test_large_eigenvalues_are_found_and_taken_away():
    qp, F, M = program()
    slow = SlowDirections(MPI.COMM_SELF)
    first, found = solved(qp, M, slow, all_free())
    assert found == slow.count == len(HIGHEST)
    operator = matrix(slow.beside(Diagonal(M, all_free()), all_free()))
    assert np.abs(operator - operator.T).max() <= 1e-10
    before = np.sort(np.linalg.eigvals(np.diag(M) @ F).real)
    after = np.sort(np.linalg.eigvals(operator @ F).real)
    assert before[-3:] == pytest.approx(HIGHEST)
    assert after[-1] <= 3.0 * (1.0 + 1e-6)
    assert after[: len(HIGHEST) + 1] == pytest.approx(1.0, abs=1e-6)
    again, nothing = solved(qp, M, slow, all_free())
    assert again <= first - len(HIGHEST)
    assert nothing == 0


def test_they_help_on_another_face_and_stay_positive_definite():
    qp, _, M = program()
    slow, fresh, other = (
        SlowDirections(MPI.COMM_SELF),
        SlowDirections(MPI.COMM_SELF),
        all_free(but=range(3)),
    )
    solved(qp, M, slow, all_free())
    operator = matrix(slow.beside(Diagonal(M, other), other))[3:, 3:]
    assert np.abs(operator - operator.T).max() <= 1e-10
    assert np.linalg.eigvalsh(operator)[0] > 0.0
    assert solved(qp, M, slow, other)[0] < solved(qp, M, fresh, other)[0]


@pytest.mark.parametrize("seed", range(20))
def test_whatever_is_held_then_what_they_make_is_positive_definite(seed):
    qp, _, M = program([20.0] * 3 + [250.0] * 2)
    slow = SlowDirections(MPI.COMM_SELF)
    solved(qp, M, slow, all_free())
    held = np.random.default_rng(seed).choice(n, 40, replace=False)
    face, free = all_free(but=held), np.setdiff1d(np.arange(n), held)
    operator = matrix(slow.beside(Diagonal(M, face), face))
    assert np.all(operator[held] == 0.0)
    values = np.linalg.eigvalsh(operator[np.ix_(free, free)])
    assert values[0] > 0.0


def test_where_nothing_is_slow_nothing_is_kept():
    qp, _, M = program([])
    slow = SlowDirections(MPI.COMM_SELF)
    assert solved(qp, M, slow, all_free())[1] == 0
    inner = Diagonal(M, all_free())
    assert slow.beside(inner, all_free()) is inner


def test_values_below_the_threshold_are_not_slow():
    qp, _, M = program([0.99 * HIGH])
    assert solved(qp, M, SlowDirections(MPI.COMM_SELF), all_free())[1] == 0


def test_where_the_preconditioner_is_bad_altogether_nothing_is_kept():
    qp, _, M = program([30.0, 1.1 * WRONG])
    assert solved(qp, M, SlowDirections(MPI.COMM_SELF), all_free())[1] == 0


def test_what_was_kept_goes_where_the_preconditioner_turns_out_to_be_bad_altogether():
    (qp, _, M), (worse, _, _) = program(), program([1.1 * WRONG, *HIGHEST])
    slow = SlowDirections(MPI.COMM_SELF)
    assert solved(qp, M, slow, all_free())[1] == slow.count == len(HIGHEST)
    assert solved(worse, M, slow, all_free())[1] == slow.count == 0
    inner = Diagonal(M, all_free())
    assert slow.beside(inner, all_free()) is inner
    assert solved(qp, M, slow, all_free())[1] == 0


@pytest.mark.parametrize("status", [Status.STICK, Status.SLIP])
def test_nothing_is_kept_where_points_stick_or_slip(status):
    qp, _, M = program()
    assert solved(qp, M, SlowDirections(MPI.COMM_SELF), all_free(status=status))[1] == 0
