"""Pictures without a screen; only here, and in the process that draws, is a plotting library."""

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from dolfinx import plot as dplot

from tfeti_dolfinx.common.agreement import agreeing
from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.files import checked_path, written_whole
from tfeti_dolfinx.common.validation import (
    FINITE,
    POSITIVE,
    checked_callable,
    checked_flag,
    checked_number,
    checked_type,
    checked_vector,
    named,
    shown,
    values_at,
)
from tfeti_dolfinx.contact.partner import Obstacle
from tfeti_dolfinx.contact.rigid_body import Pose, RigidBody
from tfeti_dolfinx.errors import InputError, TfetiError, raised_on_all_ranks
from tfeti_dolfinx.io import draw
from tfeti_dolfinx.solution import Solution

SECONDS = 600
# fields by what ``show`` calls them
FIELDS = {
    "von_mises": "von Mises stress",
    "pressure": "contact pressure",
    "status": "status",
    "bodies": "bodies",
}
# around the bodies, of their size; and points along an axis, for obstacles
MARGIN, SAMPLES = 0.08, {2: 401, 3: 61}


def plot_deformed(
    path: str | os.PathLike[str],
    solution: Solution,
    *,
    show: str = "von_mises",
    unit: str = "",
    factor: float | None = None,
    zoom: float = 1.0,
    focus: tuple[float, float, float] | None = None,
    show_edges: bool | None = None,
    show_obstacles: bool = True,
    highest: float | None = None,
    view: tuple[float, float, float] | None = None,
    cut: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None,
) -> Path:
    """Picture of the deformed bodies and of rigid obstacles. Collective.

    Rank 0 draws; the cells of all ranks travel there. An obstacle is drawn in grey where it is, if
    its gap is that of its shape.

    Args:
        path: The ``.png`` to write.
        solution: A solution.
        show: What colours say: "von_mises", the stress, of a problem that has one; "pressure",
            the contact pressure; "status", whether contact is open, slips or sticks; "bodies".
        unit: Of the stress or the pressure, for the scale.
        factor: Displacements are drawn times this; default 1 where there are contacts (bodies
            would seem to enter each other), else such that the largest is 5 % of their size.
        zoom: Camera zoom.
        focus: Point that the camera looks at.
        show_edges: Whether to draw cell edges; default where there are at most 3000 cells.
        show_obstacles: Whether to draw obstacles, which may hide what is behind them.
        highest: Value of the strongest colour; default of a stress that which 0.5 % of the nodes
            are above, of a pressure the largest.
        view: Direction from the bodies to the camera, z upwards; default pyvista's.
        cut: A point and a normal: what lies beyond that plane, before it moved, is cut away.

    Returns:
        The file written.

    Raises:
        InputError: VTK needs a screen and there is no X server and no Xvfb to start one, the
            problem has no stress, or an argument does not fit.
        TfetiError: The picture could not be drawn.
    """
    checked_type(solution, Solution, "solution", "the solution of a ContactProblem")
    comm = solution.decomposition.comm
    with agreeing(comm, "plot_deformed") as given:
        target = checked_path(path, ".png")
        checked_type(unit, str, "unit", "a string")
        if show not in FIELDS:
            raise InputError(f"show={shown(show)}: expected one of {', '.join(FIELDS)}")
        scene: dict[str, Any] = {
            "name": FIELDS[show],
            "unit": unit,
            "factor": np.nan if factor is None else checked_number(factor, "factor", FINITE),
            "zoom": checked_number(zoom, "zoom", POSITIVE),
            "focus": _vector(focus, "focus"),
            "edges": np.nan if show_edges is None else checked_flag(show_edges, "show_edges"),
            "obstacles": checked_flag(show_obstacles, "show_obstacles"),
            "highest": np.nan if highest is None else checked_number(highest, "highest", POSITIVE),
            "view": _vector(view, "view"),
            "cut": _pair(cut),
        }
        given |= {"path": path, **scene}
    if factor is None and solution.has_contact:
        scene["factor"] = 1.0
    parts = comm.gather(_grid(solution, {"values": _values(solution, show)}), root=0)
    with raised_on_all_ranks(comm), named(f"cannot write {target}", OSError):
        if comm.rank == 0 and parts is not None:
            whole = _joined(parts)
            if highest is None and show == "von_mises" and len(whole["values"]):
                scene["highest"] = max(float(np.quantile(whole["values"], 0.995)), 1e-300)
            if scene.pop("obstacles"):
                both = whole["points"], whole["moved"] * scene["factor"]
                scene |= _obstacles(solution, *both, scene["focus"], zoom)
            _draw(target, {**whole, **scene})
    return target


