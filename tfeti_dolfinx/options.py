"""Options: one typed dataclass from which parsing, ``view`` and docs/options.md are made."""

from __future__ import annotations

from dataclasses import dataclass

from tfeti_dolfinx.checks import Range
from tfeti_dolfinx.described import FROM_0, FROM_1, described, parameters_of
from tfeti_dolfinx.dual.operator import PRECONDITIONERS
from tfeti_dolfinx.dual.particular import PARTICULAR
from tfeti_dolfinx.qp.parameters import NewtonParameters, SmalseParameters
from tfeti_dolfinx.qp.solvers import SOLVERS
from tfeti_dolfinx.subdomains.kplus import KPLUS_TYPES
from tfeti_dolfinx.subdomains.local import LOCAL_TYPES

# what ``auto`` asks of displacements, whatever the mesh is
LOOSEST = 1e-2
# ρ of the stiffening that ``auto`` takes
PENALTY = 10.0


@dataclass(frozen=True)
class Options:
    """All options; on the command line each has the prefix ``-tfeti_``."""

    qp_type: str = described(
        "auto",
        "all",
        "solver of the dual problem; auto takes pcpg without contact, else newton",
        choices=("auto", *SOLVERS),
    )
    rtol: float | str = described(
        1e-6,
        "all",
        "stop when the displacement of each body is right to this, in the maximum norm; auto: to "
        "1e-2, and when the algebraic error in energy is a tenth of the discretisation error",
        fits=Range("0 or more, less than 1", lambda value: 0.0 <= value < 1.0),
        words=("auto",),
    )
    atol: float = described(
        0.0, "all", "or when jumps and overlaps are below this length", fits=FROM_0
    )
    max_it: int = described(10_000, "all", "most inner steps, and most outer ones", fits=FROM_0)
    pc_type: str = described(
        "auto",
        "all",
        "preconditioner, with contact on the free rows alone; auto takes dirichlet, and none with "
        "smalse",
        choices=("auto", "none", *PRECONDITIONERS),
    )
    scaling: str = described(
        "stiffness",
        "all",
        "weights of the rows of B: the diagonal of K, which suits graded meshes and jumps of "
        "stiffness, or one per torn copy",
        choices=("stiffness", "multiplicity"),
    )
    kplus_type: str = described(
        "regularized",
        "subdomains",
        "generalised inverse of a subdomain: K made regular on fixing nodes, by the Schur "
        "complement on these, or by that on the last unknowns of an elimination",
        choices=tuple(KPLUS_TYPES),
    )
    local_type: str = described(
        "auto",
        "subdomains",
        "how K⁺ and S of the subdomains are applied: through sparse factors, by a dense matrix for "
        "each, or by one factor or matrix for all that are equal; auto takes what a model of "
        "the costs says",
        choices=LOCAL_TYPES,
    )
    local_multiplications: int = described(
        50, "subdomains", "multiplications that this model expects", fits=FROM_0
    )
    clusters: int = described(
        0,
        "subdomains",
        "about so many clusters, whose subdomains are glued by averages over their faces, so that "
        "the coarse problem has the motions of clusters only; 0: none",
        fits=FROM_0,
    )
    stiffening: float | str = described(
        "auto",
        "subdomains",
        "so many times its diagonal entry of K is added to K at a component that is prescribed as "
        "0 on a side of flat cells, beside its row, which leaves the solution as it is; 0: "
        "nothing; auto: 10, with smalse 0",
        fits=FROM_0,
        words=("auto",),
        kind=float,
    )
    recycle: int | str = described(
        "auto",
        "pcpg, newton",
        "so many directions of earlier solves with the same F are kept at most, which later ones "
        "begin with; each takes two dual vectors; auto: none of a first solve, 100 from the second "
        "on, or from Newton's method on Coulomb's law on; of bodies with mass 200",
        fits=FROM_0,
        words=("auto",),
        kind=int,
    )
    homogenization: str = described(
        "natural",
        "smalse",
        "λ̄ with Gλ̄ = e: natural is Gᵀ(GGᵀ)⁻¹e, feasible the smallest one with λ̄_N ≥ 0",
        choices=tuple(PARTICULAR),
    )
    norm_steps: int = described(15, "smalse", "Lanczos steps that estimate ‖PFP‖", fits=FROM_1)
    friction_type: str = described(
        "auto",
        "coulomb",
        "Newton's method on Coulomb's law itself, problems with given bounds where it fails; or "
        "these alone, as a fixed point; auto takes newton with that as qp_type, else fixed_point",
        choices=("auto", "newton", "fixed_point"),
    )
    friction_rtol: float = described(
        1e-4,
        "coulomb",
        "change of the bounds of Coulomb's friction, over their size, at which they are at rest; "
        "or 100 rtol, if that is less",
        fits=Range("0 or more, less than 1", lambda value: 0.0 <= value < 1.0),
    )
    friction_max_it: int = described(
        50, "coulomb", "most problems with given bounds that are solved for them", fits=FROM_1
    )
    newton: NewtonParameters = NewtonParameters()
    smalse: SmalseParameters = SmalseParameters()
    error_if_not_converged: bool = described(
        True, "all", "raise ConvergenceError where a solver stops before its tolerance"
    )
    spectrum: bool = described(
        False,
        "all",
        "put the extreme eigenvalues of B Bᵀ and B D⁻¹ Bᵀ into the report; needs slepc4py",
    )
    monitor: bool = described(False, "all", "print a line per step")
    converged_reason: bool = described(False, "all", "print why the solver stopped")
    view: bool = described(False, "all", "print the options, the sizes and the report")

    @property
    def number(self) -> float:
        """rtol as a number: what displacements have to be right to."""
        return LOOSEST if isinstance(self.rtol, str) else self.rtol

    @property
    def penalty(self) -> float:
        """ρ of the stiffening: without a preconditioner it would only spread eigenvalues of F."""
        if isinstance(self.stiffening, str):
            return 0.0 if self.qp_type == "smalse" else PENALTY
        return self.stiffening

    def view_text(self, prefix: str) -> str:
        """One line per option."""
        known = parameters_of(Options)
        return "\n".join(f"-{prefix}{option.name} {option.value_in(self)}" for option in known)


def options_table() -> str:
    """The table of docs/options.md."""
    lines = ["| option | algorithm | default | effect |", "|---|---|---|---|"]
    for option in parameters_of(Options):
        about, default = option.description, option.default
        known = (*about.choices, *(("a number", *about.words) if about.words else ()))
        values = " (" + ", ".join(known) + ")" if known else ""
        shown = str(default).lower() if isinstance(default, bool) else f"{default}"
        lines.append(
            f"| `-tfeti_{option.name}` | {about.algorithm} | {shown} | {about.text}{values} |"
        )
    return "\n".join(lines)
