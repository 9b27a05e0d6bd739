"""Which side of a pair should carry the multipliers: the error of the pressure with either one.

    ./run python3 benchmarks/secondary_side.py [--quick]

Two bodies are pressed together: cylinders and balls on each other and on blocks, a block on a
block, a punch on a block. Their moduli differ by up to 1 : 100, their meshes by up to 1 : 8, from a
fixed size of the coarser one on. Each row has relative L² errors inside 0.9 of the contact with
both choices, at the nodes and of the field between them: against Hertz' closed form, or, where
faces are flat, against a finer mesh. The last table has what rules lose beside the better choice of
each row. Results go to results/secondary_side.md, .json and .png.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from itertools import product
from math import inf, pi
from pathlib import Path

import petsc4py

if __name__ == "__main__":
    petsc4py.init(sys.argv[:1])

import gmsh
import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI
from scipy.interpolate import LinearNDInterpolator

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import tfeti_dolfinx as tfeti
from benchmarks.tools import command_line, curves, finish, picture
from demos.hertz import LineContact, PointContact
from meshes.pressed_pair import build

NU, GROWTH = 0.3, 0.3  # Poisson's ratio; growth of elements away from the contact
OPTIONS = {"tfeti_rtol": 1e-6}
BODIES, FACES = ("upper", "lower"), ("upper face", "lower face")
A = 0.05  # half width of Hertz' contacts
FINE = 100  # elements over a flat contact that is a reference


@dataclass(frozen=True)
class Pair:
    """Two bodies of ``meshes/pressed_pair.py``; elements of the coarser one over the half width."""

    gdim: int
    radii: tuple[float, float] = (inf, inf)
    widths: tuple[float, float] = (1.0, 1.0)
    cells: tuple[float, ...] = (5.0, 6.5)

    @property
    def flat(self):
        """Whether there is no closed form."""
        return self.radii == (inf, inf)

    @property
    def half_width(self):
        """Half width of the contact."""
        return min(self.widths) if self.flat else A

    def hertz(self, moduli):
        """The closed form."""
        kind = LineContact if self.gdim == 2 else PointContact
        modulus = 1 / sum((1 - NU**2) / E for E in moduli)
        return kind.from_half_width(A, 1 / sum(1 / radius for radius in self.radii), modulus)


PAIRS = {
    "Cylinder on a cylinder": Pair(2, (1.0, 1.0)),
    "Cylinder on a block": Pair(2, (1.0, inf)),
    "Block on a block": Pair(2),
    "Punch on a block": Pair(2, widths=(0.5, 1.0)),
    "Ball on a ball": Pair(3, (1.0, 0.7), cells=(4.0,)),
    "Ball on a block": Pair(3, (1.0, inf), cells=(4.0,)),
}
# E over E and h over h, of the upper body over the lower one
GRIDS = {
    2: ((0.01, 0.1, 1.0, 10.0, 100.0), (0.125, 0.5, 0.8, 1.0, 1.25, 2.0, 8.0)),
    3: ((0.1, 1.0, 10.0), (0.5, 0.8, 1.0, 1.25, 2.0)),
}
QUICK = {
    "Cylinder on a cylinder": ((10.0,), (0.5, 2.0)),
    "Ball on a ball": ((0.1,), (0.5,)),
}
# which side each takes, 0 or 1, from E over E and h over h
RULES = {
    "the coarser one": lambda E, h: int(h < 1.0 or (h == 1.0 and E > 1.0)),
    "the softer one": lambda E, h: int(E > 1.0 or (E == 1.0 and h < 1.0)),
    "that of smaller E/h": lambda E, h: int(E / h > 1.0),
    "the finer one": lambda E, h: int(h > 1.0 or (h == 1.0 and E > 1.0)),
}


def torn(pair, sizes):
    """The torn mesh of both bodies."""
    comm = MPI.COMM_WORLD
    model = None
    if comm.rank == 0:
        model = build(pair.gdim, pair.radii, pair.widths, sizes, 1.4 * pair.half_width, GROWTH)
    decomposition = tfeti.read_gmsh(model, comm, subdomains=4)
    if comm.rank == 0:
        gmsh.model.remove()
    return decomposition


def solved(d, pair, moduli, secondary="auto"):
    """Points across the height, pressures and areas on all ranks; the secondary side; its F."""
    last = pair.gdim - 1
    model = "plane_strain" if pair.gdim == 2 else "3d"
    elastic = tfeti.Elasticity(d, E=dict(zip(BODIES, moduli, strict=True)), nu=NU, model=model)
    V = fem.functionspace(d.mesh, ("Lagrange", 1, (pair.gdim,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    ds = ufl.Measure("ds", domain=d.mesh, subdomain_data=d.facet_tags)(d.surface("load"))
    one, reach = fem.Constant(d.mesh, 1.0), 0.1
    pressure = fem.Constant(d.mesh, 1e-3) * (1 + ufl.cos(pi * ufl.SpatialCoordinate(d.mesh)[0]) / 2)
    if not pair.flat:
        area = d.comm.allreduce(fem.assemble_scalar(fem.form(one * ds)))
        pressure = fem.Constant(d.mesh, pair.hertz(moduli).load / 2**last / area)
        reach = A**2 * sum(1 / radius for radius in pair.radii)
    bcs = []
    for axis, side in ((last, "bottom"), (0, "x=0"), (1, "y=0"))[: pair.gdim]:
        dofs = fem.locate_dofs_topological(V.sub(axis), last, d.facets(side))
        bcs.append(fem.dirichletbc(0.0, dofs, V.sub(axis)))
    contact = tfeti.Contact(*FACES, secondary=secondary, reach=reach)
    problem = tfeti.ContactProblem(
        elastic.a(u, v), -pressure * v[last] * ds, bcs, [contact], d, petsc_options=OPTIONS
    )
    problem.solve()
    data = problem.solution.contact(0)
    parts = d.comm.allgather((data.points[:, :last], data.pressure, data.area))
    found = tuple(np.concatenate(part) for part in zip(*parts, strict=True))
    side = FACES.index(problem.solution.contacts[0].surfaces[0])
    multiplications = problem.report.F_multiplications
    problem.destroy()
    return found, side, multiplications


def interpolated(found, at):
    """The pressure between nodes, linear; points are on the meshed part."""
    points, pressure, _ = found
    if points.shape[1] == 1:
        order = np.argsort(points[:, 0])
        return np.interp(at[:, 0], points[order, 0], pressure[order])
    # with mirror images, so that no point is outside
    both = np.concatenate([points * signs for signs in product((1, -1), repeat=2)])
    return LinearNDInterpolator(both, np.tile(pressure, 4))(at)


def errors(found, exact, pair):
    """Relative L² errors inside 0.9 of the contact: at the nodes, and of the field between them."""
    points, pressure, area = found
    radius = 0.9 * pair.half_width
    inside = np.linalg.norm(points, axis=1) < radius
    line = (np.arange(400) + 0.5) / 400 * radius
    grid = line[:, None]
    if pair.gdim == 3:
        grid = np.stack(np.meshgrid(line[::8], line[::8]), axis=-1).reshape(-1, 2)
        grid = grid[np.linalg.norm(grid, axis=1) < radius]
    pairs = (
        (pressure[inside], exact(points[inside]), area[inside]),
        (interpolated(found, grid), exact(grid), np.ones(len(grid))),
    )
    return [float(np.sqrt(np.sum(w * (p - q) ** 2) / np.sum(w * q**2))) for p, q, w in pairs]


def references(pair, all_moduli):
    """For each pair of moduli a function that returns the pressure at points."""
    if not pair.flat:
        closed = {moduli: pair.hertz(moduli) for moduli in all_moduli}
        return {m: lambda x, h=h: h.pressure(np.linalg.norm(x, axis=1)) for m, h in closed.items()}
    d = torn(pair, (pair.half_width / FINE,) * 2)
    fine = {moduli: solved(d, pair, moduli)[0] for moduli in all_moduli}
    return {m: lambda x, found=found: interpolated(found, x) for m, found in fine.items()}


def study(pair, stiffness, ratios):
    """A row for each ratio of moduli and of sizes: means of logarithms over sizes."""
    moduli = {E: (E, 1.0) if E > 1.0 else (1.0, 1.0 / E) for E in stiffness}
    exact = references(pair, moduli.values())
    rows = []
    for h in ratios:
        meshes = [
            torn(pair, (coarse * min(h, 1.0), coarse / max(h, 1.0)))
            for coarse in (pair.half_width / cells for cells in pair.cells)
        ]
        for E in stiffness:
            found, sides = {0: [], 1: []}, set()
            for d in meshes:
                taken = solved(d, pair, moduli[E])
                sides.add(taken[1])
                other = solved(d, pair, moduli[E], FACES[1 - taken[1]])
                for pressure, side, count in (taken, other):
                    found[side].append((*errors(pressure, exact[moduli[E]], pair), count))
            upper, lower = (np.exp(np.mean(np.log(found[side]), axis=0)) for side in (0, 1))
            auto = ", ".join(BODIES[side] for side in sorted(sides))
            row = {"E over E": E, "h over h": h, "auto": auto}
            for kind, value in enumerate(("nodes", "field", "F")):
                row[f"{value}, upper"], row[f"{value}, lower"] = (
                    float(upper[kind]),
                    float(lower[kind]),
                )
            rows.append(row)
    return rows


def losses(rows):
    """How much larger errors are with each rule than with the better side, by all rows."""
    table = []
    for rule, side in RULES.items():
        row = {"secondary": rule}
        for kind in ("nodes", "field", "F"):
            values = np.log([[line[f"{kind}, {body}"] for body in BODIES] for line in rows])
            taken = [side(line["E over E"], line["h over h"]) for line in rows]
            lost = values[np.arange(len(rows)), taken] - values.min(axis=1)
            row[f"{kind}, mean"] = float(np.exp(lost.mean()))
            row[f"{kind}, worst"] = float(np.exp(lost.max()))
        table.append(row)
    return table


def draw(path, tables):
    """The error with the lower side as the secondary one over that with the upper one."""
    shown = {title: rows for title, rows in tables.items() if title in PAIRS}
    with picture(path, len(shown)) as axes:
        for panel, (title, rows) in zip(axes, shown.items(), strict=True):
            lines = {}
            for E in sorted({row["E over E"] for row in rows}):
                own = [row for row in rows if row["E over E"] == E]
                ratio = [row["nodes, lower"] / row["nodes, upper"] for row in own]
                lines[f"E/E = {E:g}"] = ([row["h over h"] for row in own], ratio)
            curves(panel, title, ("h over h", "error, lower over upper"), lines)


def main(argv):
    """Solve all pairs with either side; returns the tables."""
    arguments, _ = command_line(__doc__, argv)
    grids = QUICK if arguments.quick else {name: GRIDS[pair.gdim] for name, pair in PAIRS.items()}
    tables = {name: study(PAIRS[name], *grid) for name, grid in grids.items()}
    tables["Rules"] = losses([row for rows in tables.values() for row in rows])
    return finish(arguments, "secondary_side", tables, draw, MPI.COMM_WORLD.rank)


if __name__ == "__main__":
    main(sys.argv[1:])
