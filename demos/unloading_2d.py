# # Hysteresis of a line contact
#
# The bodies of `cattaneo_mindlin_2d.py`, pushed along each other by a force that grows to Q_max,
# turns, grows to −Q_max, and turns again. After each turn the contact sticks at first, and slips
# again from its edges on: it sticks on |x| < c = a√(1 − (Q_max − Q)/(2μP)). Friction remembers the
# way, and force over displacement is a loop, whose area is what friction dissipates.
#
#     ./run mpirun -n 2 python3 demos/unloading_2d.py --plot

# +
import argparse
import sys
from pathlib import Path

import petsc4py

parser = argparse.ArgumentParser(
    description="A line contact pushed to and fro: hysteresis and dissipation in closed form."
)
parser.add_argument("--quick", action="store_true", help="a size of a few seconds")
parser.add_argument("--subdomains", type=int, help="their number")
parser.add_argument("--refine", type=int, default=0, help="how often elements are halved")
parser.add_argument("--steps", type=int, help="load steps from 0 to the largest force")
parser.add_argument("--plot", action="store_true", help="draw pictures in results/, or in DIR")
parser.add_argument("--output", type=Path, metavar="DIR", help="folder for fields")
parser.add_argument("--report", type=Path, metavar="FILE", help="write the report as JSON")
arguments, rest = parser.parse_known_args()
petsc4py.init([sys.argv[0], *rest])  # before DOLFINx: so PETSc's options reach the solver

import gmsh
import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI

import tfeti_dolfinx as tfeti

# -

# ## Mesh
#
# Two rectangles that are mirror images, at first flat on each other: so pressing alone makes no
# friction. A refinement halves the elements.

# +
comm = MPI.COMM_WORLD
R, L, E, nu, mu, a = 1.0, 1.0, 1.0, 0.3, 0.3, 0.04
fine = (0.1 if arguments.quick else 0.05) * a / 2**arguments.refine
growth = (0.3 if arguments.quick else 0.2) / 2**arguments.refine
gmsh.initialize()
gmsh.option.setNumber("General.Terminal", 0)
model, geo = gmsh.model, gmsh.model.geo


def mirror(axis):
    """Add the mirror image of a mesh, a body of its own; its tags by dimension and tag."""
    mesh, images = model.mesh, {}
    node, element = mesh.getMaxNodeTag(), mesh.getMaxElementTag()
    flip = [-1.0 if k == axis else 1.0 for k in range(3)]
    meshed = [(e, mesh.getNodes(*e)[:2], mesh.getElements(*e)) for e in model.getEntities()]
    for (dim, tag), (nodes, x), _ in meshed:
        images[dim, tag] = model.addDiscreteEntity(dim)
        mesh.addNodes(dim, images[dim, tag], nodes + node, (x.reshape(-1, 3) * flip).ravel())
    for entity, _, (kinds, tags, corners) in meshed:
        for kind, of_kind, nodes in zip(kinds, tags, corners, strict=True):
            table = nodes.reshape(len(of_kind), -1) + node
            # the first two change places, so that cells stay right-handed
            order = [1, 0, *range(2, table.shape[1])] if entity[0] > 1 else slice(None)
            mesh.addElementsByType(images[entity], kind, of_kind + element, table[:, order].ravel())
    return images


if comm.rank == 0:
    near, far = ([geo.addPoint(x, y, 0) for x in (-L, 0, L)] for y in (0, L))
    left, axis, right = (geo.addLine(*ends) for ends in zip(near, far, strict=True))
    # from the middle on, so that elements of both halves are of the same sizes
    face, top = ([geo.addLine(side[1], side[k]) for k in (0, 2)] for side in (near, far))
    loops = [[face[k], up, -top[k], -axis] for k, up in enumerate((left, right))]
    halves = [geo.addPlaneSurface([geo.addCurveLoop(loop)]) for loop in loops]
    geo.synchronize()
    beyond = f"(sqrt(x^2+y^2)-{1.3 * a})"
    size = model.mesh.field.add("MathEval")
    model.mesh.field.setString(size, "F", f"{fine}+{growth}*0.5*({beyond}+fabs({beyond}))")
    model.mesh.field.setAsBackgroundMesh(size)
    for name in ("FromPoints", "FromCurvature", "ExtendFromBoundary"):
        gmsh.option.setNumber(f"Mesh.MeshSize{name}", 0)
    model.mesh.generate(2)
    image = mirror(axis=1)
    model.addPhysicalGroup(2, halves, name="upper")
    model.addPhysicalGroup(2, [image[2, tag] for tag in halves], name="lower")
    for upper, lower, curves in (("upper face", "lower face", face), ("top", "bottom", top)):
        model.addPhysicalGroup(1, curves, name=upper)
        model.addPhysicalGroup(1, [image[1, tag] for tag in curves], name=lower)
