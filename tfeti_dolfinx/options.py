"""Options: all solvers, one typed dataclass, its table, and what a command line says of it."""

import difflib
import math
import re
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np
from petsc4py import PETSc

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.validation import (
    FROM_0,
    FROM_1,
    Parameter,
    Range,
    checked_type,
    described,
    from_names,
    parameters_of,
    shown,
)
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.feti.operator import PRECONDITIONERS
from tfeti_dolfinx.qp.krylov import PcpgParameters, solve_by_pcpg
from tfeti_dolfinx.qp.newton import NewtonParameters, feasible_start, first_point, newton
from tfeti_dolfinx.qp.problem import QP, QPResult
from tfeti_dolfinx.qp.smalse import SmalseParameters, smalse
from tfeti_dolfinx.subdomains.factor import default_solver, has_solver, unread_options
from tfeti_dolfinx.subdomains.local_operators import LOCAL_TYPES

# --- Solvers of the dual problem --------------------------------------------------------------


@dataclass(frozen=True)
class Solver:
    """QP solver, with its requirements."""

    # solves a program from a start, with a stopping rule and parameters, those of options with its
    # name; by name `max_it` and `monitor`, as `newton` does
    solve: Callable[..., QPResult]
    keeps_sets: bool  # whether it keeps inequalities and friction
    pc_type: str  # preconditioner that `auto` stands for
    relative_to_norm: bool  # whether its steps are relative to ‖PFP‖
    # where it starts, which is its λ̄; None: λ̄₀ = Gᵀ(GGᵀ)⁻¹e
    cold: Callable[[QP], Array] | None = None
    # from an earlier λ to λ̄; None: λ̄ is as without one
    warm: Callable[[QP, Array], Array] | None = None


SOLVERS = {
    "pcpg": Solver(
        solve_by_pcpg,
        keeps_sets=False,
        pc_type="auto",
        relative_to_norm=False,
        # the nearest solution of Gλ̄ = e: λ + Gᵀ(GGᵀ)⁻¹(e − Gλ)
        warm=lambda qp, lam: qp.coarse.project(lam) + qp.coarse.particular(),
    ),
    "smalse": Solver(smalse, keeps_sets=True, pc_type="none", relative_to_norm=True),
    "newton": Solver(
        newton,
        keeps_sets=True,
        pc_type="auto",
        relative_to_norm=False,
        cold=first_point,
        warm=feasible_start,
    ),
}
# what auto stands for, without and with inequalities
AUTO = {False: "pcpg", True: "newton"}

# --- Options ----------------------------------------------------------------------------------

# what ``auto`` asks of displacements, whatever the mesh is
LOOSEST = 1e-2