def to_pyvista(solution: Solution) -> Any:
    """See ``Solution.to_pyvista``."""
    import pyvista

    names = [name for name in FIELDS if name != "von_mises" or solution.has_stress]
    fields = {name: _values(solution, name) for name in names if name != "bodies"}
    parts = solution.decomposition.comm.gather(_grid(solution, fields), root=0)
    if parts is None:
        return None
    whole = _joined(parts)
    grid = pyvista.UnstructuredGrid(whole["cells"], whole["types"], whole["points"])
    grid["displacement"] = whole["moved"]
    for name in fields:
        grid[name] = whole[name]
    grid.cell_data["body"], grid.cell_data["subdomain"] = whole["body"], whole["subdomain"]
    return grid


def plot_pressure(
    path: str | os.PathLike[str],
    solution: Solution,
    coordinate: Callable[[Array], Array],
    closed_form: Callable[[Array], Array] | None = None,
    *,
    contact: int = 0,
    limit: float | None = None,
    label: str = "x",
    unit: str = "",
) -> Path:
    """Contact pressure over a coordinate, with a closed form if there is one. Collective.

    Args:
        path: The ``.png`` to write.
        solution: The solution.
        coordinate: From points, shape ``(3, n)``, to the coordinate, shape ``(n,)``.
        closed_form: Pressure at given coordinates.
        contact: Index of the contact.
        limit: Largest coordinate shown, in magnitude.
        label: Name of the coordinate.
        unit: Of the pressure, for its axis.

    Returns:
        The file written.

    Raises:
        InputError: An argument does not fit, or a callable fails.
    """
    checked_type(solution, Solution, "solution", "the solution of a ContactProblem")
    comm = solution.decomposition.comm
    with agreeing(comm, "plot_pressure") as given:
        given |= {"path": path, "contact": contact, "closed_form": closed_form, "limit": limit}
        given |= {"coordinate": coordinate, "label": label, "unit": unit}
        target = checked_path(path, ".png")
        checked_type(unit, str, "unit", "a string")
        checked_callable(coordinate, "coordinate", "a callable of points of shape (3, n)")
        if closed_form is not None:
            checked_callable(closed_form, "closed_form", "a callable of coordinates of shape (n,)")
        if limit is not None:
            checked_number(limit, "limit", POSITIVE)
    data = solution.contact(contact)
    with raised_on_all_ranks(comm):
        x = values_at(coordinate, data.points.T, (len(data.points),), "coordinate of")
    parts = comm.gather((x, data.pressure), root=0)
    with raised_on_all_ranks(comm), named(f"cannot write {target}"):
        if comm.rank == 0 and parts is not None:
            from matplotlib.figure import Figure

            x, p = (np.concatenate(rows) for rows in zip(*parts, strict=True))
            near = np.abs(x) <= (np.abs(x).max(initial=0.0) if limit is None else limit)
            order = np.argsort(x[near])
            x, p = x[near][order], p[near][order]
            figure = Figure(figsize=(7, 4.5), dpi=170, layout="constrained")
            axes = figure.subplots()
            axes.plot(x, p, "o", markersize=3, label="computed")
            if closed_form is not None:
                fine = np.linspace(x.min(), x.max(), 801)
                axes.plot(fine, closed_form(fine), "-", linewidth=1, label="closed form")
            axes.set(xlabel=label, ylabel=f"contact pressure [{unit}]".removesuffix(" []"))
            axes.legend()
            with written_whole(target) as partial:
                figure.savefig(partial)
    return target


