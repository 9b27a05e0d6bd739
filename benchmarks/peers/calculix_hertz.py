"""CalculiX: face-to-face penalty contact with a block whose nodes are all fixed.

1000 E/a is the slope of pressure over overclosure. Plane strain, which CalculiX makes of one
layer of solid elements; linear geometry, one increment, SPOOLES. The block overlaps where the
surfaces will touch, so that the body is held.
"""

import subprocess
import tempfile
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

FACE = np.array([2, 3, 1])  # CalculiX' face opposite of each corner
WIDE = 4.0  # half width of the block over a


def rows(table):
    """Lines of numbers between commas."""
    return "\n".join(", ".join(map(str, row)) for row in table)


def deck(data, slope=1e3):
    """The input of CalculiX; the block is one element, all of it prescribed."""
    cells, a, R, E, nu = (data[name] for name in ("cells", "a", "R", "E", "nu"))
    up, wide = a**2 / (2 * R), WIDE * a
    block = [(-wide, up - a), (wide, up - a), (wide, up), (-wide, up)]
    nodes, n, m = np.concatenate((data["points"], block)), len(data["points"]), len(cells)
    top, load = data["top cells"], float(data["traction"])
    return f"""*NODE, NSET=ALL
{rows((k + 1, f"{x:.12e}", f"{y:.12e}", 0.0) for k, (x, y) in enumerate(nodes.tolist()))}
*ELEMENT, TYPE={"CPE3" if cells.shape[1] == 3 else "CPE6"}, ELSET=BODY
{rows(np.column_stack((np.arange(1, m + 1), cells + 1)))}
*ELEMENT, TYPE=CPE4, ELSET=TOOL
{rows([[m + 1, *range(n + 1, n + 5)]])}
*NSET, NSET=TOOL, GENERATE
{n + 1}, {n + 4}
*SURFACE, NAME=SLAVE, TYPE=ELEMENT
{rows((cell + 1, f"S{FACE[opposite]}") for cell, opposite in data["contact cells"])}
*SURFACE, NAME=MASTER, TYPE=ELEMENT
{m + 1}, S3
*MATERIAL, NAME=STUFF
*ELASTIC
{E}, {nu}
*SOLID SECTION, ELSET=BODY, MATERIAL=STUFF
1.
*SOLID SECTION, ELSET=TOOL, MATERIAL=STUFF
1.
*SURFACE INTERACTION, NAME=TOUCH
*SURFACE BEHAVIOR, PRESSURE-OVERCLOSURE=LINEAR
{slope * E / a:.6e}, 0.
*CONTACT PAIR, INTERACTION=TOUCH, TYPE=SURFACE TO SURFACE
SLAVE, MASTER
*BOUNDARY
TOOL, 1, 2, 0.0
{rows((node, 1, 1, 0.0) for node in np.unique(data["axis"]) + 1)}
*STEP, INC=100
*STATIC, SOLVER=SPOOLES
1., 1.
*DLOAD
{rows((cell + 1, f"P{FACE[opposite]}", f"{load:.12e}") for cell, opposite in top)}
*CONTACT FILE
CDIS, CSTR
*END STEP
"""


def on_contact(data, file):
    """Places of the contact surface and pressures there, the mean of both layers' nodes."""
    places, pressure, block = {}, {}, None
    for line in file.read_text().splitlines():
        if line.startswith("    2C"):
            block = "nodes"
        elif line.startswith((" -4", " -3")):
            block = line.split()[1] if line.startswith(" -4") else None
        elif line.startswith(" -1") and block in ("nodes", "CONTACT"):
            values = [float(line[k : k + 12]) for k in range(13, len(line.rstrip()), 12)]
            into, value = (places, values[:2]) if block == "nodes" else (pressure, values[3])
            into[int(line[3:13])] = value
    x, nodes = data["points"], np.unique(data["contact"])
    _, node = cKDTree(x).query([places[k] for k in pressure])
    total = np.bincount(node, list(pressure.values()), len(x))
    return x[nodes, 0], (total / np.maximum(np.bincount(node, minlength=len(x)), 1))[nodes]


def prepare(data):
    """The program, and a solve."""
    job = Path(tempfile.mkdtemp()) / "job"
    job.with_suffix(".inp").write_text(deck(data))

    def once():
        done = subprocess.run(["ccx", job.name], cwd=job.parent, capture_output=True, text=True)
        if "Job finished" not in done.stdout:
            raise RuntimeError(done.stdout[-2000:] + done.stderr[-500:])
        steps = done.stdout.count(" iteration ")
        return *on_contact(data, job.with_suffix(".frd")), data["points"].size, steps

    version = subprocess.run(["ccx", "-v"], capture_output=True, text=True).stdout.split()[-1]
    return f"CalculiX {version}", once
