"""Draws one picture in a process of its own: ``python3 draw.py DATA.npz PICTURE.png``.

VTK aborts its process where an X server is missing or goes away, so it is kept apart from the
ranks. This file is run as a script and imports nothing of the package: a child of an MPI process
must not start MPI.
"""

import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from typing import Any

import numpy as np

# in a field of its own, right of the scene
SCALAR_BAR = {
    "vertical": True,
    "position_x": 0.08,
    "position_y": 0.2,
    "height": 0.6,
    "width": 0.5,
    "color": "black",
    "label_font_size": 32,
    "n_labels": 4,
    "fmt": "%.3g",
}
# light maps, whose colours are read in the shade
MAPS = {"von Mises stress": "YlGnBu", "contact pressure": "YlOrRd"}
STATUS = {0: "whitesmoke", 1: "silver", 2: "mediumseagreen", 3: "darkorange", 4: "royalblue"}
STATUS_NAMES = {1: "open", 2: "touching", 3: "slip", 4: "stick"}
BODIES = ("#8dd3c7", "#fdb462", "#80b1d3", "#fb8072", "#b3de69", "#bebada", "#fccde5", "#ffed6f")
OBSTACLE = "grey"
WIDTH = 0.84  # share of the scene; the scale has the rest
FEW_CELLS = 3000  # whose edges do not hide the colours
BEHIND = 1e-3  # of the scene
CUT = 1e-4  # of the scene
CORNER = 30.0  # degrees between facets that meet in an edge


def start_screen() -> subprocess.Popen[bytes] | None:
    """Xvfb, unless there is an X server already, or no Xvfb: a newer VTK draws without one."""
    if os.environ.get("DISPLAY") or shutil.which("Xvfb") is None:
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
    """Draw deformed bodies, coloured by a nodal field, and obstacles to a ``.png``.

    The data are the arrays ``cells``, ``types``, ``points``, ``moved``, ``values``, ``body``, and
    ``name`` (of the field), ``unit``, ``factor`` (nan: the largest displacement becomes 5 % of the
    scene), ``zoom``, ``focus`` (nan: the centre), ``edges`` (nan: those of few cells), ``highest``
    (nan: the largest), ``view`` (nan: pyvista's), ``cut`` (nan: none), and of each obstacle i
    ``obstacle_i``, its distance on a grid of ``box``, shape ``(nx, ny, nz)``.
    """
    import pyvista

    grid = pyvista.UnstructuredGrid(data["cells"], data["types"], data["points"])
    name, factor = str(data["name"]), float(data["factor"])
    grid["u"], grid[name], grid.cell_data["body"] = data["moved"], data["values"], data["body"]
    if np.isnan(factor):
        size = np.linalg.norm(np.ptp(grid.points, axis=0))
        factor = float(0.05 * size / max(np.abs(grid["u"]).max(), 1e-300))
    point, normal = data["cut"]
    if np.all(np.isfinite(normal)):
        normal, off = normal / np.linalg.norm(normal), CUT * np.ptp(data["points"])
        point = point - 2.0 * off * normal  # through no nodes, where VTK leaves holes
        grid = grid.clip(normal=normal, origin=point)
        at_cut = (grid.points - point) @ normal > -off
        grid[name] = np.where(at_cut & (name == "status"), max(STATUS) + 1, grid[name])
    bodies = grid.warp_by_vector("u", factor=factor)
    bodies.set_active_scalars(name)
    flat = bool(np.ptp(grid.points[:, 2]) == 0.0)
    plotter = pyvista.Plotter(
        off_screen=True,
        window_size=[1200, 900],
        shape=(1, 2),
        col_weights=[WIDTH, 1 - WIDTH],
        border=False,
    )
    plotter.subplot(0, 0)
    shade = {
        "lighting": not flat,
        "ambient": 1.0 if flat else 0.85,  # colours are read, also where no light falls
        "diffuse": 0.0 if flat else 0.2,
        "specular": 0.0,
    }
    edges = float(data["edges"])
    shown = grid.n_cells <= FEW_CELLS if np.isnan(edges) else bool(edges)
    shade |= {"show_edges": shown, "edge_opacity": 0.3, "show_scalar_bar": False}
    actor = _coloured(plotter, bodies, name, float(data["highest"]), shade)
    outline = bodies.extract_feature_edges(  # in 2D orientations of cells may differ
        feature_angle=CORNER,
        boundary_edges=flat,
        feature_edges=not flat,
        non_manifold_edges=False,
        manifold_edges=False,
    )
    if outline.n_cells:
        lines = plotter.add_mesh(outline, color="black", line_width=1.5, lighting=False)
        lines.mapper.SetResolveCoincidentTopologyToPolygonOffset()  # whole where bodies touch
        lines.mapper.SetRelativeCoincidentTopologyLineOffsetParameters(-2.0, -200.0)
    for i in range(len([key for key in data if str(key).startswith("obstacle_")])):
        _add_obstacle(plotter, data["box"], data[f"obstacle_{i}"], flat)
    _look(plotter, np.vstack((grid.points, bodies.points)), data, flat)
    plotter.subplot(0, 1)
    if actor is not None:
        unit = str(data["unit"])
        title = "\n".join([*name.split(), f"[{unit}]" * bool(unit), ""])
        look = SCALAR_BAR | {"title_font_size": 32 if len(max(title.split(), key=len)) < 7 else 28}
        whole = {"fmt": "%.0f"} if 1e3 <= actor.mapper.scalar_range[1] < 1e5 else {}
        plotter.add_scalar_bar(title=title, mapper=actor.mapper, **look | whole)
    if factor != 1.0:
        text = f"displacement\n× {factor:.3g}"
        plotter.add_text(text, position="lower_left", font_size=17, color="black")
    # lines are whole; "ssaa" would misplace the field of the scale
    plotter.enable_anti_aliasing("fxaa", all_renderers=True)
    plotter.screenshot(target)


