"""CalculiX: face-to-face penalty or mortar contact with a block whose nodes are all fixed.

    benchmarks/peers/run python3 benchmarks/peers/calculix_hertz.py MESH.npz FILE.json [TYPE] [K]

TYPE is "SURFACE TO SURFACE" or "MORTAR"; K times E/a is the slope of pressure over overclosure.
In 2D plane strain, which CalculiX makes of one layer of solid elements. Linear geometry, one
increment, SPOOLES. The block overlaps where the surfaces will touch, so that the body is held.
The deck stands beside FILE.json, as FILE.inp.
"""

import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
from judged import best, write
from scipy.spatial import cKDTree

ELEMENTS = {(2, 1): "CPE3", (2, 2): "CPE6", (3, 1): "C3D4", (3, 2): "C3D10"}
# CalculiX' face opposite of each corner
FACE = {2: np.array([2, 3, 1]), 3: np.array([3, 4, 2, 1])}
# nodes of the block, and its upper face, in units of the corners below
BLOCK = {
    2: ("CPE4", [(-1, 0), (1, 0), (1, 1), (-1, 1)], "S3"),
    3: ("C3D8", [(x, y, z) for z in (0, 1) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))], "S2"),
}
WIDE = 4.0  # half width of the block over a


def rows(table):
    """Lines of numbers between commas."""
    return "\n".join(", ".join(map(str, row)) for row in table)


def oriented(points, cells):
    """Plane cells counterclockwise, with gmsh's last two mid-edge nodes of tetrahedra exchanged."""
    if points.shape[1] == 3:
        order = [0, 1, 2, 3] if cells.shape[1] == 4 else [0, 1, 2, 3, 4, 5, 6, 7, 9, 8]
        return cells[:, order]
    return cells


def deck(data, kind, slope):
    """The input of CalculiX."""
    points, cells = data["points"], oriented(data["points"], data["cells"])
    (n, dim), m = points.shape, len(cells)
    a, R, E, nu = (float(data[name]) for name in ("a", "R", "E", "nu"))
    up = a**2 / (2 * R)
    element, corners, upper = BLOCK[dim]
    size = np.array([WIDE * a] * (dim - 1) + [1.0])
    block = np.array(corners, dtype=float) * size
    block[:, -1] = np.where(block[:, -1] > 0, up, up - a)
    tags = np.arange(n + 1, n + 1 + len(block))
    x = np.concatenate((points, block))
    x = np.column_stack((x, np.zeros((len(x), 3 - dim))))
    nodes = [(k + 1, *(f"{v:.12e}" for v in row)) for k, row in enumerate(x)]
    faces = {
        name: [(cell + 1, FACE[dim][opposite]) for cell, opposite in data[f"{name} cells"]]
        for name in ("contact", "top")
    }
    load = float(data["load"]) / area(points, data["top"])
    mortar = kind.endswith("MORTAR")
    behaviour = "HARD" if mortar else f"LINEAR\n{slope * E / a:.6e}, 0."
    held = rigid(points, data["axis"], R)
    return f"""*NODE, NSET=ALL
{rows(nodes)}
*ELEMENT, TYPE={ELEMENTS[dim, int(data["order"])]}, ELSET=BODY
{rows(np.column_stack((np.arange(1, m + 1), cells + 1)))}
*ELEMENT, TYPE={element}, ELSET=BLOCK
{rows([[m + 1, *tags]])}
*NSET, NSET=FIXED
{rows(tags[:, None])}
*SURFACE, NAME=SLAVE, TYPE=ELEMENT
{rows([(cell, f"S{face}") for cell, face in faces["contact"]])}
*SURFACE, NAME=MASTER, TYPE=ELEMENT
{m + 1}, {upper}
*MATERIAL, NAME=STUFF
*ELASTIC
{E}, {nu}
*SOLID SECTION, ELSET=BODY, MATERIAL=STUFF
{"1." if dim == 2 else ""}
*SOLID SECTION, ELSET=BLOCK, MATERIAL=STUFF
{"1." if dim == 2 else ""}
*SURFACE INTERACTION, NAME=TOUCH
*SURFACE BEHAVIOR, PRESSURE-OVERCLOSURE={behaviour}
*CONTACT PAIR, INTERACTION=TOUCH, TYPE={kind}
SLAVE, MASTER
*BOUNDARY
FIXED, 1, {dim}, 0.
{rows(held)}
*STEP, INC=100
*STATIC, SOLVER=SPOOLES
1., 1.
*DLOAD
{rows([(cell, f"P{face}", f"{load:.12e}") for cell, face in faces["top"]])}
*CONTACT FILE
CDIS, CSTR
*END STEP
""".replace("\n\n", "\n")


