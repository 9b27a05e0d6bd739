"""Steps of the dynamic demos, begun with what was learnt before and with nothing."""

from types import SimpleNamespace

import numpy as np
import pytest
from mpi4py import MPI

import tfeti_dolfinx as tfeti
from demos import bouncing_bar, falling_balls_3d

COMM = MPI.COMM_WORLD


def bar(**options):
    """Up to the end of the first impact, in steps of h/c."""
    problem = bouncing_bar.scene(COMM, 16, stabilised=True, petsc_options=options)
    return problem, bouncing_bar.L / bouncing_bar.C / 16, 64


def ball(**options):
    """Fifteen steps in the impact of a rough ball, cτ/H = 0.8."""
    balls, modulus = falling_balls_3d, 2e4
    model = balls.build(np.array([0.05]), balls.R, 0.12, 0.3) if COMM.rank == 0 else None
    decomposition = tfeti.read_gmsh(model, COMM, 6)
    arguments = SimpleNamespace(gap=0.05, modulus=modulus, smooth=False)
    problem = balls.scene(decomposition, arguments, 1, petsc_options=options)
    return problem, balls.hertz(modulus)[1] / 15, 18


def multiplications(scene, cold=False, **options):
    """Mean over the steps with contact."""
    problem, size, steps = scene(**options)
    problem.take_step(size)
    counts = []
    for _ in range(steps):
        if cold:
            problem._start = None
        problem.solve()
        problem.accept()
        if any(np.linalg.norm(force) > 0.0 for force in problem.report.contact_forces):
            counts.append(problem.report.F_multiplications)
    problem.destroy()
    assert len(counts) >= 10
    return np.mean(counts)


@pytest.mark.parametrize(
    ("scene", "most", "most_cold"),
    [(bar, 1.0, 3.0), (ball, 8.5, 14.0)],
)
def test_a_step_takes_two_thirds_of_one_that_begins_with_nothing(scene, most, most_cold):
    """0 of 2 multiplications, with friction 8 of 13."""
    warm, cold = multiplications(scene), multiplications(scene, cold=True, recycle=0)
    assert warm <= 2 / 3 * cold
    assert warm <= most
    assert cold <= most_cold
