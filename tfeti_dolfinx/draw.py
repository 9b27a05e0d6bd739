"""Draws one picture in a process of its own: ``python3 draw.py DATA.npz PICTURE.png``.

VTK aborts its process where an X server is missing or goes away, so it is kept apart from the
ranks. This file is run as a script and imports nothing of the package: a child of an MPI process
must not start MPI.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping
from typing import Any

import numpy as np

# in a field of its own, right of the scene
SCALAR_BAR = {
    "vertical": True,
    "position_x": 0.1,
    "position_y": 0.2,
    "height": 0.6,
    "width": 0.5,
    "color": "black",
    "title_font_size": 18,
    "label_font_size": 16,
}


def start_screen() -> subprocess.Popen[bytes] | None:
    """Xvfb, unless there is an X server already."""
    if os.environ.get("DISPLAY"):
        return None
    read, write = os.pipe()
    command = ["Xvfb", "-displayfd", str(write), "-screen", "0", "1280x1024x24"]
    server = subprocess.Popen(
        [*command, "-nolisten", "tcp"],
        pass_fds=[write],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    os.close(write)
    with os.fdopen(read) as pipe:
        number = pipe.readline().strip()
    if not number:
        raise RuntimeError("Xvfb did not start")
    os.environ["DISPLAY"] = f":{number}"
    return server


def draw(data: Mapping[str, Any], target: str) -> None:
    """Draw a deformed mesh, coloured by a nodal field, to a ``.png``.

    The data are the arrays ``cells``, ``types``, ``points``, ``moved``, ``values``, and scalars
    ``name``, ``factor`` (nan: the largest displacement becomes 5 % of the scene), ``zoom``,
    ``focus`` (nan: the centre), ``edges``, ``highest`` (nan: the largest), ``view`` (nan:
    pyvista's), ``cut`` (nan: none).
    """
    import pyvista

    grid = pyvista.UnstructuredGrid(data["cells"], data["types"], data["points"])
    name, factor = str(data["name"]), float(data["factor"])
    grid["u"], grid[name] = data["moved"], data["values"]
    if np.isnan(factor):
        size = np.linalg.norm(np.ptp(grid.points, axis=0))
        factor = float(0.05 * size / max(np.abs(grid["u"]).max(), 1e-300))
    point, normal = data["cut"]
    if np.all(np.isfinite(normal)):
        grid = grid.clip(normal=normal, origin=point, crinkle=True)
    flat = bool(np.ptp(grid.points[:, 2]) == 0.0)
    plotter = pyvista.Plotter(
        off_screen=True,
        window_size=[1200, 900],
        shape=(1, 2),
        col_weights=[0.86, 0.14],
        border=False,
    )
    plotter.subplot(0, 0)
    actor = plotter.add_mesh(
        grid.warp_by_vector("u", factor=factor),
        scalars=name,
        show_edges=bool(data["edges"]),
        cmap="viridis",
        clim=None if np.isnan(data["highest"]) else [0.0, float(data["highest"])],
        lighting=not flat,
        ambient=1.0 if flat else 0.55,  # colours are read, also where no light falls
        diffuse=0.0 if flat else 0.45,
        specular=0.0,
        edge_opacity=0.3,
        show_scalar_bar=False,
    )
    if flat:
        plotter.view_xy()
    if np.all(np.isfinite(data["view"])):
        plotter.view_vector(data["view"], viewup=(0.0, 0.0, 1.0))
    if np.all(np.isfinite(data["focus"])):
        plotter.set_focus(data["focus"])
        if flat:
            x, y, _ = data["focus"]
            plotter.camera.position = (x, y, plotter.camera.position[2])
    plotter.camera.zoom(float(data["zoom"]))
    plotter.subplot(0, 1)
    plotter.add_scalar_bar(title=f"{name}\n", mapper=actor.mapper, **SCALAR_BAR)
    plotter.add_text(f"displacement\n× {factor:.3g}", position="lower_left", font_size=14)
    plotter.screenshot(target)


if __name__ == "__main__":
    screen = start_screen()
    draw(np.load(sys.argv[1]), sys.argv[2])
    sys.stderr.flush()
    if screen is not None:
        screen.kill()
    os._exit(0)  # VTK's own end would want the screen
