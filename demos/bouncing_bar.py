# # A bouncing bar
#
# An elastic bar falls on a rigid floor (Doyen, Ern, Piperno, SIAM J. Sci. Comput. 33, 2011). It is
# in contact while a wave runs up the bar and back, leaves the floor, and falls again. After its
# second impact it is where it was at the begin: the motion is periodic, in closed form.
#
#     ./run mpirun -n 2 python3 demos/bouncing_bar.py --plot

"""A bar that falls on a floor, in closed form: times of impacts, pressure, period, energy.

Forces of the step are compared with the closed form by their sums over time up to each step, since
a closed form that jumps inside of a step has no value there.
"""

import sys
from itertools import pairwise
from pathlib import Path

import petsc4py

if __name__ == "__main__":
    petsc4py.init(sys.argv)  # before DOLFINx, which would initialise PETSc without options

import numpy as np
import ufl
from dolfinx import fem
from dolfinx import mesh as dmesh
from mpi4py import MPI

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import tfeti_dolfinx as tfeti
from demos.demo_tools import Demo
from demos.partial_slip import draw

# length, modulus, density, gravity, height, with which waves have the speed 30
L, E, RHO, G, H0 = 10.0, 900.0, 1.0, 10.0, 5.0
C = np.sqrt(E / RHO)
FALL, TOUCH = np.sqrt(2 * H0 / G), 2 * L / C
V0 = G * FALL
FIRST, SECOND = FALL, 11 / 3
PERIOD = 16 / 3


def pressure(t):
    """Pressure of the floor: it grows in the first impact, and falls in the second."""
    first = np.where((t >= FIRST) & (t < FIRST + TOUCH), RHO * C * (V0 + G * (t - FIRST)), 0.0)
    left = SECOND + TOUCH - t
    return first + np.where((left > 0) & (left <= TOUCH), RHO * C * (V0 + G * left), 0.0)


def scene(comm, cells, **keywords):
    """A strip of square cells in four subdomains, and the floor under it."""
    bar = dmesh.create_rectangle(
        comm, [(0, 0), (L / cells, L)], [1, cells], dmesh.CellType.quadrilateral
    )
    facets = dmesh.locate_entities_boundary(bar, 1, lambda x: np.isclose(x[1], 0))
    tags = dmesh.meshtags(bar, 1, facets, np.full_like(facets, 1))
    decomposition = tfeti.decompose(
        bar, lambda x: np.floor(4 * x[1] / L), facet_tags=tags, surfaces={"bottom": 1}
    )
    elastic = tfeti.Elasticity(decomposition, E=E, nu=0.0, model="plane_strain")
    V = fem.functionspace(decomposition.mesh, ("Lagrange", 1, (2,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    weight = fem.Constant(decomposition.mesh, (0.0, -RHO * G))
    floor = tfeti.Plane((0, -H0), normal=(0, 1))
    return tfeti.ContactDynamics(
        elastic.a(u, v),
        ufl.dot(weight, v) * ufl.dx(domain=decomposition.mesh),
        [],
        [tfeti.Obstacle("bottom", floor, reach=2 * H0, name="floor")],
        decomposition,
        mass=RHO,
        stress=elastic.stress,
        **keywords,
    )


def run(argv):
    demo = Demo(__doc__, argv, configure)
    arguments, comm = demo.arguments, MPI.COMM_WORLD
    cells = arguments.cells or (16 if arguments.quick else 100)
    size = arguments.step or L / C / cells * arguments.courant
    end = FIRST + 1.5 * TOUCH if arguments.quick else PERIOD
    options = {"tfeti_rtol": 1e-8, **demo.petsc_options}

    # ## Motion
    #
    # With a picture plain steps are shown beside stabilised ones, of which the errors are.
    found = {}
    for stabilised in (False, True) if arguments.plot else (not arguments.plain,):
        problem = scene(comm, cells, stabilised=stabilised, petsc_options=options)
        times = size * np.arange(1, round(end / size) + 1)
        steps = tfeti.LoadSteps(problem, lambda problem, t: None, times)
        found["stabilised" if stabilised else "plain"] = steps.run()
    records = found["plain" if arguments.plain else "stabilised"]
    t = np.array([r.time for r in records])
    forces = pressures(records, cells)
    problem.report.errors.update(errors(t, size, forces))
    F = [r.figures["F_multiplications"] for r in records]
    motion = [r.motion for r in records]
    lost = -sum(m["contact"] + m["predictor"] for m in motion) / max(m["energy"] for m in motion)
    if comm.rank == 0:
        print(f"{len(t)} steps of {size:.4g}, multiplications {sum(F)}, at most {max(F)} in a step")
        print(f"energy lost in impacts: {lost:.2e} of its largest")
    if arguments.plot and comm.rank == 0:
        curves = {name: (t - size / 2, pressures(of, cells)) for name, of in found.items()}
        fine = np.linspace(0.0, end, 4001)
        curves["closed form"] = (fine, pressure(fine))
        totals = {name: (t, [r.motion["energy"] for r in of]) for name, of in found.items()}
        labels = [("time", "pressure of the floor"), ("time", "kinetic and elastic energy")]
        draw(demo.folder / "bouncing_bar.png", [(labels[0], {}, curves), (labels[1], {}, totals)])
    return demo.finish(problem, "bouncing_bar")


def pressures(records, cells):
    """Mean pressure of the floor in each step."""
    return np.array([r.contact_forces[0][1] for r in records]) * cells / L


def errors(t, size, forces):
    """Impact times, pressures, period against the closed form, relative."""
    begins = {"first": FIRST, "second": SECOND}
    impulses, errors = np.cumsum(forces) * size, {}
    for name, begin in begins.items():
        near = (t > begin - TOUCH) & (t < begin + 2 * TOUCH)
        touching = t[near & (forces > 0.05 * RHO * C * V0)]
        if len(touching) and t[-1] > begin + TOUCH:
            errors[f"{name}_begin"] = (touching[0] - size) / begin - 1
            errors[f"{name}_end"] = touching[-1] / (begin + TOUCH) - 1
            errors[f"{name}_pressure"] = max(windows(t, size, forces, begin), key=abs)
    if t[-1] > SECOND + TOUCH:
        errors["period"] = impulses[-1] / (RHO * G * L) / PERIOD - 1
    return {k: float(v) for k, v in errors.items()}


def windows(t, size, forces, begin):
    """Errors of mean pressures in the middle four fifths of an impact, eight parts."""
    edges = begin + TOUCH * np.linspace(0.1, 0.9, 9)
    for low, high in pairwise(edges):
        inside = (t - size / 2 > low) & (t - size / 2 <= high)
        yield np.mean(forces[inside]) / np.mean(pressure(t[inside] - size / 2)) - 1


def main(argv):
    """Run the demo and return its solution."""
    return run(argv)[0]


def configure(parser):
    parser.add_argument("--cells", type=int, help="cells along the bar")
    parser.add_argument("--step", type=float, help="step in time")
    parser.add_argument("--courant", type=float, default=1.0, help="step times c over cells")
    parser.add_argument("--plain", action="store_true", help="steps that are not stabilised")


if __name__ == "__main__":
    main(sys.argv[1:])