def plot_friction(
    path: str | os.PathLike[str],
    solution: Solution,
    contacts: Sequence[str | int] | None = None,
    *,
    axes: tuple[int, int] = (0, 1),
    labels: tuple[str, str] = ("x", "y"),
    normal: bool = False,
) -> Path:
    """Draw contact nodes coloured by status, with arrows of their tractions. Collective.

    Arrows of tractions that stand out, as at corners, are shortened.

    Args:
        path: The ``.png`` to write, by rank 0.
        solution: A solution with friction.
        contacts: Names or indices of contacts; default all.
        axes: The coordinates to look at.
        labels: Their names.
        normal: Whether arrows have the pressure as well as the friction.

    Returns:
        The file written.

    Raises:
        InputError: An argument does not fit.
    """
    checked_type(solution, Solution, "solution", "the solution of a ContactProblem")
    comm = solution.decomposition.comm
    with agreeing(comm, "plot_friction") as given:
        given |= {"path": path, "contacts": contacts, "axes": axes, "labels": labels}
        given["normal"] = normal
        target = checked_path(path, ".png")
        chosen = range(len(solution.contacts)) if contacts is None else contacts
        if isinstance(chosen, str) or not isinstance(chosen, Sequence) or not chosen:
            raise InputError(
                f"contacts is {shown(contacts)}; expected names or positions, such as ['floor'], "
                "or None for all contacts"
            )
        if not solution.has_friction:
            raise InputError("plot_friction: no contact of the solution has friction")
    data = [solution.contact(name) for name in chosen]
    gdim = data[0].normal.shape[1]
    forces = [d.tangential_traction - normal * d.pressure[:, None] * d.normal for d in data]
    rows = [(d.points[:, :gdim], f, d.status) for d, f in zip(data, forces, strict=True)]
    parts = comm.gather(rows, root=0)
    with raised_on_all_ranks(comm), named(f"cannot write {target}"):
        if comm.rank == 0 and parts is not None:
            from matplotlib.figure import Figure

            whole = [np.concatenate(part) for part in zip(*chain.from_iterable(parts), strict=True)]
            x, arrows, status = whole[0][:, axes], whole[1][:, axes], whole[2]
            figure = Figure(figsize=(8, 5), layout="constrained")
            plot = figure.subplots()
            length = np.linalg.norm(arrows, axis=1)
            if np.any(length > 0.0):
                size = np.quantile(length[length > 0.0], 0.8)
                arrows = arrows / np.maximum(length / (2.0 * size), 1.0)[:, None]
                scale = 14.0 * size / np.linalg.norm(np.ptp(x, axis=0))
                look = {"angles": "xy", "scale_units": "xy", "scale": scale, "width": 0.002}
                plot.quiver(*x.T, *arrows.T, **look)
                plot.update_datalim(x + arrows / scale)
            for value, name in draw.STATUS_NAMES.items():
                if np.any(at := status == value):
                    look = {"color": draw.STATUS[value], "label": f"{name}: {at.sum()}"}
                    plot.plot(*x[at].T, "o", markersize=3, **look)
            plot.set_aspect("equal")
            plot.margins(0.15)
            plot.set(xlabel=labels[0], ylabel=labels[1])
            plot.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
            with written_whole(target) as partial:
                figure.savefig(partial, bbox_inches="tight")
    return target


def _vector(values: Any, what: str) -> Array:
    """Three numbers, nan if they are not given."""
    if values is None:
        return np.full(3, np.nan)
    return checked_vector(values, what, [3], "three finite numbers")


def _pair(cut: Any) -> Array:
    """Return a point and a normal, nan if they are not given."""
    if cut is None:
        cut = None, None
    if not isinstance(cut, (tuple, list, np.ndarray)) or len(cut) != 2:
        raise InputError(f"cut={shown(cut)}: expected a point and a normal")
    return np.stack([_vector(values, "cut") for values in cut])


