"""Steps of the dynamic demos, begun with what was learnt before and with nothing."""

from types import SimpleNamespace

import numpy as np
import pytest
from mpi4py import MPI

import tfeti_dolfinx as tfeti
from demos import bouncing_bar, falling_balls_3d, impact_of_bars

COMM = MPI.COMM_WORLD


def bar(**options):
    """Up to the end of the first impact, in steps of h/c."""
    problem = bouncing_bar.scene(COMM, 16, stabilised=True, petsc_options=options)
    return problem, bouncing_bar.L / bouncing_bar.C / 16, 64


def wall(**options):
    given = {f"tfeti_{name}": value for name, value in options.items()}
    bars = impact_of_bars.Bars(impact_of_bars.IMPACTS["wall"], 20, True, given)
    return bars.problem, bars.size, 40


def ball(**options):
    """Fifteen steps in the impact, cτ/H = 0.8."""
    balls, modulus = falling_balls_3d, 2e4
    model = balls.build(np.array([0.05]), balls.R, 0.12, 0.3) if COMM.rank == 0 else None
    decomposition = tfeti.read_gmsh(model, COMM, 6)
    arguments = SimpleNamespace(gap=0.05, modulus=modulus, smooth=True)
    problem = balls.scene(decomposition, arguments, 1, petsc_options=options)
    return problem, balls.hertz(modulus)[1] / 15, 18


def multiplications(scene, cold=False, **options):
    """Median over the steps with contact."""
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
    return np.median(counts)


@pytest.mark.parametrize("scene", [bar, wall, ball])
def test_a_step_takes_two_thirds_of_one_that_begins_with_nothing(scene):
    """0 of 2 multiplications, 1 of 3, and 7.5 of 14."""
    assert multiplications(scene) <= 2 / 3 * multiplications(scene, cold=True, recycle=0)