subdomains = arguments.subdomains or (2 if arguments.quick else 8)
decomposition = tfeti.read_gmsh(model if comm.rank == 0 else None, comm, subdomains)
gmsh.finalize()
mesh = decomposition.mesh
# -

# ## Elasticity in plane strain

elastic = tfeti.Elasticity(decomposition, E=E, nu=nu, model="plane_strain")
V = fem.functionspace(mesh, ("Lagrange", 1, (2,)))
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
ds = ufl.Measure("ds", domain=mesh, subdomain_data=decomposition.facet_tags)

# ## Loads and conditions
#
# P is a uniform pressure on both flat sides. Q is a uniform traction on them, along x above and
# against it below, with a pressure linear in x that takes its moment: each body is in balance.
# What holds the lower one, two points, carries nothing; contact and friction alone hold the upper
# one.

# +
top, bottom = (ds(decomposition.surface(name)) for name in ("top", "bottom"))
area, moment, X = 2 * L, 2 * L**3 / 3, ufl.SpatialCoordinate(mesh)


def loads(P, Q, w):
    side = Q / area * w[0] - P / area * w[1]
    return side * top - side * bottom + Q * L / moment * X[0] * w[1] * (top + bottom)


middle = fem.locate_dofs_geometrical(V, lambda x: np.isclose(x[1], -L) & np.isclose(x[0], 0))
vertical = (V.sub(1), V.sub(1).collapse()[0])
corner, _ = fem.locate_dofs_geometrical(
    vertical, lambda x: np.isclose(x[1], -L) & np.isclose(x[0], L)
)
bcs = [fem.dirichletbc(np.zeros(2), middle, V), fem.dirichletbc(0.0, corner, V.sub(1))]
# -

# ## Contact with friction
#
# The bodies' shape is in the gap, x²/(2R), as in Hertz's theory: the normals of curved meshes
# would differ by x/R, and with them pressing alone would make some friction.

P, Q = fem.Constant(mesh, 0.0), fem.Constant(mesh, 0.0)
contact = tfeti.Contact(
    "upper face",
    "lower face",
    secondary="upper face",
    gap=lambda x: x[0] ** 2 / (2 * R),
    friction=tfeti.Coulomb(mu),
    reach=1.3 * a**2 / R,
    name="contact",
)
problem = tfeti.ContactProblem(
    elastic.a(u, v), loads(P, Q, v), bcs, [contact], decomposition, stress=elastic.stress
)

# ## Closed form
#
# What changes since a turn is as if the force grew from 0, with twice the coefficient. `slipped`
# is the displacement by slip alone, of half planes: what they move while they stick has no bound
# for a line load.

# +
load = np.pi * E / (1 - nu**2) / 2 * a**2 / (4 * R)
most, compliance = 0.8, mu * load / (np.pi * E / (1 - nu**2) / 2)
s = 1 - most
lost = 2 * mu * load * compliance * (2 * s * np.log(s) + 1 - s**2)  # in a cycle


def slipped(share):
    return compliance * ((1 - share) * np.log1p(-share) + share)


def slipped_back(share):
    """On the way from the largest force to its opposite."""
    return slipped(most) - 2 * slipped((most - share) / 2)


# -

# ## To and fro
#
# The work of the loads goes into elastic energy and friction; the defect is what is missing, since
# forces change within a step. c is found by the second moment of what friction leaves, μp − |q|, or
# since a turn μp − |Δq|/2, a pressure of Hertz's on |x| < c.

# +
steps = arguments.steps or (1 if arguments.quick else 4)
up = most * np.arange(1, steps + 1) / steps
down = most * (1 - np.arange(1, 2 * steps + 1) / steps)
energy_form = fem.form(0.5 * ufl.energy_norm(elastic.a(u, v), problem.u))
path_forms = [fem.form(loads(*one, problem.u)) for one in ((1.0, 0.0), (0.0, 1.0))]


