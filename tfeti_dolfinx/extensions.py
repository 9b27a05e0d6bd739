"""How to solve: options, and parts that a program may bring itself."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from tfeti_dolfinx.dual.dual import FeasibleLaw, no_tension
from tfeti_dolfinx.dual.operator import MakePreconditioner
from tfeti_dolfinx.options import Options
from tfeti_dolfinx.qp.monitors import Monitor
from tfeti_dolfinx.subdomains.block import Block
from tfeti_dolfinx.subdomains.data import SubdomainData
from tfeti_dolfinx.subdomains.kplus import MakeInverse


@dataclass(frozen=True)
class Extensions:
    """What takes the place of the package's own parts; by default nothing does.

    Attributes:
        block: Makes the Block of a subdomain, say a class; ``BlockDefaults`` leaves four methods
            to write, ``check_kind_of_block`` tests it.
        kplus: Makes the generalised inverse of a subdomain, for ``SparseBlock``.
        preconditioner: Makes a preconditioner from B D⁻¹ and the subdomains, for solvers that
            take one.
        feasible_set: From B and c to the set of multipliers; ``check_feasible_set`` tests it.
        monitor: Called after each step of the solver.
    """

    block: Callable[[SubdomainData], Block] | None = None
    kplus: MakeInverse | None = None
    preconditioner: MakePreconditioner | None = None
    feasible_set: FeasibleLaw = no_tension
    monitor: Monitor | None = None


@dataclass(frozen=True)
class Settings:
    """How to solve.

    Attributes:
        options: Options.
        prefix: Prefix of all options.
        factor_options: Options that PETSc's factors read, without prefix.
        extensions: Parts that the program brings.
    """

    options: Options
    prefix: str
    factor_options: Mapping[str, Any]
    extensions: Extensions
