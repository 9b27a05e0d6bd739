"""Steps of the dynamic demos, begun with what was learnt before and with nothing."""

import numpy as np
import pytest

import tfeti_dolfinx as tfeti
from demos import scene

# of the first impact of the balls: 2.94 δ/V, δ = (15mV²/16E*√R)^(2/5)
SPEED, MODULUS = np.sqrt(2 * 10.0 * 0.3), 2e4 / (1 - 0.3**2)
HERTZ_LASTS = 2.94 * (15 * 4 / 3 * np.pi * SPEED**2 / (16 * MODULUS)) ** 0.4 / SPEED


def bar(**options):
    """Up to the end of the first impact, in steps of h/c."""
    made = scene("bouncing_bar", ["--cells", 16], "ContactDynamics")
    problem = tfeti.ContactDynamics(**{**made, "petsc_options": options})
    return problem, 10.0 / 30.0 / 16, 64


def ball(**options):
    """Fifteen steps in the impact of a rough ball, cτ/H = 0.8."""
    made = scene("falling_balls_3d", ["--balls", 1, "--gap", 0.05], "ContactDynamics")
    problem = tfeti.ContactDynamics(**{**made, "petsc_options": options})
    return problem, HERTZ_LASTS / 15, 18


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


@pytest.mark.parametrize(("scene", "most", "most_cold"), [(bar, 1.0, 3.0), (ball, 8.5, 14.0)])
def test_a_step_takes_two_thirds_of_one_that_begins_with_nothing(scene, most, most_cold):
    """0 of 2 multiplications, with friction 8 of 14."""
    warm, cold = multiplications(scene), multiplications(scene, cold=True, recycle=0)
    assert warm <= 2 / 3 * cold
    assert warm <= most
    assert cold <= most_cold