def _coloured(
    plotter: Any, bodies: Any, name: str, highest: float, shade: dict[str, Any]
) -> Any | None:
    """Add the bodies in the field's colours; what the scale is of, if there is one."""
    if name in MAPS:
        limits = None if np.isnan(highest) else [0.0, highest]
        return plotter.add_mesh(bodies, scalars=name, cmap=MAPS[name], clim=limits, **shade)
    surface = bodies.extract_surface().triangulate()
    if name == "status":  # of a facet the least of its nodes, of which those at a cut have none
        of_cells = surface[name][surface.faces.reshape(-1, 4)[:, 1:]].min(axis=1).astype(int)
        of_cells[of_cells > max(STATUS)] = 0
        colours, names = STATUS, STATUS_NAMES
    else:
        of_cells = surface.cell_data["body"].astype(int)
        colours, names = {i: BODIES[i % len(BODIES)] for i in np.unique(of_cells)}, {}
    for value, colour in colours.items():
        part = surface.extract_cells(of_cells == value)
        if part.n_cells:
            plotter.add_mesh(part, color=colour, scalars=None, **shade)
    legend = [(text, colours[value]) for value, text in names.items() if np.any(of_cells == value)]
    if legend:
        plotter.subplot(0, 1)
        size = (0.9, 0.045 * len(legend))
        plotter.add_legend(legend, bcolor=None, face="rectangle", loc="center left", size=size)
        plotter.subplot(0, 0)
    return None


def _add_obstacle(plotter: Any, box: Any, distance: Any, flat: bool) -> None:
    """Add what is behind the zero of a distance on a grid: in 2D its inside, in 3D its surface."""
    import pyvista

    shape = np.array(distance.shape)
    image = pyvista.ImageData(
        dimensions=shape, spacing=(box[1] - box[0]) / np.maximum(shape - 1, 1), origin=box[0]
    )
    image["distance"] = distance.ravel(order="F")
    if flat:
        inside = image.clip_scalar(scalars="distance", value=0.0, invert=True)
        if inside.n_cells:
            plotter.add_mesh(inside, color="lightgrey", lighting=False, show_scalar_bar=False)
    # in 3D a little behind it, else it and a body that lies on it would hide each other in spots
    behind = 0.0 if flat else BEHIND * float(np.max(box[1] - box[0]))
    surface = image.contour([-behind], scalars="distance")
    if surface.n_cells:
        # seen from its inside, as a plane from below, it lies over what is drawn
        line: dict[str, Any] = {"opacity": 0.15, "backface_params": {"opacity": 0.3}}
        if flat:
            line = {"line_width": 3, "lighting": False}
        plotter.add_mesh(surface, color=OBSTACLE, scalars=None, show_scalar_bar=False, **line)


def _look(plotter: Any, points: Any, data: Mapping[str, Any], flat: bool) -> None:
    """Place the camera: all bodies are seen, where they were and where they are."""
    if flat:
        plotter.view_xy()
    if np.all(np.isfinite(data["view"])):
        plotter.view_vector(data["view"], viewup=(0.0, 0.0, 1.0))
    low, high = points.min(axis=0), points.max(axis=0)
    plotter.reset_camera(bounds=np.stack((low, high), axis=1).ravel().tolist())
    if flat:  # without a focus the bodies fill the picture; else zoom 1 sees the sphere around them
        width, height = plotter.window_size
        low, high = 1.14 * (high - low)[:2] / 2
        plotter.enable_parallel_projection()
        if np.any(np.isnan(data["focus"])):
            plotter.camera.parallel_scale = max(high, low * height / (WIDTH * width))
    if np.all(np.isfinite(data["focus"])):
        plotter.set_focus(data["focus"])
        if flat:
            x, y, _ = data["focus"]
            plotter.camera.position = (x, y, plotter.camera.position[2])
    plotter.camera.zoom(float(data["zoom"]))


if __name__ == "__main__":
    screen = start_screen()
    draw(np.load(sys.argv[1]), sys.argv[2])
    sys.stderr.flush()
    if screen is not None:
        screen.kill()
    os._exit(0)  # VTK's own end would want the screen