def total(form):
    return comm.allreduce(fem.assemble_scalar(form))


def push(share):
    """Solve a load step: forces, what they have moved, energy, pressure and friction."""
    P.value, Q.value = load, share * mu * load
    problem.solve()
    problem.accept()
    data = problem.solution.contact()
    parts = (data.points[:, 0], data.area, data.pressure, -data.tangential_traction[:, 0])
    found = [np.concatenate(comm.allgather(part)) for part in parts]
    forces, paths = np.array([P.value, Q.value]), np.array([total(form) for form in path_forms])
    return forces, paths, total(energy_form), found


before = push(0.0)
rows, last, turned, q_turned = [], 0.0, None, 0.0
for share in (*up, *down, *-down):
    if (share - last) * (-1 if turned is not None and turned > 0 else 1) < 0:  # it turns
        turned, q_turned = last, before[3][3]
    now = push(share)
    x, area, p, q = now[3]
    change, closed = (
        (abs(q), abs(share))
        if turned is None
        else (
            abs(q - q_turned) / 2,
            abs(share - turned) / 2,
        )
    )
    weight = area * (mu * p - change)
    dissipated = comm.allreduce(float(np.sum(problem.solution.dissipation)))
    work = (before[0] + now[0]) / 2 @ (now[1] - before[1])
    rows.append(
        {
            "Q/(μP)": share,
            "c/a": float(np.sqrt(4 * (weight @ x**2) / np.sum(weight))) / a,
            "closed form": np.sqrt(1 - closed),
            "moved/a": now[1][1] / a,
            "dissipation": dissipated / lost,
            "defect": (work - (now[2] - before[2]) - dissipated) / lost,
            "problems": problem.report.friction_iterations,
            "F": problem.report.F_multiplications,
        }
    )
    before, last = now, share
if comm.rank == 0:
    print("  ".join(f"{name:>12}" for name in rows[0]))
    for row in rows:
        print("  ".join(f"{value:12.4g}" for value in row.values()))
# -

# ## Comparison with the closed form
#
# The defect is that of all steps, over what a cycle dissipates.

misses = [float(row["c/a"] / row["closed form"] - 1) for row in rows]
errors = problem.report.errors
errors["stick_half_width"] = max(misses[:steps], key=abs)
errors["stick_after_turns"] = max(misses[steps:], key=abs)
errors["dissipation"] = float(sum(row["dissipation"] for row in rows[steps:]) - 1)
errors["dissipation_of_half_a_cycle"] = float(
    2 * sum(row["dissipation"] for row in rows[steps : 3 * steps]) - 1
)
errors["least_dissipation"] = float(min(row["dissipation"] for row in rows))
errors["energy_defect"] = float(sum(row["defect"] for row in rows[steps:]))

# ## Output

# +
if arguments.output:
    tfeti.write_vtx(arguments.output / "unloading_2d.bp", problem.solution)
if arguments.plot:
    folder = arguments.output or Path("results")
    if comm.rank == 0:
        from matplotlib.figure import Figure

        # the displacement of a line load has no closed form: the secant through the turns is what
        # was found, and the rest is slip
        folder.mkdir(parents=True, exist_ok=True)
        share, moved = np.array([(row["Q/(μP)"], row["moved/a"]) for row in rows]).T
        secant, fine = moved[steps - 1] / most, np.linspace(-most, most, 401)
        back = (slipped_back(fine) - slipped(most) / most * fine) / a
        way = np.concatenate((fine[200:], fine[::-1], fine))
        first = (slipped(fine[200:]) - slipped(most) / most * fine[200:]) / a
        slip = np.concatenate((first, back[::-1], -back[::-1]))
        figure = Figure(figsize=(8, 4), dpi=130, layout="constrained")
        for axes, taken in zip(figure.subplots(1, 2), (0.0, secant), strict=True):
            axes.plot(moved - taken * share, share, "o", markersize=3, label="computed")
            axes.plot(slip + (secant - taken) * way, way, linewidth=1, label="closed form")
            axes.set(xlabel="displacement / a" + (", less the secant" if taken else ""))
            axes.set(ylabel="Q / (μP)")
            axes.locator_params(axis="x", nbins=6)
        axes.legend(fontsize="small")
        figure.savefig(folder / "unloading_2d.png")
if arguments.report:
    problem.report.write(arguments.report, comm)
if comm.rank == 0:
    print(problem.report)
# -
