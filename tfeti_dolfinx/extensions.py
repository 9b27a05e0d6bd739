"""Parts of a solve that a program may bring itself, and optional ones of the package."""

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, fields
from importlib import import_module
from typing import Any

import numpy as np
from mpi4py import MPI

from tfeti_dolfinx.common.validation import checked_callable, checked_type, named, shown
from tfeti_dolfinx.constraints.rows import Constraints
from tfeti_dolfinx.errors import InputError, raised_on_all_ranks
from tfeti_dolfinx.feti.dual import FeasibleLaw, contact_set
from tfeti_dolfinx.feti.operator import MakePreconditioner
from tfeti_dolfinx.feti.preconditioner import MakeDeflation
from tfeti_dolfinx.feti.stopping import Accuracy, MakeRule
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.options import Options
from tfeti_dolfinx.qp.problem import Monitor
from tfeti_dolfinx.qp.sets import FeasibleSet, Status, face_at
from tfeti_dolfinx.subdomains.block import PROMISED, Block, SubdomainData
from tfeti_dolfinx.subdomains.kplus import MakeInverse
from tfeti_dolfinx.subdomains.subdomains import SubdomainMethod, Subdomains

# optional parts, which no other module imports: where they are, by name
PLUGINS = {
    "BoundaryElements": "tfeti_dolfinx.bem.boundary_elements:BoundaryElements",
    "Interior": "tfeti_dolfinx.bem.interior:Interior",
    "clusters": "tfeti_dolfinx.clusters:extension",
    "to_pyvista": "tfeti_dolfinx.io.plot:to_pyvista",
}


def plugin(name: str) -> Any:
    """Return an optional part, imported when it is first asked for."""
    module, _, attribute = PLUGINS[name].partition(":")
    return getattr(import_module(module), attribute)


MakeSubdomains = Callable[[TornDofs, Decomposition], Callable[..., Subdomains]]


@dataclass(frozen=True)
class Extensions:
    """Parts that take the place of the package's own; by default none.

    Attributes:
        block: Makes the Block of a subdomain, say a class; ``Block`` leaves four methods to
            write, ``check_kind_of_block`` tests it.
        kplus: Makes the generalised inverse of a subdomain, for ``SparseBlock``.
        subdomains: From dof maps and the torn mesh to what makes all Blocks of a rank one, with
            the arguments of ``Subdomains``.
        preconditioner: Makes a preconditioner from B D⁻¹ and the subdomains, for solvers that
            take one.
        deflation: Makes a coarse space of the preconditioner on active sets.
        feasible_set: From B and c to the set of multipliers, asked before each run of the solver;
            ``check_feasible_set`` tests it.
        stopping: Makes the stopping rule of a solve, say a class derived from ``Accuracy`` that
            overrides ``criteria``.
        monitor: Called after each step of the solver.

    Raises:
        InputError: One of them cannot be called, or a K⁺ is given that the Block would not use.
    """

    block: Callable[[SubdomainData], Block] | None = None
    kplus: MakeInverse | None = None
    subdomains: MakeSubdomains | None = None
    preconditioner: MakePreconditioner | None = None
    deflation: MakeDeflation | None = None
    feasible_set: FeasibleLaw = contact_set
    stopping: MakeRule = Accuracy
    monitor: Monitor | None = None

    def __post_init__(self) -> None:
        for field in fields(self):
            if (given := getattr(self, field.name)) is not field.default:
                checked_callable(given, f"extensions: {field.name}", "a callable")
        if self.block is not None and self.kplus is not None:
            raise InputError(
                "extensions: kplus is given, but only the package's own Block takes it; expected "
                "block or kplus"
            )


def guarded(own: Extensions, options: Options, comm: MPI.Intracomm) -> Extensions:
    """Return the parts of a solve; what fails is named, on all ranks where they run on all.

    Blocks and K⁺ are made where ranks raise together. Clusters are parts of the package's own.
    """
    if options.clusters and (own.subdomains is not None or own.deflation is not None):
        raise InputError(
            "extensions: subdomains or deflation are given, and clusters, which take their "
            "place; expected one of them"
        )
    parts = {f.name: getattr(own, f.name) for f in fields(own)}
    if own.feasible_set is not contact_set:
        parts["feasible_set"] = _on_all_rows(own.feasible_set)
    for name, part in parts.items():
        if part not in (None, contact_set, Accuracy):
            parts[name] = _guarded(part, name, None if name in ("block", "kplus") else comm)
    if options.clusters:
        parts |= plugin("clusters")(options.clusters)
    return Extensions(**parts)


def check_method(method: Any, own: Extensions) -> None:
    """Raise an InputError unless it is a method, and there is no Block of the program's own."""
    expected = 'tfeti_dolfinx.BoundaryElements, say BoundaryElements("ball")'
    checked_type(method, SubdomainMethod, "boundary_elements", expected)
    if own.block is not None:
        raise InputError("boundary_elements: extensions have a block, too; expected one of them")


# what must be there of what a part gives
GIVES = {
    "block": ("Block", PROMISED),
    "kplus": ("GeneralisedInverse", ("solve",)),
    "feasible_set": ("FeasibleSet", [name for name in dir(FeasibleSet) if name[0] != "_"]),
    "stopping": ("rule derived from Accuracy", [n for n in dir(Accuracy) if n[0] != "_"]),
}


def _guarded(part: Callable[..., Any], name: str, comm: MPI.Intracomm | None) -> Any:
    """Return a part whose errors become an InputError, of all ranks if it runs on all of them."""
    kind, members = GIVES.get(name, ("", ()))

    def call(*given: Any) -> Any:
        together = nullcontext() if comm is None else raised_on_all_ranks(comm)
        with together, named(f"extensions: {name}"):
            made = part(*given)
            if missing := [member for member in sorted(members) if not hasattr(made, member)]:
                raise InputError(
                    f"extensions: {name} gave {shown(made)} without {', '.join(missing)}; "
                    f"expected a {kind}"
                )
            return made

    return call


def _on_all_rows(law: FeasibleLaw) -> FeasibleLaw:
    """Return a law whose sets are of multipliers on all rows."""

    def checked(constraints: Constraints) -> FeasibleSet:
        made, zero = law(constraints), np.zeros(constraints.num_rows)
        if not (hasattr(made, "project") and hasattr(made, "face")):
            return made  # what lacks a part is named by all ranks
        if (projected := np.shape(made.project(zero))) != zero.shape:
            raise InputError(
                f"extensions: feasible_set projects vectors of shape {zero.shape} to {projected}; "
                "expected a set on all constraints of this rank, say a Product of sets on "
                "constraints.sets.normals"
            )
        face = face_at(made, made.project(zero), zero)
        if Status.FREE in face.status[constraints.sets.tangents]:
            raise InputError(
                "extensions: feasible_set leaves multipliers of friction free, which glues; "
                "expected a set on constraints.sets.tangents, say Ellipses(constraints.limits)"
            )
        return made

    return checked
