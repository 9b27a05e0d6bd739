#!/usr/bin/env python3
"""Seconds to a force in finite strain beside GetFEM: a half disc of rubber pressed on a plane.

    python3 benchmarks/peers/pressed_disc.py [--quick] [--output DIR]      (not inside of ./run)

The same energy (neo-Hooke, ν = 0.3), degree 2, half of the half disc, its flat side clamped and
pressed by 0.3 R in six steps; meshes that get finer, the same for both, in turns. Seconds are those
of the processor, the best of a few if short, for set-up and all steps; start, imports and compiled
forms are left out. GetFEM: as getfem_hertz.py; its distance to the plane is that of X, which makes
contact with a plane exact in finite strain. DIR/pressed_disc.md and .json have the tables.
"""

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

from compare import NAME, OURS, ROOT, THEIRS, told

SIZES = (8, 16, 32, 64)  # elements along the radius
DEPTHS = [0.05 * k for k in range(1, 7)]
E, NU = 1.0, 0.3
MU, LAMBDA = E / 2 / (1 + NU), E * NU / (1 + NU) / (1 - 2 * NU)
LEVELS = (0.01, 0.003, 0.001)


def quarter_disc(n):
    """Points and triangles, counterclockwise, so many along the radius; the lowest point is 0."""
    import numpy as np

    first = np.cumsum(np.arange(n + 2))  # of a ring
    angles = [np.linspace(-np.pi / 2, 0.0, k + 1) if k else np.zeros(1) for k in range(n + 1)]
    rings = [k / n * np.stack((np.cos(a), np.sin(a)), 1) for k, a in enumerate(angles)]
    cells = []
    for k in range(n):
        i, low, high = np.arange(k + 1), first[k], first[k + 1]
        cells.append(np.stack((low + i, high + i, high + i + 1), 1))
        cells.append(np.stack((low + i, high + i + 1, low + i + 1), 1)[:-1])
    return np.vstack(rings) + np.array([0.0, 1.0]), np.vstack(cells)