# mechanisms that are on by default, by the names that -tfeti_without takes
MECHANISMS = {
    "d_scaling": "constraints weighted by the diagonal of K, not by the number of copies",
    "smooth_displacements": "displacements with given jumps made smooth in the preconditioner",
    "soft_springs": "soft springs are taken out of the stiffness of subdomains",
    "kept_directions": "directions of PCPG conjugate to all before, not to the last one alone",
    "recycled_directions": "directions of earlier solves",
    "newton_on_coulomb": "Newton's method on Coulomb's law, before bounds as a fixed point",
    "late_schur": "steps of the lumped preconditioner, where subdomains are large, until S pays",
    "foundation": "a first point of rigid bodies on springs, not the lightest forces that balance",
    "mixed_precision": "factors of large subdomains in space in single precision, with refinement",
    "cautious": "constraints leave one by one after steps that raised the energy or lost balance",
}
# those that an option of their own switches off
SWITCHES: dict[str, dict[str, Any]] = {
    "d_scaling": {"scaling": "multiplicity"},
    "recycled_directions": {"recycle": 0},
    "newton_on_coulomb": {"friction_type": "fixed_point"},
}


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
        "stop when the displacement of each body is accurate to this, in the maximum norm; auto: "
        "to 1e-2, and when the algebraic error in energy is a tenth of the discretisation error",
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
        "preconditioner, on the active set; auto takes dirichlet, after steps of "
        "lumped where subdomains are large, and none with smalse",
        choices=("none", *PRECONDITIONERS),
    )
    scaling: str = described(
        "stiffness",
        "all",
        "weights of the constraints: the diagonal of K, which suits graded meshes and jumps of "
        "stiffness, or one per torn copy",
        choices=("stiffness", "multiplicity"),
    )
    local_type: str = described(
        "auto",
        "subdomains",
        "how K⁺ and S of the subdomains are applied: through sparse factors, by a dense matrix for "
        "each, or by one factor or matrix for all that are equal; auto counts operations",
        choices=LOCAL_TYPES,
    )
    local_multiplications: int = described(
        50,
        "subdomains",
        "iterations to expect, for that count; a fifth of it for a tangent of nonlinear bodies",
        fits=FROM_0,
    )
    clusters: int = described(
        0,
        "subdomains",
        "number of clusters of subdomains (hybrid TFETI): a smaller coarse problem, for very "
        "many subdomains; 0: none",
        fits=FROM_0,
    )
    recycle: int | str = described(
        "auto",
        "pcpg, newton",
        "most search directions kept between solves with the same stiffness (Krylov recycling), "
        "two vectors each; 0: none; auto: 200 from the second solve on",
        fits=FROM_0,
        words=("auto",),
        kind=int,
    )
    norm_steps: int = described(15, "smalse", "Lanczos steps that estimate ‖PFP‖", fits=FROM_1)
    friction_type: str = described(
        "auto",
        "coulomb",
        "Newton's method on Coulomb's law itself, problems with Tresca's bounds where it fails; or "
        "these alone, as a fixed point; auto takes newton with that as qp_type, else fixed_point",
        choices=("auto", "newton", "fixed_point"),
    )
    friction_rtol: float = described(
        1e-4,
        "coulomb",
        "relative change of the friction bounds at which their iteration stops; or 100 rtol, if "
        "that is less",
        fits=Range("0 or more, less than 1", lambda value: 0.0 <= value < 1.0),
    )
    friction_max_it: int = described(
        50,
        "coulomb",
        "most problems with Tresca's bounds that are solved for Coulomb's law",
        fits=FROM_1,
    )
    pcpg: PcpgParameters = PcpgParameters()
    newton: NewtonParameters = NewtonParameters()
    smalse: SmalseParameters = SmalseParameters()
    without: tuple[str, ...] = described(
        (),
        "all",
        "switch off named mechanisms, to measure what each is worth; names apart by commas",
        choices=tuple(MECHANISMS),
    )
    error_if_not_converged: bool = described(
        True, "all", "raise ConvergenceError where a solver stops before its tolerance"
    )
    warnings: bool = described(
        True, "all", "check after each solve what makes its answer less sure, for the report"
    )
    monitor: bool = described(False, "all", "print a line per step")
    converged_reason: bool = described(False, "all", "print why the solver stopped")
    view: bool = described(False, "all", "print the options, the sizes and the report")

    @property
    def number(self) -> float:
        """rtol as a number, how accurate displacements have to be."""
        return LOOSEST if isinstance(self.rtol, str) else self.rtol

    def view_text(self, prefix: str) -> str:
        """One line per option."""
        values = [(o.name, reduce(getattr, o.path, self)) for o in parameters_of(Options)]
        return "\n".join(f"-{prefix}{name} {value}" for name, value in values)


# --- Parsing of options -----------------------------------------------------------------------

# what factors of subdomains, the coarse problem and contact rows read from PETSc's options
FACTOR_OPTION = re.compile(r"(sub|coarse|face)_((?:pc_factor|mat)_\w+)")
# what is expected where another is given
OF_FACTORS = (
    "expected -{0}pc_factor_mat_solver_type, which chooses the package that makes them, or another "
    "-{0}pc_factor_... or -{0}mat_... that it reads; PETSc's -help lists them"
)
# words of switches
YES, NO = ("", "1", "true", "yes", "on"), ("0", "false", "no", "off")
# what solvers of PETSc are chosen by, and this one by -qp_type
TYPES = re.compile(r"(ksp|snes|tao|qp|qps|mat_solver)_type", re.IGNORECASE)


def parse_options(given: Mapping[str, Any] | None, prefix: str) -> Options:
    """Options from the command line, else from a dictionary, else the defaults.

    Names in the dictionary have the prefix or not. Raise an InputError where an option is unknown,
    its value does not fit, or the command line has options that PETSc was not given.
    """
    named = _without_prefix(given, prefix)
    database = PETSc.Options(prefix)
    named |= {name: database.getString(name, "") for name in database.getAll()}
    for word in sys.argv[1:]:
        if word.startswith(f"-{prefix}") and word.removeprefix(f"-{prefix}") not in named:
            raise InputError(
                f"{word} on the command line did not reach PETSc; call petsc4py.init(sys.argv) "
                "before dolfinx is imported"
            )
    if not named:
        return Options()
    known = {option.name: option for option in parameters_of(Options)}
    for name in named:
        if name not in known and not FACTOR_OPTION.fullmatch(name):
            raise InputError(f"unknown option -{prefix}{name}; {_expected(name, known, prefix)}")
    _check_factors_read(named, prefix)
    values = {n: _converted(known[n], v, prefix) for n, v in named.items() if n in known}
    for name in values.get("without", ()):
        values |= SWITCHES.get(name, {})
    options: Options = from_names(Options, values)
    return options


def factor_options(given: Mapping[str, Any] | None, prefix: str) -> dict[str, Any]:
    """Those options of a dictionary that PETSc itself reads, without the prefix."""
    named = _without_prefix(given, prefix)
    return {name: value for name, value in named.items() if FACTOR_OPTION.fullmatch(name)}


