"""Pictures without a screen; only here, and in the process that draws, is a plotting library."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from dolfinx import plot as dplot

from tfeti_dolfinx import draw
from tfeti_dolfinx.common.agreement import agreeing
from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.validation import (
    FINITE,
    POSITIVE,
    checked_callable,
    checked_flag,
    checked_number,
    checked_path,
    checked_type,
    named,
    shown,
)
from tfeti_dolfinx.errors import InputError, TfetiError, raised_on_all_ranks
from tfeti_dolfinx.solution import Solution

SECONDS = 600


def plot_deformed(
    path: str | os.PathLike[str],
    solution: Solution,
    *,
    factor: float | None = None,
    zoom: float = 1.0,
    focus: tuple[float, float, float] | None = None,
    show_edges: bool = True,
    highest: float | None = None,
    view: tuple[float, float, float] | None = None,
    cut: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None,
) -> Path:
    """Picture of the deformed bodies, coloured by von Mises stress. Collective.

    Rank 0 draws; the cells of all ranks travel there.

    Args:
        path: The ``.png`` to write.
        solution: A solution of a problem with a stress.
        factor: Displacements are drawn times this; default 1 where there are contacts (bodies
            would seem to enter each other), else such that the largest is 5 % of the scene.
        zoom: Camera zoom.
        focus: Point that the camera looks at.
        show_edges: Whether to draw cell edges.
        highest: Stress of the brightest colour; default the largest in the scene.
        view: Direction from the scene to the camera, z upwards; default pyvista's.
        cut: A point and a normal: what lies beyond that plane, before it moved, is cut away.

    Returns:
        The file written.

    Raises:
        InputError: There is no X server and no Xvfb to start one, the problem has no stress, or
            an argument does not fit.
        TfetiError: The picture could not be drawn.
    """
    checked_type(solution, Solution, "solution", "the solution of a ContactProblem")
    comm = solution.decomposition.comm
    with agreeing(comm, "plot_deformed") as given:
        target = checked_path(path, ".png")
        scene = {
            "factor": np.nan if factor is None else checked_number(factor, "factor", FINITE),
            "zoom": checked_number(zoom, "zoom", POSITIVE),
            "focus": _vector(focus, "focus"),
            "edges": checked_flag(show_edges, "show_edges"),
            "highest": np.nan if highest is None else checked_number(highest, "highest", POSITIVE),
            "view": _vector(view, "view"),
            "cut": _pair(cut),
        }
        given |= {"path": path, **scene}
    if factor is None and solution.has_contact:
        scene["factor"] = 1.0
    parts = comm.gather(_grid(solution, solution.nodal_von_mises.x.array), root=0)
    with raised_on_all_ranks(comm), named(f"cannot write {target}", OSError):
        if comm.rank == 0 and parts is not None:
            check_screen()
            _draw(target, {**_joined(parts), **scene, "name": "von Mises"})
    return target


def plot_pressure(
    path: str | os.PathLike[str],
    solution: Solution,
    coordinate: Callable[[Array], Array],
    closed_form: Callable[[Array], Array] | None = None,
    *,
    contact: int = 0,
    limit: float | None = None,
    label: str = "x",
) -> Path:
    """Contact pressure over a coordinate, with a closed form if there is one. Collective.

    Args:
        path: The ``.png`` to write.
        solution: The solution.
        coordinate: From points of shape ``(n, 3)`` to the coordinate, shape ``(n,)``.
        closed_form: Pressure at given coordinates.
        contact: Index of the contact.
        limit: Largest coordinate shown, in magnitude.
        label: Name of the coordinate.

    Returns:
        The file written.

    Raises:
        InputError: An argument does not fit, or a callable fails.
    """
    checked_type(solution, Solution, "solution", "the solution of a ContactProblem")
    comm = solution.decomposition.comm
    with agreeing(comm, "plot_pressure") as given:
        given |= {"path": path, "contact": contact, "closed_form": closed_form, "limit": limit}
        given |= {"coordinate": coordinate, "label": label}
        target = checked_path(path, ".png")
        checked_callable(coordinate, "coordinate", "a callable of points of shape (n, 3)")
        if closed_form is not None:
            checked_callable(closed_form, "closed_form", "a callable of coordinates of shape (n,)")
        if limit is not None:
            checked_number(limit, "limit", POSITIVE)
    data = solution.contact(contact)
    with raised_on_all_ranks(comm):
        x = _coordinates(coordinate, data.points)
    parts = comm.gather((x, data.pressure), root=0)
    with raised_on_all_ranks(comm), named(f"cannot write {target}"):
        if comm.rank == 0 and parts is not None:
            x, p = (np.concatenate(rows) for rows in zip(*parts, strict=True))
            _draw_curve(target, x, p, closed_form, limit, label)
    return target


def check_screen() -> None:
    """Raise an InputError, with what to install, where pictures find no X server and no Xvfb."""
    if not os.environ.get("DISPLAY") and shutil.which("Xvfb") is None:
        raise InputError(
            "pictures need an X server: set DISPLAY, or install Xvfb (Debian: apt-get install xvfb)"
        )


def _coordinates(coordinate: Callable[[Array], Array], points: Array) -> Array:
    """Return the coordinate of each point."""
    with named(f"coordinate of points of shape {points.shape}"):
        x = np.asarray(coordinate(points), dtype=float)
    if x.shape != (len(points),):
        raise InputError(
            f"coordinate of points of shape {points.shape} has the shape {x.shape}; expected "
            f"({len(points)},)"
        )
    return x


def _vector(values: tuple[float, float, float] | None, what: str) -> Array:
    """Three numbers, nan if they are not given."""
    if values is None:
        return np.full(3, np.nan)
    with named(f"{what}={shown(values)}, expected three finite numbers"):
        vector = np.array(values, dtype=float)
    if vector.shape != (3,) or not np.all(np.isfinite(vector)):
        raise InputError(f"{what}={shown(values)}: expected three finite numbers")
    return vector


def _pair(cut: Any) -> Array:
    """Return a point and a normal, nan if they are not given."""
    if cut is None:
        cut = None, None
    if not isinstance(cut, (tuple, list, np.ndarray)) or len(cut) != 2:
        raise InputError(f"cut={shown(cut)}: expected a point and a normal")
    return np.stack([_vector(values, "cut") for values in cut])


def _grid(solution: Solution, values: Array) -> tuple[Array, Array, Array, Array, Array]:
    """Return cells, types, points, displacements and values of this rank."""
    u = solution.displacement
    if len(u.x.array) == 0:
        empty = np.zeros((0, 3))
        return np.zeros(0, np.int32), np.zeros(0, np.uint8), empty, empty, np.zeros(0)
    cells, types, points = dplot.vtk_mesh(u.function_space)
    moved = np.zeros_like(points)
    bs = u.function_space.dofmap.index_map_bs
    moved[:, :bs] = u.x.array.reshape(-1, bs)
    return cells, types, points, moved, values


def _joined(parts: list[tuple[Array, ...]]) -> dict[str, Array]:
    """One grid of the ranks' grids; VTK's cells are (count, nodes …) in one array."""
    starts = np.cumsum([0, *(len(points) for _, _, points, _, _ in parts)])
    shifted = []
    for (cells, types, *_), start in zip(parts, starts, strict=False):
        table = np.array(cells).reshape(len(types), -1) if len(types) else np.zeros((0, 1), int)
        table[:, 1:] += start
        shifted.append(table.ravel())
    types, points, moved, values = (
        np.concatenate(rows) for rows in list(zip(*parts, strict=True))[1:]
    )
    cells = np.concatenate(shifted)
    return {"cells": cells, "types": types, "points": points, "moved": moved, "values": values}


def _draw(target: Path, data: dict[str, object]) -> None:
    """Let a process of its own draw; the picture appears whole."""
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = target.with_name(f".partial-{target.name}")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "scene.npz"
        np.savez(file, **data)  # type: ignore[arg-type]
        command = [sys.executable, draw.__file__, str(file), str(partial)]
        result = subprocess.run(
            command, capture_output=True, text=True, timeout=SECONDS, check=False
        )
    if result.returncode != 0 or not partial.exists():
        raise TfetiError(f"{target} could not be drawn:\n{result.stderr[-2000:]}")
    os.replace(partial, target)


def _draw_curve(
    target: Path,
    x: Array,
    p: Array,
    closed_form: Callable[[Array], Array] | None,
    limit: float | None,
    label: str,
) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    shown = np.abs(x) <= (limit if limit is not None else np.abs(x).max(initial=0.0))
    order = np.argsort(x[shown])
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes = figure.subplots()
    axes.plot(x[shown][order], p[shown][order], "o", markersize=3, label="TFETI")
    if closed_form is not None:
        fine = np.linspace(x[shown].min(), x[shown].max(), 801)
        axes.plot(fine, closed_form(fine), "-", linewidth=1, label="closed form")
    axes.set_xlabel(label)
    axes.set_ylabel("contact pressure")
    axes.legend()
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = target.with_name(f".partial-{target.name}")
    FigureCanvasAgg(figure).print_png(str(partial))
    os.replace(partial, target)