def ours(points, cells):
    """A solve that returns force, unknowns and steps of Newton's method; in ./run."""
    import basix.ufl
    import numpy as np
    import ufl
    from dolfinx import fem
    from dolfinx import mesh as dmesh
    from mpi4py import MPI

    import tfeti_dolfinx as tfeti

    element = basix.ufl.element("Lagrange", "triangle", 1, shape=(2,))
    disc = dmesh.create_mesh(MPI.COMM_WORLD, cells=cells.astype(np.int64), x=points, e=element)
    sides = {
        "arc": lambda x: np.isclose(np.hypot(x[0], x[1] - 1.0), 1.0),
        "top": lambda x: np.isclose(x[1], 1.0),
        "axis": lambda x: np.isclose(x[0], 0.0),
    }

    def solve():
        d = tfeti.decompose(disc, max(len(cells) // 600, 1), surfaces=sides)
        V = fem.functionspace(d.mesh, ("Lagrange", 2, (2,)))
        u, v, down = fem.Function(V), ufl.TestFunction(V), fem.Constant(d.mesh, (0.0, 0.0))
        top = fem.locate_dofs_topological(V, 1, d.facets("top"))
        axis = fem.locate_dofs_topological(V.sub(0), 1, d.facets("axis"))
        bcs = [fem.dirichletbc(down, top, V), fem.dirichletbc(0.0, axis, V.sub(0))]
        law = tfeti.NeoHooke(tfeti.Elasticity(d, E=E, nu=NU, model="plane_strain"), u, degree=2)
        plane = tfeti.Obstacle("arc", tfeti.Plane((0.0, 0.0), normal=(0.0, 1.0)))
        given = {"finite": True, "update": law.update}
        problem = tfeti.NonlinearContactProblem(law.residual(v), u, bcs, [plane], d, **given)
        steps = 0
        for depth in DEPTHS:
            down.value[1] = -depth
            problem.solve()
            problem.accept()
            steps += problem.report.newton_steps
        force = problem.solution.reaction("top").force[1]
        return abs(float(force)), V.dofmap.index_map.size_global * 2, steps

    solve()  # compiles forms
    return solve


def getfem(points, cells, r=10.0):
    """The same by GetFEM; in benchmarks/peers/run."""
    import getfem as gf
    import numpy as np

    made = gf.Mesh("empty", 2)
    corners = points[cells]
    made.add_convex(gf.GeoTrans("GT_PK(2,1)"), np.ascontiguousarray(corners.transpose(2, 1, 0)))
    on_arc = np.isclose(np.hypot(corners[:, :, 0], corners[:, :, 1] - 1.0), 1.0)
    arc = np.flatnonzero(on_arc.sum(axis=1) == 2)  # face k is opposite of corner k
    made.set_region(1, np.stack((arc, np.argmin(on_arc[arc], axis=1))).astype(np.int32))
    det = "Det(Id(2)+Grad_u)"
    energy = f"mu/2*(Norm_sqr(Id(2)+Grad_u)-2)-mu*log({det})+lambda/2*sqr(log({det}))"

    def solve():
        fem_u, fem_1 = gf.MeshFem(made, 2), gf.MeshFem(made, 1)
        fem_u.set_fem(gf.Fem("FEM_PK(2,2)"))
        fem_1.set_fem(gf.Fem("FEM_PK(2,1)"))
        im, fine = (gf.MeshIm(made, gf.Integ(f"IM_TRIANGLE({k})")) for k in (2, 6))
        model = gf.Model("real")
        model.add_fem_variable("u", fem_u)
        for name, value in (("mu", MU), ("lambda", LAMBDA), ("r", r * E * len(arc))):
            model.add_initialized_data(name, [value])
        model.add_nonlinear_term(im, energy)
        x, y = fem_u.basic_dof_nodes()
        across = np.arange(len(x)) % 2 == 1
        top = np.isclose(y, 1.0)
        held = np.flatnonzero(top | (np.isclose(x, 0.0) & ~across))
        rows = gf.Spmat("empty", len(held), len(x))
        for k, dof in enumerate(held):
            rows.add(k, int(dof), 1.0)
        pressed = top[held] & across[held]
        model.add_variable("held", len(held))
        way = model.add_constraint_with_multipliers("u", "held", rows, np.zeros(len(held)))
        surface = fem_1.basic_dof_on_region(1)
        model.add_fem_variable("pressure", gf.MeshFem("partial", fem_1, surface))
        model.add_initialized_fem_data("obstacle", fem_1, fem_1.basic_dof_nodes()[1])
        model.add_integral_contact_with_rigid_obstacle_brick(
            fine, "u", "pressure", "obstacle", "r", 1, 1
        )
        steps = 0
        for depth in DEPTHS:
            model.set_private_rhs(way, np.where(pressed, -depth, 0.0))
            did, converged = model.solve("max_res", 1e-7, "max_iter", 100, "lsolver", "mumps")
            if not converged:
                raise RuntimeError(f"no convergence at {depth}")
            steps += int(did)
        force = model.variable("held")[pressed].sum()
        return abs(float(force)), len(x) + len(surface), steps

    return solve


PROGRAMS = {NAME: (OURS, ours), "GetFEM": (THEIRS, getfem)}


def tables_of(rows):
    """The rows, with errors beside the mean force of the finest meshes, and seconds to an error."""
    from benchmarks.time_against_error import seconds_at

    lines = {name: [row for row in rows if row["program"] == name] for name in PROGRAMS}
    finest = [line[-1]["force"] for line in lines.values() if line]
    mean = sum(finest) / len(finest)
    rows = [{**row, "error": abs(row["force"] / mean - 1.0)} for row in rows]
    table = []
    for name in PROGRAMS:
        line = [row for row in rows if row["program"] == name]
        found = {f"{level:.1%}": seconds_at(line, "error", level) for level in LEVELS}
        table.append({"program": name, **found})
    return {"pressed half disc": rows, "pressed half disc, seconds to an error": table}


def run(name, n, file):
    """Solve by a program, in its root, and write what it found."""
    from judged import best

    sys.path.insert(0, str(ROOT))
    made = best(PROGRAMS[name][1](*quarter_disc(n)))
    force, unknowns, steps = made.pop("found")
    found = {"program": name, "n": n, "unknowns": unknowns, "steps": steps, "force": force}
    Path(file).write_text(json.dumps({**found, **made}))


def main():
    """Run both in turns; then, in ./run, write the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="two coarse meshes")
    parser.add_argument("--output", type=Path, default=Path("results"), help="folder")
    parser.add_argument("--document", metavar="COMMIT", help="put the tables into docs/, too")
    parser.add_argument("--tables", action="store_true", help="of a folder of results, in ./run")
    parser.add_argument("--run", nargs=3, metavar=("PROGRAM", "N", "FILE"), help="one, in its root")
    arguments = parser.parse_args()
    folder = arguments.output.resolve() / "peers"
    files = [(n, name, folder / f"disc_{n}_{name}.json") for n in SIZES for name in PROGRAMS]
    if arguments.run:
        name, n, file = arguments.run
        return run(name, int(n), file)
    if arguments.tables:
        sys.path.insert(0, str(ROOT))
        from benchmarks.tools import finish

        rows = [json.loads(file.read_text()) for _, _, file in files if file.exists()]
        return finish(arguments, "pressed_disc", tables_of(rows))
    folder.mkdir(parents=True, exist_ok=True)
    os.environ["TFETI_JIT_CACHE"] = str(folder / "forms")
    for n, name, file in files[: 2 * len(PROGRAMS) if arguments.quick else None]:
        said = told([*PROGRAMS[name][0], __file__, "--run", name, str(n), str(file)])
        print(f"{n} elements along the radius", name, said or "done", flush=True)
    given = ["--document", arguments.document] if arguments.document else []
    words = [*OURS, __file__, "--tables", "--output", str(arguments.output.resolve()), *given]
    sys.exit(subprocess.run(words).returncode)


if __name__ == "__main__":
    main()