def _values(solution: Solution, show: str) -> Array:
    """Return a field at the nodes of the displacement."""
    if show == "von_mises":
        return np.asarray(solution.nodal_von_mises.x.array)
    if show in ("pressure", "status") and solution.has_contact:
        return np.asarray(getattr(solution, show).x.array)
    return np.zeros(len(solution.displacement.x.array) // solution.dofs.bs)


def _grid(solution: Solution, fields: dict[str, Array]) -> dict[str, Array]:
    """Return cells, types, points, displacements, nodal fields and bodies of this rank."""
    u, decomposition = solution.displacement, solution.decomposition
    subdomain = decomposition.cell_subdomain
    cells, types, points = np.zeros(0, np.int32), np.zeros(0, np.uint8), np.zeros((0, 3))
    if len(u.x.array):
        cells, types, points = dplot.vtk_mesh(u.function_space)
    moved, dofs = np.zeros_like(points), solution.dofs
    moved[:, : dofs.bs] = u.x.array.reshape(-1, dofs.bs)
    grid: dict[str, Array] = {"cells": cells, "types": types, "points": points, "moved": moved}
    grid["group"] = dofs.group[dofs.primal_node]
    body = decomposition.body_of_subdomain[subdomain]
    return {**grid, **fields, "body": body, "subdomain": subdomain}


def _joined(parts: list[dict[str, Array]]) -> dict[str, Array]:
    """Return one grid of the ranks' grids, whose tears are closed; cells as VTK has them."""
    starts = np.cumsum([0, *(len(part["points"]) for part in parts)])
    whole = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    tables = [
        part["cells"].reshape(len(part["types"]), -1)[:, 1:] + start
        for part, start in zip(parts, starts, strict=False)
        if len(part["types"])
    ]
    if not tables:
        return whole
    table = np.concatenate(tables)
    # torn copies of a node are one
    _, first, node = np.unique(whole["group"], return_index=True, return_inverse=True)
    for name in whole.keys() - {"cells", "types", "body", "subdomain"}:
        whole[name] = whole[name][first]
    whole["cells"] = np.column_stack((np.full(len(table), table.shape[1]), node[table])).ravel()
    return whole


def _obstacles(
    solution: Solution, points: Array, moved: Array, focus: Array, zoom: float
) -> dict[str, Array]:
    """Return the distances of obstacles on a grid around what is seen, and its corners."""
    gdim = solution.decomposition.mesh.geometry.dim
    both = np.vstack((points, points + np.nan_to_num(moved)))
    low, high = both.min(axis=0), both.max(axis=0)
    margin = MARGIN * float((high - low).max())
    box = np.stack((low, high)) + np.array([[-margin], [margin]])
    if np.all(np.isfinite(focus)):
        centre, seen = np.clip(focus, *box), float(np.linalg.norm(high - low)) / zoom
        box = np.clip(box, centre - seen, centre + seen)
    box[:, gdim:] = low[gdim:]
    axes = [np.linspace(start, stop, SAMPLES[gdim]) for start, stop in box.T[:gdim]]
    axes += [low[gdim:]] * (3 - gdim)
    grid = np.meshgrid(*axes, indexing="ij")
    x = np.stack([coordinate.ravel() for coordinate in grid])
    poses = {i: tool for tool in solution.tool_motions for i in tool.contacts}
    found: dict[str, Array] = {"box": box}
    for i, contact in enumerate(solution.contacts):
        if not isinstance(contact, Obstacle) or not isinstance(contact.gap, str):
            continue
        shape = contact.shape
        if isinstance(shape, RigidBody):
            shape = shape.placed(Pose(shape.centre(gdim), poses[i].motion, True))
        with named(f"distance of {contact.name} from points around the bodies"):
            distance = np.asarray(shape.distance(x), dtype=float)
        found[f"obstacle_{len(found) - 1}"] = distance.reshape(grid[0].shape)
    return found


def _draw(target: Path, data: dict[str, object]) -> None:
    """Let a process of its own draw; the picture appears whole."""
    with tempfile.TemporaryDirectory() as folder, written_whole(target) as partial:
        file = Path(folder) / "scene.npz"
        np.savez(file, **data)  # type: ignore[arg-type]
        command = [sys.executable, draw.__file__, str(file), str(partial)]
        result = subprocess.run(
            command, capture_output=True, text=True, timeout=SECONDS, check=False
        )
        if result.returncode != 0 or not partial.exists():
            if not os.environ.get("DISPLAY") and shutil.which("Xvfb") is None:
                raise InputError(
                    f"{target}: pictures by this VTK need an X server: set DISPLAY, or install "
                    "Xvfb (Debian: apt-get install xvfb) or VTK 9.5"
                )
            raise TfetiError(f"{target} could not be drawn:\n{result.stderr[-2000:]}")
