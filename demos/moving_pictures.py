"""Films of moving bodies, seen from the side."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from dolfinx import mesh as dmesh

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.common.compat import geometry_dofmap


class Film:
    """Surfaces of the bodies in the x–z plane, coloured by von Mises stress. Collective.

    Args:
        problem: The problem, with a stress.
        height: What is shown is so high.
    """

    def __init__(self, problem: tfeti.ContactProblem, height: float) -> None:
        self._problem, self._height = problem, height
        decomposition = problem.decomposition
        mesh = decomposition.mesh
        surfaces = decomposition.names.surfaces
        facets = np.concatenate([decomposition.facets(name) for name in surfaces])
        mesh.topology.create_connectivity(2, 3)
        mesh.topology.create_connectivity(2, 0)
        self._triangles = dmesh.entities_to_geometry(mesh, 2, facets.astype(np.int32))
        self._frames: list[Any] = []

    def take(self, t: float) -> None:
        """Take a picture of the last solution."""
        solution = self._problem.solution
        x = self._problem.decomposition.mesh.geometry.x
        moved = x + self._at_points(solution.displacement, 3)
        stress = self._at_points(solution.nodal_von_mises, 1)[:, 0]
        own = (moved[self._triangles], stress[self._triangles].mean(axis=1))
        parts = self._problem.decomposition.comm.gather(own, root=0)
        if parts is not None:
            corners, values = (np.concatenate(p) for p in zip(*parts, strict=True))
            self._frames.append((t, corners, values))

    def _at_points(self, function: Any, size: int) -> Any:
        """Values at the points of the mesh, of a function of degree 1."""
        V = function.function_space
        values = np.zeros((len(V.mesh.geometry.x), size))
        nodal = function.x.array.reshape(-1, size)
        values[geometry_dofmap(V.mesh)] = nodal[np.asarray(V.dofmap.list)]
        return values

    def write(self, path: Path) -> None:
        """Write all pictures as one that moves, on rank 0."""
        if self._frames:
            images = [self._drawn(*frame) for frame in self._frames]
            path.parent.mkdir(parents=True, exist_ok=True)
            images[0].save(path, save_all=True, append_images=images[1:], duration=80, loop=0)

    def write_last(self, path: Path) -> None:
        """Write the last picture, on rank 0."""
        if self._frames:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._drawn(*self._frames[-1]).save(path)

    def _drawn(self, t: float, corners: Any, values: Any) -> Any:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.collections import PolyCollection
        from matplotlib.figure import Figure
        from PIL import Image

        highest = 0.3 * max(frame[2].max() for frame in self._frames)
        figure = Figure(figsize=(3.6, 5.4), dpi=80, layout="constrained")
        picture = figure.subplots()
        towards = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        light = np.abs(towards @ [0.3, -0.8, 0.5]) / np.linalg.norm(towards, axis=1)
        seen = np.argsort(-corners[:, :, 1].mean(axis=1))
        faces = PolyCollection(corners[seen][:, :, [0, 2]], antialiased=False)
        colours = _colours(values[seen] / highest)
        colours[:, :3] *= 0.35 + 0.65 * light[seen, None]
        faces.set_facecolor(colours)
        picture.add_collection(faces)
        picture.axhline(0.0, color="black")
        picture.set_xlim(-1.6, 1.9)
        picture.set_ylim(-0.2, self._height + 0.1)
        picture.set_aspect("equal")
        picture.set_title(f"t = {t:.3f}", fontsize="small")
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        image = Image.fromarray(np.asarray(canvas.buffer_rgba())[:, :, :3])
        return image.convert("P", palette=Image.Palette.ADAPTIVE, colors=128)


def _colours(shares: Any) -> Any:
    from matplotlib import colormaps

    return colormaps["viridis"](np.clip(0.25 + 0.75 * shares, 0.0, 1.0))
