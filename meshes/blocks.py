"""Blocks piled up, each with its own mesh of hexahedra."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from meshes.tools import started_model

CLOSE = 1e-9


@dataclass(frozen=True)
class Block:
    """A box."""

    name: str  # its name, a prefix of the names of its sides
    low: tuple[float, float, float]  # lowest corner
    size: tuple[float, float, float]  # edge lengths
    cells: tuple[int, int, int]  # hexahedra along the edges


def build(blocks: Sequence[Block]) -> Any:
    """Mesh blocks on this rank and return gmsh's model.

    Physical groups: the volumes are named as the blocks, the surfaces "<block> bottom" and
    "<block> top".

    Args:
        blocks: The blocks; those that touch share no node.
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
