"""What the mesh scripts share."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

import gmsh


def started_model(name: str) -> Any:
    """An empty gmsh model of that name, gmsh started quietly if it is not running."""
    if not gmsh.isInitialized():
        gmsh.initialize(interruptible=False)
    gmsh.option.setNumber("General.Terminal", 0)
    gmsh.model.add(name)
    return gmsh.model


def graded_size(
    centre: tuple[float, float, float], fine: float, fine_radius: float, growth: float
) -> None:
    """Let the element size be ``fine`` near a point and grow linearly beyond ``fine_radius``."""
    x, y, z = centre
    distance = f"sqrt((x-({x}))^2+(y-({y}))^2+(z-({z}))^2)"
    field = gmsh.model.mesh.field.add("MathEval")
    excess = f"0.5*({distance}-{fine_radius}+fabs({distance}-{fine_radius}))"
    gmsh.model.mesh.field.setString(field, "F", f"{fine}+{growth}*{excess}")
    gmsh.model.mesh.field.setAsBackgroundMesh(field)
    for name in ("FromPoints", "FromCurvature", "ExtendFromBoundary"):
        gmsh.option.setNumber(f"Mesh.MeshSize{name}", 0)


def partition(partitions: int) -> None:
    """Let gmsh partition the mesh with METIS, if a number is given."""
    if partitions > 1:
        gmsh.model.mesh.partition(partitions)


def script(description: str | None, build: Callable[..., Any]) -> None:
    """Command line of a mesh script: the file to write, and the number of partitions."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("output", help="the .msh file to write")
    parser.add_argument("--partitions", type=int, default=0)
    arguments = parser.parse_args()
    build(partitions=arguments.partitions)
    gmsh.write(arguments.output)
    gmsh.finalize()
