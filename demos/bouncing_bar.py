# # A bouncing bar
#
# An elastic bar falls on a rigid floor (Doyen, Ern, Piperno, SIAM J. Sci. Comput. 33, 2011). It is
# in contact while a wave runs up the bar and back, leaves the floor, and falls again. After its
# second impact it is where it was at the start: the motion is periodic, in closed form.
#
#     ./run mpirun -n 2 python3 demos/bouncing_bar.py --plot

# +
import argparse
import sys
from itertools import pairwise
from pathlib import Path

import petsc4py

parser = argparse.ArgumentParser(description="A bar that falls on a floor, in closed form.")
parser.add_argument("--quick", action="store_true", help="a size of a few seconds")
parser.add_argument("--cells", type=int, help="cells along the bar")
parser.add_argument("--step", type=float, help="step in time")
parser.add_argument("--courant", type=float, default=1.0, help="step times c over cells")
parser.add_argument("--plain", action="store_true", help="steps that are not stabilised")
parser.add_argument("--plot", action="store_true", help="draw pictures in results/, or in DIR")
parser.add_argument("--output", type=Path, metavar="DIR", help="folder for fields")
parser.add_argument("--report", type=Path, metavar="FILE", help="write the report as JSON")
arguments, rest = parser.parse_known_args()
petsc4py.init([sys.argv[0], *rest])  # before DOLFINx: so PETSc's options reach the solver

import numpy as np
import ufl
from dolfinx import fem
from dolfinx import mesh as dmesh
from mpi4py import MPI

import tfeti_dolfinx as tfeti

# -

# ## Data and closed form
#
# Waves have the speed c = 30. The pressure of the floor grows in the first impact, and falls in the
# second.

# +
comm = MPI.COMM_WORLD
L, E, rho, g, height = 10.0, 900.0, 1.0, 10.0, 5.0
c, fall = np.sqrt(E / rho), np.sqrt(2 * height / g)
touch, speed, period = 2 * L / c, g * fall, 16 / 3
begins = {"first": fall, "second": 11 / 3}


def pressure(t):
    first = (t >= begins["first"]) & (t < begins["first"] + touch)
    left = begins["second"] + touch - t
    second = (left > 0) & (left <= touch)
    grown = np.where(first, speed + g * (t - begins["first"]), 0.0)
    return rho * c * (grown + np.where(second, speed + g * left, 0.0))


cells = arguments.cells or (16 if arguments.quick else 100)
size = arguments.step or L / c / cells * arguments.courant
end = begins["first"] + 1.5 * touch if arguments.quick else period
times = size * np.arange(1, round(end / size) + 1)
# -

# ## Mesh and forms
#
# A strip of square cells in four subdomains.

bar = dmesh.create_rectangle(
    comm, [(0, 0), (L / cells, L)], [1, cells], dmesh.CellType.quadrilateral
)
decomposition = tfeti.decompose(
    bar, lambda x: np.floor(4 * x[1] / L), surfaces={"bottom": lambda x: np.isclose(x[1], 0)}
)
elastic = tfeti.Elasticity(decomposition, E=E, nu=0.0, model="plane_strain")
V = fem.functionspace(decomposition.mesh, ("Lagrange", 1, (2,)))
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
weight = fem.Constant(decomposition.mesh, (0.0, -rho * g))
floor = tfeti.Plane((0, -height), normal=(0, 1))

# ## Motion
#
# With a picture plain steps are shown next to stabilised ones, of which the errors are.

# +
found = {}
for stabilised in (False, True) if arguments.plot else (not arguments.plain,):
    problem = tfeti.ContactDynamics(
        elastic.a(u, v),
        ufl.dot(weight, v) * ufl.dx(domain=decomposition.mesh),
        [],
        [tfeti.Obstacle("bottom", floor, reach=2 * height, name="floor")],
        decomposition,
        mass=rho,
        stress=elastic.stress,
        stabilised=stabilised,
        petsc_options={"tfeti_rtol": 1e-8},
    )
    steps = tfeti.LoadSteps(problem, lambda problem, t: None, times)
    found["stabilised" if stabilised else "plain"] = steps.run()
records = found["plain" if arguments.plain else "stabilised"]
pressures = {
    name: np.array([record.contact_forces[0][1] for record in of]) * cells / L
    for name, of in found.items()
}
# -

# ## Comparison with the closed form
#
# Mean pressures in the middle four fifths of an impact, in eight parts, and its begin and end,
# since a closed form that jumps inside of a step has no value there.

# +
t, p, errors = times, pressures["plain" if arguments.plain else "stabilised"], {}
for name, begin in begins.items():
    near = (t > begin - touch) & (t < begin + 2 * touch)
    touching = t[near & (p > 0.05 * rho * c * speed)]
    if len(touching) and t[-1] > begin + touch:
        errors[f"{name}_begin"] = (touching[0] - size) / begin - 1
        errors[f"{name}_end"] = touching[-1] / (begin + touch) - 1
        middles, means = t - size / 2, []
        for low, high in pairwise(begin + touch * np.linspace(0.1, 0.9, 9)):
            inside = (middles > low) & (middles <= high)
            means.append(np.mean(p[inside]) / np.mean(pressure(middles[inside])) - 1)
        errors[f"{name}_pressure"] = max(means, key=abs)
if t[-1] > begins["second"] + touch:
    errors["period"] = np.sum(p) * size / (rho * g * L) / period - 1
problem.report.errors.update({name: float(value) for name, value in errors.items()})
if comm.rank == 0:
    F = [record.figures["F_multiplications"] for record in records]
    motion = [record.motion for record in records]
    lost = -sum(m["contact"] + m["predictor"] for m in motion) / max(m["energy"] for m in motion)
    print(f"{len(t)} steps of {size:.4g}, {sum(F)} iterations, at most {max(F)} in a step")
    print(f"energy lost in impacts: {lost:.2e} of its largest")
# -

# ## Output

# +
if arguments.output:
    tfeti.write_vtx(arguments.output / "bouncing_bar.bp", problem.solution)
if arguments.plot:
    folder = arguments.output or Path("results")
    if comm.rank == 0:
        from matplotlib.figure import Figure

        folder.mkdir(parents=True, exist_ok=True)
        figure = Figure(figsize=(8, 4), dpi=130, layout="constrained")
        fine = np.linspace(0.0, end, 4001)
        left, right = figure.subplots(1, 2)
        for name, of in found.items():
            left.plot(t - size / 2, pressures[name], linewidth=1, label=name)
            right.plot(t, [record.motion["energy"] for record in of], linewidth=1, label=name)
        left.plot(fine, pressure(fine), "k--", linewidth=1, label="closed form")
        left.set(xlabel="time", ylabel="pressure of the floor")
        right.set(xlabel="time", ylabel="kinetic and elastic energy")
        figure.legend(*left.get_legend_handles_labels(), loc="outside upper center", ncols=3)
        figure.savefig(folder / "bouncing_bar.png")
if arguments.report:
    problem.report.write(arguments.report, comm)
if comm.rank == 0:
    print(problem.report)
# -
