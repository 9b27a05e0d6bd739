"""Multi-body elastic contact by Total FETI, as a FEniCSx application."""

from tfeti_dolfinx.contact.obstacle import Obstacle
from tfeti_dolfinx.contact.pair import Contact
from tfeti_dolfinx.contact.shapes import Cylinder, Plane, SignedDistance, Sphere
from tfeti_dolfinx.errors import (
    ConvergenceError,
    FactorError,
    InputError,
    NoSolutionError,
    TfetiError,
)
from tfeti_dolfinx.extensions import Extensions
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dolfinx_input import decompose
from tfeti_dolfinx.mesh.gmsh.reading import read_gmsh
from tfeti_dolfinx.options import Options
from tfeti_dolfinx.problem import ContactProblem
from tfeti_dolfinx.report import Report
from tfeti_dolfinx.solution import ContactStatus, Solution
from tfeti_dolfinx.version import __version__

__all__ = [
    "Contact",
    "ContactProblem",
    "ContactStatus",
    "ConvergenceError",
    "Cylinder",
    "Decomposition",
    "Extensions",
    "FactorError",
    "InputError",
    "NoSolutionError",
    "Obstacle",
    "Options",
    "Plane",
    "Report",
    "SignedDistance",
    "Solution",
    "Sphere",
    "TfetiError",
    "__version__",
    "decompose",
    "read_gmsh",
]
