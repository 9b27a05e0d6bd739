"""Steps of the dynamic demos, begun with what was learnt before and with nothing."""

import resource
from types import SimpleNamespace

import numpy as np
import pytest
from moving import Thrown
from mpi4py import MPI
from test_dynamics import sixteenths

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


def ball(smooth=True, **options):
    """Fifteen steps in the impact, cτ/H = 0.8."""
    balls, modulus = falling_balls_3d, 2e4
    model = balls.build(np.array([0.05]), balls.R, 0.12, 0.3) if COMM.rank == 0 else None
    decomposition = tfeti.read_gmsh(model, COMM, 6)
    arguments = SimpleNamespace(gap=0.05, modulus=modulus, smooth=smooth)
    problem = balls.scene(decomposition, arguments, 1, petsc_options=options)
    return problem, balls.hertz(modulus)[1] / 15, 18


def rough_ball(**options):
    return ball(smooth=False, **options)


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


@pytest.mark.parametrize(
    ("scene", "most", "most_cold"),
    [(bar, 1.0, 3.0), (wall, 1.5, 3.0), (ball, 6.0, 10.5), (rough_ball, 8.5, 14.0)],
)
def test_a_step_takes_two_thirds_of_one_that_begins_with_nothing(scene, most, most_cold):
    """0 of 2 multiplications, 1 of 2, 5 of 9.5, with friction 7 of 12.5."""
    warm, cold = multiplications(scene), multiplications(scene, cold=True, recycle=0)
    assert warm <= 2 / 3 * cold
    assert warm <= most
    assert cold <= most_cold


def test_what_f_makes_of_a_step_s_forces_stays_known():
    """It is that of a look at the end: what Newton's method leaves out does not grow."""
    problem, size, _ = rough_ball()
    problem.take_step(size)
    dual, wrong = None, []
    for _ in range(8):
        problem.solve()
        problem.accept()
        dual, (_, lam, _) = problem.dual, problem._start
        x, Fx = dual.d.duplicate(), dual.d.duplicate()
        x.array[:] = lam
        dual.F.mult(x, Fx)
        known = dual.last.known(COMM, lam)
        assert COMM.allreduce(len(known)) == Fx.getSize()
        Fx.array[:] -= known
        wrong.append(Fx.norm() / dual.d.norm())
        x.destroy()
        Fx.destroy()
    assert problem.report.friction_newton_steps > 0
    assert max(wrong) <= 1e-12
    problem.destroy()


@pytest.mark.slow
def test_a_thousand_steps():
    """A square of 256 rows bounces: factored once, no memory after the first tenth."""
    kept, cold = (
        Thrown("quadrilateral", 16, subdomains=sixteenths, stabilised=True, rtol=1e-6, **given)
        for given in ({}, {"recycle": 0})
    )
    size, counts, without, sizes = 0.025 / np.sqrt(0.7 / 1.3 / 0.4), [], [], []
    for n in range(1000):
        kept.weight.value[-1] = cold.weight.value[-1] = -0.05
        ((motion, _),) = kept.step(size)
        report = kept.problem.report
        counts.append(report.F_multiplications)
        assert (report.factorizations > 0) == (n == 0)
        assert abs(motion["defect"]) <= 1e-10 * motion["energy"]
        if n in (99, 999):
            sizes.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
        if n % 5 == 0:
            cold.problem._start = None
            cold.step(size)
            without.append(cold.problem.report.F_multiplications)
    assert np.median(counts) <= 2 / 3 * np.median(without)
    assert sizes[1] <= 1.02 * sizes[0]
