"""Seconds to an error of the pressure of Hertz's half cylinder on a rigid plane.

    python3 benchmarks/peers/compare.py half_cylinder      (not inside of ./run)

Each program reads points, cells counterclockwise, facets of the surfaces with their cells, nodes on
the axis, and the data of the scene from a file. This package solves a case of
benchmarks/time_against_error.py.
"""

import importlib
import json

from compare import MESH, NAME, OURS, ROOT, command, facets_on

SIZES = {1: (6, 12, 24, 48), 2: (3, 6, 12, 24)}  # elements along a, by the order of the mesh
PEERS = {"GetFEM": (1, 2), "CalculiX": (1, 2), "Kratos": (1,)}  # orders of meshes


def mesh(size, order, file):
    """Mesh the scene and write it; in ./run."""
    import gmsh
    import meshio
    import numpy as np

    from benchmarks.error_scenes import GRADED, LINE, NU, SCENES, R
    from meshes.tools import element_options

    with element_options(ElementOrder=order):
        SCENES["half cylinder"]().build(size, GRADED)
    gmsh.write(str(made := file.with_suffix(".msh")))
    read = meshio.read(made)
    triangle, line = {1: ("triangle", "line"), 2: ("triangle6", "line3")}[order]
    cells, lines, points = read.cells_dict[triangle], read.cells_dict[line], read.points[:, :2]
    tags = read.get_cell_data("gmsh:physical", line)
    group = {name: lines[tags == tag] for name, (tag, dim) in read.field_data.items() if dim == 1}
    found = {"points": points, "cells": cells, "order": order, "axis": group["axis"]}
    # ends of the edge opposite of a corner, as it lies in its cell, and the node between them
    along = np.array([(1, 2, 4), (2, 0, 5), (0, 1, 3)])[:, : order + 1]
    for surface in ("contact", "top"):
        on = np.isin(cells[:, :3], group[surface])
        found[f"{surface} cells"] = facets = facets_on(on)
        found[surface] = np.take_along_axis(cells[facets[:, 0]], along[facets[:, 1]], axis=1)
    ends = points[found["top"][:, :2]]
    traction = LINE.load / np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).sum()
    data = {"load": LINE.load, "a": LINE.half_width, "R": R, "E": 1.0, "nu": NU}
    np.savez(file, **found, **data, traction=traction)


class ByPressure:
    """The scene, judged by its pressure."""

    DOCUMENT, TITLE, MEASURE = "peers", "half cylinder", "pressure"

    def prepare(self, program, case, file):
        """A solve of a case by a program, or its mesh."""
        import numpy as np

        size, order = case
        place = file.parent / f"{order}_{size}.npz"
        if program == MESH:
            mesh(size, order, place)
            return dict
        own = importlib.import_module(f"{program.lower()}_hertz")
        name, solve = own.prepare(dict(np.load(place)))

        def found():
            x, pressure, unknowns, steps = solve()
            made = {"program": name, "unknowns": unknowns, "steps": steps}
            return {**made, "points": list(map(float, x)), "values": list(map(float, pressure))}

        return found

    def commands(self, folder, quick):
        """What is run, as words for the screen, a command, and the file that it writes."""

        def ours(size, order, file, **other):
            words = {"scene": self.TITLE, "sizes": [size], "degree": order, "order": order}
            case = json.dumps({**words, "processor": True, **other})
            program = [str(ROOT / "benchmarks/time_against_error.py"), "--worker"]
            return [*OURS, *program, case, str(file), str(folder / "stresses.npz")]

        if not (reference := folder / "reference.json").exists():
            yield "reference", ours(12 if quick else 64, 2, reference, rtol=1e-7), None
        for order, along in ({1: (6,), 2: (3,)} if quick else SIZES).items():
            for size in along:
                peers = [peer for peer, orders in PEERS.items() if order in orders]
                for program in (MESH, NAME, *peers):
                    file = folder / f"{order}_{size}_{program}.json"
                    words = command("half_cylinder", program, (size, order), file)
                    words = ours(size, order, file) if program == NAME else words
                    label = f"order {order}, {size} elements along a, {program}"
                    yield label, words, None if program == MESH else file

    def judged(self, folder):
        """Rows of meshes and programs that did not fail, and those of each program by order."""
        import numpy as np

        from benchmarks.error_scenes import SCENES
        from benchmarks.pressures import errors

        samples, rows, lines = SCENES[self.TITLE]().samples, [], {}
        (reference,) = json.loads((folder / "reference.json").read_text())["rows"]
        for file in folder.glob("[12]_*_*.json"):
            order, size, program = file.stem.split("_", 2)
            found = json.loads(file.read_text())
            if "failed" in found or program == MESH:
                continue
            if program == NAME:
                (found,) = found["rows"]
                found |= {"program": NAME, "steps": found["F"]}
                profile = np.array(found["profile"])
            else:
                places = np.array(found["points"])[:, None]
                profile = samples.at(places, np.array(found["values"]))
            shown = ("program", "unknowns", "steps", "seconds", "MB")
            against = errors(samples, profile, np.array(reference["profile"]))
            row = {"order": int(order), "size": int(size), **against}
            rows.append({**{key: found[key] for key in shown}, **row})
        rows.sort(key=lambda r: (r["program"] != NAME, r["program"], r["order"], r["size"]))
        for row in rows:
            lines.setdefault(row["program"], {}).setdefault(row["order"], []).append(row)
        return rows, {program: list(own.values()) for program, own in lines.items()}


SCENE = ByPressure()
