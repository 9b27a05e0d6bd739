"""Blocks piled up, each with its own mesh of hexahedra.

python3 meshes/blocks.py blocks.msh --partitions 16
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from meshes.tools import partition, script, started_model

CLOSE = 1e-9


@dataclass(frozen=True)
class Block:
    """A box.

    Attributes:
        name: Its name, a prefix of the names of its sides.
        low: Lowest corner.
        size: Edge lengths.
        cells: Hexahedra along the edges.
    """

    name: str
    low: tuple[float, float, float]
    size: tuple[float, float, float]
    cells: tuple[int, int, int]


def build(blocks: Sequence[Block], partitions: int = 0) -> Any:
    """Mesh blocks on this rank and return gmsh's model.

    Physical groups: the volumes are named as the blocks, the surfaces "<block> bottom" and
    "<block> top".

    Args:
        blocks: The blocks; those that touch share no node.
        partitions: Number of gmsh's partitions, 0 for none.
    """
    model = started_model("blocks")
    for block in blocks:
        volume = model.occ.addBox(*block.low, *block.size)
        model.occ.synchronize()
        faces = [tag for _, tag in model.getBoundary([(3, volume)], oriented=False)]
        _structure(model, volume, faces, block)
        model.addPhysicalGroup(3, [volume], name=block.name)
        heights = {tag: model.occ.getCenterOfMass(2, tag)[2] for tag in faces}
        for side, height in (("bottom", block.low[2]), ("top", block.low[2] + block.size[2])):
            level = [tag for tag in faces if abs(heights[tag] - height) < CLOSE]
            model.addPhysicalGroup(2, level, name=f"{block.name} {side}")
    model.mesh.generate(3)
    partition(partitions)
    return model


def _structure(model: Any, volume: int, faces: list[int], block: Block) -> None:
    """Hexahedra on a grid."""
    for face in faces:
        for _, edge in model.getBoundary([(2, face)], oriented=False):
            low, high = (model.getBoundingBox(1, edge)[i : i + 3] for i in (0, 3))
            lengths = [b - a for a, b in zip(low, high, strict=True)]
            cells = block.cells[lengths.index(max(lengths))]
            model.mesh.setTransfiniteCurve(edge, cells + 1)
        model.mesh.setTransfiniteSurface(face)
        model.mesh.setRecombine(2, face)
    model.mesh.setTransfiniteVolume(volume)


def tower(cells: int = 4) -> list[Block]:
    """Four blocks: a base, two on it side by side, and one across these."""
    n = cells
    return [
        Block("base", (0.0, 0.0, 0.0), (2.0, 1.0, 0.5), (2 * n, n, n // 2)),
        Block("left", (0.1, 0.1, 0.5), (0.7, 0.8, 0.8), (n, n + 1, n)),
        Block("right", (1.2, 0.1, 0.5), (0.7, 0.8, 0.8), (n - 1, n - 1, n - 1)),
        Block("beam", (0.0, 0.2, 1.3), (2.0, 0.6, 0.4), (3 * n, n, n // 2)),
    ]


if __name__ == "__main__":
    script(__doc__, lambda partitions: build(tower(), partitions))
