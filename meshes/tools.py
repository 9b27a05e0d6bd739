"""What the mesh scripts share."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import gmsh

# gmsh's own: where the sizes of elements come from
SIZES_FROM = {"FromPoints": 1, "FromCurvature": 0, "ExtendFromBoundary": 1}


def started_model(name: str) -> Any:
    """An empty gmsh model of that name, gmsh started quietly if it is not running.

    Element sizes come from points and boundaries, as gmsh has it, whatever the last model had.
    """
    if not gmsh.isInitialized():
        gmsh.initialize(interruptible=False)
    gmsh.option.setNumber("General.Terminal", 0)
    for name, value in SIZES_FROM.items():
        gmsh.option.setNumber(f"Mesh.MeshSize{name}", value)
    gmsh.model.add(name)
    return gmsh.model


def torn(comm: Any, build: Callable[[], Any], subdomains: int, order: int = 1) -> Any:
    """The torn mesh of a model that rank 0 builds, with cells of an order. Collective."""
    import tfeti_dolfinx as tfeti

    model = None
    if comm.rank == 0:
        with element_options(ElementOrder=order):
            model = build()
    d = tfeti.read_gmsh(model, comm, subdomains)
    if comm.rank == 0:
        gmsh.model.remove()
    return d


@contextmanager
def element_options(**options: float) -> Iterator[None]:
    """Options of gmsh's meshes, as ``ElementOrder=2`` or ``RecombineAll=1``, and then as before."""
    if not gmsh.isInitialized():
        gmsh.initialize(interruptible=False)
    before = {name: gmsh.option.getNumber(f"Mesh.{name}") for name in options}
    try:
        for name, value in options.items():
            gmsh.option.setNumber(f"Mesh.{name}", value)
        yield
    finally:
        for name, value in before.items():
            gmsh.option.setNumber(f"Mesh.{name}", value)


def graded_size(
    centre: tuple[float, float, float], fine: float, fine_radius: float, growth: float
) -> None:
    """Let the element size be ``fine`` near a point and grow linearly beyond ``fine_radius``."""
    use_sizes(graded_field(centre, fine, fine_radius, growth))


def graded_field(
    centre: tuple[float, float, float],
    fine: float,
    fine_radius: float,
    growth: float,
    body: tuple[int, list[int]] | None = None,
) -> int:
    """A gmsh field of that element size, in some entities (dimension, tags) only if given."""
    x, y, z = centre
    distance = f"sqrt((x-({x}))^2+(y-({y}))^2+(z-({z}))^2)"
    size = gmsh.model.mesh.field.add("MathEval")
    excess = f"0.5*({distance}-{fine_radius}+fabs({distance}-{fine_radius}))"
    gmsh.model.mesh.field.setString(size, "F", f"{fine}+{growth}*{excess}")
    if body is None:
        return int(size)
    part = gmsh.model.mesh.field.add("Restrict")
    gmsh.model.mesh.field.setNumber(part, "InField", size)
    gmsh.model.mesh.field.setNumbers(part, {2: "SurfacesList", 3: "VolumesList"}[body[0]], body[1])
    return int(part)


def use_sizes(*fields: int) -> None:
    """Let the least of some fields, and nothing else, decide the element size."""
    least = gmsh.model.mesh.field.add("Min")
    gmsh.model.mesh.field.setNumbers(least, "FieldsList", list(fields))
    gmsh.model.mesh.field.setAsBackgroundMesh(least)
    for name in SIZES_FROM:
        gmsh.option.setNumber(f"Mesh.MeshSize{name}", 0)


def add_mirror_image(model: Any, axis: int) -> dict[tuple[int, int], int]:
    """Add the mirror image of a mesh across the plane where a coordinate is 0, to the last node.

    Nodes on that plane become two: the image is a body of its own.

    Args:
        model: gmsh's model, meshed.
        axis: The coordinate that changes its sign.

    Returns:
        The image's tag of each entity, by dimension and tag.
    """
    mesh, images = model.mesh, {}
    last_node, last_element = mesh.getMaxNodeTag(), mesh.getMaxElementTag()
    meshed = [
        (entity, mesh.getNodes(*entity)[:2], mesh.getElements(*entity))
        for entity in model.getEntities()
    ]
    for (dim, tag), (nodes, coordinates), _ in meshed:
        images[dim, tag] = image = model.addDiscreteEntity(dim)
        x = coordinates.reshape(-1, 3) * [-1.0 if k == axis else 1.0 for k in range(3)]
        mesh.addNodes(dim, image, nodes + last_node, x.ravel())
    for entity, _, (kinds, elements, corners) in meshed:
        for kind, tags, nodes in zip(kinds, elements, corners, strict=True):
            table = nodes.reshape(len(tags), -1) + last_node
            # the first two change places, so that cells stay right-handed
            order = [1, 0, *range(2, table.shape[1])] if entity[0] > 1 else slice(None)
            mesh.addElementsByType(
                images[entity], kind, tags + last_element, table[:, order].ravel()
            )
    return images
