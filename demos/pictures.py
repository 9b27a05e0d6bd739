"""Pictures of friction that the demos share."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

import tfeti_dolfinx as tfeti

COLOURS = {
    tfeti.ContactStatus.OPEN: ("open", "lightgrey"),
    tfeti.ContactStatus.SLIP: ("slip", "tab:orange"),
    tfeti.ContactStatus.STICK: ("stick", "tab:blue"),
}


def plot_friction(
    path: Path,
    solution: tfeti.Solution,
    contacts: list[str],
    *,
    axes: tuple[int, int] = (0, 1),
    labels: tuple[str, str] = ("x", "y"),
    normal: bool = False,
) -> None:
    """Contact nodes coloured by status, with arrows of their tractions. Collective.

    Args:
        path: The ``.png`` to write, by rank 0.
        solution: A solution with friction.
        contacts: Names of contacts.
        axes: The coordinates to look at.
        labels: Their names.
        normal: Whether arrows have the pressure as well as the friction.
    """
    data = [solution.contact(name) for name in contacts]
    gdim = data[0].normal.shape[1]
    points = np.concatenate([d.points[:, :gdim] for d in data])
    traction = [d.tangential_traction - normal * d.pressure[:, None] * d.normal for d in data]
    status = np.concatenate([d.status for d in data])
    parts = solution.decomposition.comm.gather((points, np.concatenate(traction), status), root=0)
    if parts is None:
        return
    points, arrows, status = (np.concatenate(rows) for rows in zip(*parts, strict=True))
    _draw(path, points[:, axes], arrows[:, axes], status, labels)


def _draw(path: Path, x: Any, arrows: Any, status: Any, labels: tuple[str, str]) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 5), layout="constrained")
    picture = figure.subplots()
    largest = np.quantile(np.linalg.norm(arrows, axis=1), 0.95)  # corners stand out
    size = np.linalg.norm(np.ptp(x, axis=0))
    picture.quiver(
        *x.T, *arrows.T, angles="xy", scale_units="xy", scale=14.0 * largest / size, width=0.0015
    )
    for value, (name, colour) in COLOURS.items():
        at = status == value
        picture.plot(*x[at].T, "o", markersize=3, color=colour, label=f"{name}: {at.sum()}")
    picture.set_aspect("equal")
    picture.set_xlabel(labels[0])
    picture.set_ylabel(labels[1])
    picture.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".partial-{path.name}")
    FigureCanvasAgg(figure).print_png(str(partial))
    os.replace(partial, path)
