"""Boxes whose points are moved: layers of flat cells, slivers, arches."""

from __future__ import annotations

import numpy as np
from dolfinx import mesh as dmesh

from benchmarks.stress.scene import Scene


def bend(scene: Scene, mesh: dmesh.Mesh) -> None:
    """Move the points of a mesh of boxes as a scene says; the first body is what is moved."""
    if scene.bent is not None:
        kind, strength = scene.bent
        BENT[kind](scene, mesh, strength)


def _layers(scene: Scene, mesh: dmesh.Mesh, strength: float) -> None:
    """Layers of cells that are as much flatter at the lowest side as ``strength`` says."""
    box, up = scene.bodies[0], scene.gdim - 1
    low, high, n = box.low[up], box.high[up], box.cells[up]
    t = n * (mesh.geometry.x[:, up] - low) / (high - low)
    steps = strength ** (np.arange(n) / max(n - 1, 1))
    heights = np.concatenate(([0.0], np.cumsum(steps))) / steps.sum()
    mesh.geometry.x[:, up] = low + (high - low) * np.interp(t, np.arange(n + 1), heights)


def _slivers(scene: Scene, mesh: dmesh.Mesh, strength: float) -> None:
    """Every other inner point goes to the opposite facet of a cell of its, all but 1/strength."""
    box, x, gdim = scene.bodies[0], mesh.geometry.x, scene.gdim
    low, high, n = (np.array(v, dtype=float) for v in (box.low, box.high, box.cells))
    at = np.rint(n * (x[:, :gdim] - low) / (high - low))
    moved = np.all((at > 0) & (at < n), axis=1) & (at.sum(axis=1) % 2 == 0)
    # the middle of the other corners of the first cell of ``meshes.SPLIT``
    away = np.array([1.0, 0.5] if gdim == 2 else [1.0, 2 / 3, 1 / 3]) * (high - low) / n
    x[moved, :gdim] += (1.0 - 1.0 / strength) * away


def _arch(scene: Scene, mesh: dmesh.Mesh, strength: float) -> None:
    """The first axis becomes an arc of a circle of this radius, its middle at the bottom."""
    box, x, up = scene.bodies[0], mesh.geometry.x, scene.gdim - 1
    middle = 0.5 * (box.low[0] + box.high[0])
    angle = (x[:, 0] - middle) / strength
    height = x[:, up].copy()
    x[:, 0] = middle + (strength - height) * np.sin(angle)
    x[:, up] = strength - (strength - height) * np.cos(angle)


BENT = {"layers": _layers, "slivers": _slivers, "arch": _arch}