def area(points, facets):
    """Length or area of flat facets, by their corners."""
    x = points[facets[:, : points.shape[1]]]
    sides = x[:, 1:] - x[:, :1]
    if points.shape[1] == 2:
        return float(np.linalg.norm(sides[:, 0], axis=1).sum())
    return float(np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1).sum()) / 2


def rigid(points, axis, R):
    """Nodes and directions that hold motions along the plane, for which no force is needed."""
    if points.shape[1] == 2:
        return [(node + 1, 1, 1, "0.") for node in axis]
    middle, side = (
        int(np.argmin(np.linalg.norm(points - p, axis=1))) + 1 for p in ((0, 0, R), (R, 0, R))
    )
    return [(middle, 1, 2, "0."), (side, 2, 2, "0.")]


def contact_pressures(file):
    """Coordinates and contact pressures of all nodes that have one, from CalculiX' results."""
    places, pressure, block = {}, {}, None
    for line in file.read_text().splitlines():
        if line.startswith("    2C"):
            block = "nodes"
        elif line.startswith(" -4"):
            block = line.split()[1]
        elif line.startswith(" -3"):
            block = None
        elif line.startswith(" -1") and block in ("nodes", "CONTACT"):
            node = int(line[3:13])
            values = [float(line[k : k + 12]) for k in range(13, len(line.rstrip()), 12)]
            if block == "nodes":
                places[node] = values
            else:
                pressure[node] = values[3]
    return np.array([places[k] for k in pressure]), np.array(list(pressure.values()))


def solved(job):
    """Run CalculiX on a deck."""
    done = subprocess.run(["ccx", job.name], cwd=job.parent, capture_output=True, text=True)
    if "Job finished" not in done.stdout:
        raise RuntimeError(done.stdout[-2000:] + done.stderr[-500:])
    return done.stdout


def on_contact(data, job):
    """Nodes of the contact surface and pressures there, of all layers of a plane body."""
    places, pressure = contact_pressures(job.with_suffix(".frd"))
    x, nodes = data["points"], np.unique(data["contact"])
    _, node = cKDTree(x).query(places[:, : x.shape[1]])
    total, count = np.bincount(node, pressure, len(x)), np.bincount(node, minlength=len(x))
    return x[nodes], total[nodes] / np.maximum(count[nodes], 1)


def main(argv):
    """Write the deck, run CalculiX, and write the pressure with what it took."""
    data, job = np.load(argv[0]), Path(argv[1]).with_suffix("")
    kind = argv[2] if len(argv) > 2 else "SURFACE TO SURFACE"
    slope = float(argv[3]) if len(argv) > 3 else 1e3
    job.with_suffix(".inp").write_text(deck(data, kind, slope))
    run = best(lambda: solved(job), resource.RUSAGE_CHILDREN)
    steps = run["found"].count(" iteration ")
    run["found"] = on_contact(data, job)
    version = subprocess.run(["ccx", "-v"], capture_output=True, text=True).stdout.split()[-1]
    write(argv[1], f"CalculiX {version}", run, unknowns=data["points"].size, steps=steps)


if __name__ == "__main__":
    main(sys.argv[1:])
