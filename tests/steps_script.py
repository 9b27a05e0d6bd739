"""Run a series of load steps, and die on the way if told to: see test_load_steps."""

import itertools
import os
import signal
import sys
from functools import partial
from pathlib import Path

import numpy as np
import test_rigid_tools
import ufl
from bodies import held, stacked
from dolfinx import fem
from moving import Thrown
from mpi4py import MPI
from scenes import displacement, elastic, vectors
from sheared import Driven
from test_nonlinear import plastic

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.steps import checkpoint
from tfeti_dolfinx.steps.load_steps import fields_of

TIMES = [0.5, 1.0, 1.75, 2.5, 3.25]
LAST = MPI.COMM_WORLD.size - 1


def die_at(name, count, before):
    """End the process when a file gets this name for the count-th time, before or after it has.

    What it would rename is cut where it is before.
    """
    rename, times = os.replace, itertools.count(1)

    def replace(source, target):
        now = Path(target).name == name and next(times) == count
        if now and before:
            os.truncate(source, os.path.getsize(source) // 2)
            os.kill(os.getpid(), signal.SIGKILL)
        rename(source, target)
        if now:
            os.kill(os.getpid(), signal.SIGKILL)

    os.replace = replace


# file, and whether the process dies before it has its name
DEATHS = {
    "writing": (f"state_3_{LAST}.npz", 1, True),
    "committing": (checkpoint.INDEX, 5, True),  # it is written twice before the first step
    "committed": (checkpoint.INDEX, 5, False),
}


class Pressed:
    """A block of J2 material whose upper side goes to and fro."""

    def __init__(self):
        self.problem, _, self.value = plastic(MPI.COMM_WORLD, petsc_options={"rtol": 1e-11})

    def apply(self, problem, t):
        self.value.value[-1] = -0.06 * np.sin(0.6 * t)


class Tool:
    """A ball with a force down that is moved along a rough side."""

    def __init__(self):
        ball = test_rigid_tools.ball(2)
        way = lambda t: (0.01 * t, 0.0)  # noqa: E731
        tool = tfeti.RigidBody(ball, displacement=way, force=(0, -0.01), free=("y",), name="ball")
        contact = tfeti.Obstacle("top", tool, friction=tfeti.Coulomb(0.3))
        given = {"contacts": [contact], "petsc_options": {"rtol": 1e-12}}
        self.problem = tfeti.ContactProblem(**test_rigid_tools.block(2), **given)

    def apply(self, problem, t):
        pass


class Apart:
    """A box on springs below one that is held and meets a rough plane: one rank has no rows."""

    def __init__(self):
        d = stacked("quadrilateral", 3, 4, 2, gap=0.5)
        V, u, v = vectors(d)
        self.load = fem.Constant(d.mesh, (0.0, 0.0))
        a = elastic(u, v) + ufl.dot(u, v) * ufl.dx
        L = ufl.dot(self.load, v) * ufl.dx
        plane = tfeti.Plane((0.0, 0.49), (0.0, 1.0))
        contact = tfeti.Obstacle("upper bottom", plane, friction=tfeti.Coulomb(0.3))
        given = a, L, held(d, "upper top")(V), [contact], d
        self.problem = tfeti.ContactProblem(*given, petsc_options={"rtol": 1e-10})

    def apply(self, problem, t):
        self.load.value[:] = (0.02 * np.sin(t), -0.1)


SCENES = {
    "smooth": partial(Driven, rough=False),
    "rough": Driven,
    "coulomb": partial(Driven, friction=tfeti.Coulomb(0.3), rtol=1e-12),
    "thrown": partial(Thrown, weight=0.02, stabilised=False),
    "stabilised": partial(Thrown, weight=0.02, stabilised=True),
    "plastic": Pressed,
    "tool": Tool,
    "apart": Apart,
}


def solve(folder, how):
    """Run the series of the scene that a folder is named after, and write what it finds."""
    driven = SCENES[folder.name]()

    def apply(problem, t):
        if t == TIMES[3] and how == "between":
            os.kill(os.getpid(), signal.SIGKILL)
        driven.apply(problem, t)

    folder.mkdir(parents=True, exist_ok=True)
    times = TIMES[:3] if how == "begun" else TIMES
    steps = tfeti.LoadSteps(
        driven.problem, apply, times, path=folder / "series.bp", checkpoint=folder / "checkpoint"
    )
    records = steps.run(resume=how == "resume")
    x, u = displacement(driven.problem)
    fields = {
        f"{MPI.COMM_WORLD.rank} {name}": values
        for name, values in fields_of(driven.problem.solution).items()
    }
    everywhere = {k: v for part in MPI.COMM_WORLD.allgather(fields) for k, v in part.items()}
    if MPI.COMM_WORLD.rank == 0:
        figures = np.array([[r.time, r.size, r.dissipation, *r.tools.values()] for r in records])
        F = np.array([r.figures["F_multiplications"] for r in records])
        late = np.array([r.figures["late_contact_rows"] for r in records])
        np.savez(folder / "found.npz", x=x, u=u, figures=figures, F=F, late=late, **everywhere)


if __name__ == "__main__":
    how = ""
    for word in sys.argv[1:]:  # how the folders after it are run, or a folder
        if not Path(word).is_absolute():
            how = word
            continue
        if how in DEATHS:
            die_at(*DEATHS[how])
        solve(Path(word), how)