def _expected(name: str, known: Mapping[str, Parameter], prefix: str) -> str:
    """Say what option an unknown name may be meant for; of all of them where none is near."""
    if TYPES.fullmatch(name):
        choices = ", ".join(known["qp_type"].description.choices)
        return (
            f"expected -{prefix}qp_type, which chooses what solves the dual problem: one of "
            f"{choices}"
        )
    if family := re.match(r"(sub|coarse|face)_", name):
        own = f"{prefix}{family[0]}"
        return f"factors are always Cholesky's; {OF_FACTORS.format(own)}"
    low = name.lower()
    near = [o for o in known if o == low or low.endswith(f"_{o}") or o.startswith(f"{low}_")]
    alike = difflib.get_close_matches(low, known, cutoff=0.72)  # not those alike in _type alone
    near += [n for n in alike if n not in near]
    if near:
        return f"expected {_listed(near, prefix, ' or ')} perhaps; -{prefix}view prints all options"
    return f"expected one of {_listed(known, prefix, ', ')}"


def _listed(names: Iterable[str], prefix: str, separator: str) -> str:
    return separator.join(f"-{prefix}{name}" for name in names)


def _check_factors_read(named: Mapping[str, Any], prefix: str) -> None:
    """Raise if an option of factors is none that these factors read."""
    families: dict[str, dict[str, Any]] = {}
    for match in filter(None, map(FACTOR_OPTION.fullmatch, named)):
        families.setdefault(match[1], {})[match[2]] = named[match[0]]
    for family, given in families.items():
        chosen = given.get("pc_factor_mat_solver_type")
        solvers = [default_solver() if chosen is None else str(chosen)]
        if chosen is None and family != "sub" and has_solver("mumps"):
            solvers.append("mumps")  # where several ranks share one
        unread = [unread_options(given, solver) for solver in dict.fromkeys(solvers)]
        for name in (name for name in given if all(name in names for names in unread)):
            own, package = f"{prefix}{family}_", re.match(r"mat_(cholmod|mumps)_", name)
            hint = OF_FACTORS.format(own)
            if package and package[1] not in solvers:
                hint = f"expected -{own}pc_factor_mat_solver_type {package[1]} with it"
            makers = " or ".join(solvers)
            raise InputError(f"-{own}{name}: factors by {makers} read no such option; {hint}")


def _without_prefix(given: Any, prefix: str) -> dict[str, Any]:
    """Return the options given, without the prefix."""
    if not isinstance(prefix, str) or not re.fullmatch(r"\w+", prefix):
        raise InputError(
            f"petsc_options_prefix is {shown(prefix)}; expected letters, digits and underscores, "
            "such as 'tfeti_'"
        )
    if given is None:
        return {}
    checked_type(given, Mapping, "petsc_options", "a dictionary such as {'tfeti_rtol': 1e-8}")
    named: dict[str, Any] = {}
    for name, value in given.items():
        checked_type(name, str, f"petsc_options: the key {shown(name)}", "the name of an option")
        short = name.removeprefix("-").removeprefix(prefix)
        if short in named:
            raise InputError(f"petsc_options: -{prefix}{short} is there twice; expected it once")
        named[short] = value
    return named


def _converted(option: Parameter, value: Any, prefix: str) -> Any:
    """Return the value as the type of the option, in its range."""
    what = f"-{prefix}{option.name}"
    kind = option.description.kind or type(option.default)
    if isinstance(value, str) and value in option.description.words:
        return value
    try:
        result = _as_kind(kind, value)
    except (KeyError, TypeError, ValueError, OverflowError):
        words = "".join(f" or {word}" for word in option.description.words)
        raise InputError(
            f"{what} {shown(value)}: expected a value of type {kind.__name__}{words}"
        ) from None
    choices, fits = option.description.choices, option.description.fits
    unknown = [name for name in result if name not in choices] if kind is tuple else []
    if unknown:
        raise InputError(f"{what} {', '.join(unknown)}: expected some of {', '.join(choices)}")
    if choices and kind is not tuple and result not in choices:
        raise InputError(f"{what} {result}: expected one of {', '.join(choices)}")
    if kind in (int, float) and not (math.isfinite(result) and fits.holds(result)):
        raise InputError(f"{what} {result}: expected {fits.text}")
    return result


def _as_kind(kind: type, value: Any) -> Any:
    """Convert a value; raise a KeyError, TypeError or ValueError where it does not fit."""
    if kind is bool:
        word = "" if value is None else str(value).lower()
        return {**dict.fromkeys(YES, True), **dict.fromkeys(NO, False)}[word]
    if kind is tuple:
        parts = value.split(",") if isinstance(value, str) else value
        return tuple(dict.fromkeys(_as_kind(str, part).strip() for part in parts if part))
    text, number = isinstance(value, str), kind in (int, float)
    if isinstance(value, bool | np.bool_) or not (text or number):
        raise TypeError(value)
    if kind is int and not text and float(value) != int(value):
        raise ValueError(value)
    return kind(value)
