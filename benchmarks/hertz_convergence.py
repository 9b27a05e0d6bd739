"""Convergence of the contact pressure in Hertz' problems, in 2D and 3D.

    ./run mpirun -n 2 python3 benchmarks/hertz_convergence.py [--quick]

Errors inside 0.9 a are taken against the closed form, which belongs to a half space, and against
a finer solution of the same body. Results go to
results/hertz_convergence.md, .json and .png.
"""

from __future__ import annotations

import sys
from pathlib import Path

import petsc4py

if __name__ == "__main__":
    petsc4py.init(sys.argv[:1])

import numpy as np
from mpi4py import MPI
from scipy.interpolate import LinearNDInterpolator

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.tools import column, command_line, curves, finish, picture, slope
from demos import cylinder_on_block_2d, hertz_2d, hertz_3d, sphere_on_block_3d

OPTIONS = ("-tfeti_rtol", "1e-8")


def contact_of(solution):
    """Horizontal coordinates (n, 1 or 2), pressures and areas of contact 0 of all ranks."""
    data, comm = solution.contact(0), MPI.COMM_WORLD
    across = solution.dofs.bs - 1
    parts = comm.allgather((data.points[:, :across], data.pressure, data.area))
    return [np.concatenate(part) for part in zip(*parts, strict=True)]


def difference(coarse, fine, radius):
    """Relative L² difference of two pressures where |x| < radius."""
    points, pressure, area = coarse
    inside = np.linalg.norm(points, axis=1) < radius
    if points.shape[1] == 1:
        order = np.argsort(fine[0][:, 0])
        exact = np.interp(points[:, 0], fine[0][order, 0], fine[1][order])
    else:
        exact = LinearNDInterpolator(fine[0], fine[1])(points)
    error = np.sum((area * (pressure - exact) ** 2)[inside])
    return float(np.sqrt(error / np.sum((area * exact**2)[inside])))


def study(demo, argument, values, sizes, half_width, options=OPTIONS):
    """One row per mesh, the finest being the reference of the others, and the slopes."""
    rows, contacts = [], []
    for value, size in zip(values, sizes, strict=True):
        solution, report = demo.run([argument, str(value), *options])
        contacts.append(contact_of(solution))
        rows.append({"h/a": size, "unknowns": report.primal_dofs, **report.errors})
    for row, contact in zip(rows[:-1], contacts[:-1], strict=True):
        row["pressure_l2_finer"] = difference(contact, contacts[-1], 0.9 * half_width)
    rows = rows[:-1]
    used = [row["h/a"] for row in rows]
    slopes = {
        name: slope(used, [row[name] for row in rows])
        for name in ("pressure_l2", "pressure_l2_finer")
    }
    return rows, slopes


def study_2d(elements=(8, 16, 32, 128), options=OPTIONS):
    """Hertz in 2D: elements along the half width, the last for reference."""
    return study(hertz_2d, "--elements", elements, [1 / n for n in elements], 0.04, options)


def study_3d(unknowns=(8_000, 30_000, 120_000, 480_000), options=OPTIONS):
    """Hertz in 3D: sizes, the last for reference."""
    sizes = [0.2 * (4500 / n) ** (1 / 3) for n in unknowns]
    return study(hertz_3d, "--unknowns", unknowns, sizes, 0.05, options)


def study_pair(elements=(8, 16, 32, 128), options=OPTIONS):
    """A cylinder on a block: elements along the half width, the last for reference."""
    a = cylinder_on_block_2d.closed_form().half_width
    sizes = [1 / n for n in elements]
    return study(cylinder_on_block_2d, "--elements", elements, sizes, a, options)


def study_pair_3d(unknowns=(8_000, 30_000, 120_000, 480_000), options=OPTIONS):
    """A ball on a block: sizes, the last for reference."""
    sizes = [0.2 * (2400 / n) ** (1 / 3) for n in unknowns]
    return study(sphere_on_block_3d, "--unknowns", unknowns, sizes, 0.05, options)


STUDIES = {
    "Half cylinder on a plane": study_2d,
    "Half ball on a plane": study_3d,
    "Cylinder on a block": study_pair,
    "Ball on a block": study_pair_3d,
}
QUICK = {"Cylinder on a block": (8, 12, 24)}


def draw(path, tables):
    """Errors over the size of the elements."""
    studies = {title: rows for title, rows in tables.items() if "h/a" in rows[0]}
    names = {"pressure_l2": "closed form", "pressure_l2_finer": "finer solution"}
    with picture(path, len(studies)) as axes:
        for panel, (title, rows) in zip(axes, studies.items(), strict=True):
            lines = {
                label: (column(rows, "h/a"), column(rows, name)) for name, label in names.items()
            }
            curves(panel, title, ("h/a", "relative L² error of the pressure"), lines)


def main(argv):
    """Run the studies and write them; returns the tables."""
    arguments, options = command_line(__doc__, argv)
    tables = {}
    for name in QUICK if arguments.quick else STUDIES:
        sizes = [QUICK[name]] if arguments.quick else []
        rows, slopes = STUDIES[name](*sizes, options=(*OPTIONS, *options))
        tables[name] = rows
        tables[f"{name}, slopes"] = [slopes]
    return finish(arguments, "hertz_convergence", tables, draw, MPI.COMM_WORLD.rank)


if __name__ == "__main__":
    main(sys.argv[1:])
