# # Impacts of bars
#
# Bars hit each other along their axis, where waves have the speed c and Z = ρc is the impedance:
#
# * `two`: two free equal bars with the relative speed V press each other with ZVA/2 for 2L/c, and
#   have swapped their velocities then.
# * `clamped`: a free bar hits an equal one that is clamped at its far end: ZVA/2 for 4L/c. It
#   comes back with −V, and leaves the other at rest.
# * `wall`: SDNV100 of Code_Aster: a bar that cannot widen hits a rigid wall, 4.641 GPa for 2L/c.
#
# Forces of steps that are not stabilised oscillate: with `--plot` both are drawn.
#
#     ./run mpirun -n 2 python3 demos/impact_of_bars.py --plot

# +
import argparse
import sys
from pathlib import Path

import petsc4py

parser = argparse.ArgumentParser(description="Impacts of elastic bars in closed form.")
parser.add_argument("--quick", action="store_true", help="a size of a few seconds")
parser.add_argument("--cells", type=int, help="cells along a bar")
parser.add_argument(
    "--impact", action="append", choices=("two", "clamped", "wall"), help="only this one"
)
parser.add_argument("--plain", action="store_true", help="steps that are not stabilised")
parser.add_argument(
    "--poisson", type=float, default=0.3, help="Poisson's ratio of the bar on the wall"
)
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

# ## Mesh
#
# Hexahedra, one of them across a bar. The upper bar is a gap above the lower one, or above the
# wall. A box has two more cells, which are taken out between the bars.

# +
comm = MPI.COMM_WORLD
cells = arguments.cells or (20 if arguments.quick else 100)


def bars(length, side, gap, below):
    """The torn mesh, each bar two subdomains."""
    total = 2 * cells + 2 if below else cells
    box = dmesh.create_box(
        comm, [(0, 0, 0), (side, side, total)], [1, 1, total], dmesh.CellType.hexahedron
    )
    z = box.geometry.x
    if below:
        kept = dmesh.locate_entities(box, 3, lambda x: (x[2] < cells + 0.5) | (x[2] > cells + 1.5))
        box = dmesh.create_submesh(box, 3, kept)[0]
        z = box.geometry.x
        z[:, 2] = np.interp(
            z[:, 2], (0, cells, cells + 2, total), (-length, 0.0, gap, gap + length)
        )
    else:
        z[:, 2] = gap + z[:, 2] * length / cells
    surfaces = {"upper bottom": lambda x: np.isclose(x[2], gap)}
    if below:
        surfaces["lower top"] = lambda x: np.isclose(x[2], 0.0)
        surfaces["lower bottom"] = lambda x: np.isclose(x[2], -length)

    def subdomain(x):
        upper = x[2] > 0.5 * gap
        return 2 * upper * below + (x[2] > np.where(upper, gap + length / 2, -length / 2))

    return tfeti.decompose(box, subdomain, surfaces=surfaces)


# -

# ## Motion
#
# In a step a wave runs through a cell.


# +
def impact(name, stabilised):
    """Run an impact: the problem, times and pressures over the closed form, errors."""
    wall = name == "wall"
    length, side, E, nu, rho, speed, gap = (
        (0.2, 0.02, 2e11, arguments.poisson, 8000.0, 100.0, 2e-3)
        if wall
        else (10.0, 1.0, 900.0, 0.0, 1.0, 10.0, 1.0)
    )
    c = np.sqrt(E * (1 - nu) / (1 + nu) / (1 - 2 * nu) / rho)
    begins, lasts = gap / speed, (4 if name == "clamped" else 2) * length / c
    closed = rho * c * speed * (1.0 if wall else 0.5)
    rebound = 0.0 if name == "two" else speed
    decomposition = bars(length, side, gap, not wall)
    mesh = decomposition.mesh
    elastic = tfeti.Elasticity(decomposition, E=E, nu=nu)
    V = fem.functionspace(mesh, ("Lagrange", 1, (3,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    down = fem.Function(V)
    down.interpolate(lambda x: np.outer([0, 0, -speed], x[2] > 0.5 * gap))
    bcs = []
    if name == "clamped":
        far = fem.locate_dofs_topological(V, 2, decomposition.facets("lower bottom"))
        bcs.append(fem.dirichletbc(np.zeros(3), far, V))
    if nu:  # it cannot widen
        mesh.topology.create_connectivity(3, 3)
        everywhere = np.arange(mesh.topology.index_map(3).size_local, dtype=np.int32)
        for k in (0, 1):
            dofs = fem.locate_dofs_topological(V.sub(k), 3, everywhere)
            bcs.append(fem.dirichletbc(0.0, dofs, V.sub(k)))
    contact = tfeti.Contact("upper bottom", "lower top", reach=2 * gap, name="impact")
    if wall:
        plane = tfeti.Plane((0, 0, 0), normal=(0, 0, 1))
        contact = tfeti.Obstacle("upper bottom", plane, reach=2 * gap, name="impact")
    problem = tfeti.ContactDynamics(
        elastic.a(u, v),
        ufl.ZeroBaseForm((v,)),
        bcs,
        [contact],
        decomposition,
        mass=rho,
        velocity=down,
        stabilised=stabilised,
        stress=elastic.stress,
        petsc_options={"tfeti_rtol": 1e-8},
    )
    size = length / cells / c
    t = size * np.arange(1, round((begins + 1.4 * lasts) / size) + 1)
    records = tfeti.LoadSteps(problem, lambda problem, t: None, t).run()
    p = np.array([abs(record.contact_forces[0][2]) for record in records]) / side**2

    # its velocity afterwards is the mean over the upper bar
    after = fem.Function(V)
    after.x.array[:] = problem.solution.velocity.x.array
    upper = ufl.conditional(ufl.gt(ufl.SpatialCoordinate(mesh)[2], 0.5 * gap), after[2], 0.0)
    momentum = comm.allreduce(fem.assemble_scalar(fem.form(upper * ufl.dx)))
    touching = t[p > 0.5 * closed]
    begin, end = touching[0] - size, touching[-1]
    inside = (t - size > begin + 0.1 * lasts) & (t < end - 0.1 * lasts)
    energy = [record.motion["energy"] for record in records]
    errors = {
        "begin": begin / begins - 1,
        "duration": (end - begin) / lasts - 1,
        "pressure": np.mean(p[inside]) / closed - 1,
        "oscillates": np.std(p[inside]) / closed,
        "velocity": (momentum / length / side**2 - rebound) / speed,
        "energy": energy[-1] / energy[0] - 1,
    }
    if comm.rank == 0:
        print(f"{name}, {'stabilised' if stabilised else 'plain'}, {len(t)} steps,", end=" ")
        print(
            f"{sum(record.figures['F_multiplications'] for record in records)} iterations:", end=" "
        )
        print(", ".join(f"{key} {value:.4g}" for key, value in errors.items()), flush=True)
    return problem, t / begins, p / closed, errors


names = arguments.impact or (["two"] if arguments.quick else ["two", "clamped", "wall"])
panels, errors = {}, {}
for name in names:
    panels[name] = {}
    for stabilised in (False, True) if arguments.plot else (not arguments.plain,):
        problem, t, p, found = impact(name, stabilised)
        panels[name]["stabilised" if stabilised else "plain"] = (t, p)
    errors |= {f"{name}_{key}": float(value) for key, value in found.items()}
problem.report.errors.update(errors)
# -

# ## Output

# +
if arguments.output:
    tfeti.write_vtx(arguments.output / "impact_of_bars.bp", problem.solution)
if arguments.plot:
    folder = arguments.output or Path("results")
    if comm.rank == 0:
        from matplotlib.figure import Figure

        folder.mkdir(parents=True, exist_ok=True)
        titles = {"two": "two free bars", "clamped": "on a clamped bar", "wall": "on a wall"}
        figure = Figure(figsize=(3 * len(names), 3.2), dpi=130, layout="constrained")
        for axes, name in zip(figure.subplots(1, len(names), squeeze=False)[0], names, strict=True):
            for kind, (t, p) in panels[name].items():
                axes.plot(t, p, linewidth=1, label=kind)
            axes.set(title=titles[name], xlabel="time / that of the impact")
        figure.supylabel("pressure / closed form", fontsize="medium")
        handles, labels = axes.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=2)
        figure.savefig(folder / "impact_of_bars.png")
if arguments.report:
    problem.report.write(arguments.report, comm)
if comm.rank == 0:
    print(problem.report)
# -
