"""Options: one typed dataclass from which parsing, ``view`` and docs/options.md are made."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import Field, dataclass, field, fields
from typing import Any

import numpy as np
from petsc4py import PETSc

from tfeti_dolfinx.checks import FINITE, Range, checked_type, shown
from tfeti_dolfinx.dual.operator import PRECONDITIONERS
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.qp.mprgp import EXPANSIONS
from tfeti_dolfinx.qp.smalse import SmalseParameters
from tfeti_dolfinx.subdomains.kplus import KPLUS_TYPES

_SMALSE = SmalseParameters()
# what the factors of the subdomains and of the coarse problem read from PETSc's options
FACTOR_OPTION = re.compile(r"(sub|coarse)_(pc_factor|mat)_\w+")


FROM_0 = Range("0 or more", lambda value: value >= 0.0)
FROM_1 = Range("1 or more", lambda value: value >= 1.0)
ABOVE_0 = Range("more than 0", lambda value: value > 0.0)


def _option(
    default: Any,
    algorithm: str,
    text: str,
    choices: tuple[str, ...] = (),
    fits: Range = FINITE,
) -> Any:
    metadata = {"algorithm": algorithm, "text": text, "choices": choices, "fits": fits}
    return field(default=default, metadata=metadata)


@dataclass(frozen=True)
class Options:
    """All options; on the command line each has the prefix ``-tfeti_``."""

    qp_type: str = _option(
        "auto",
        "all",
        "solver of the dual problem; auto takes pcpg without inequalities, else smalse",
        ("auto", "pcpg", "smalse"),
    )
    rtol: float = _option(
        1e-6,
        "all",
        "stop when the displacement of each body is right to this, in the maximum norm",
        fits=Range("0 or more, less than 1", lambda value: 0.0 <= value < 1.0),
    )
    atol: float = _option(
        0.0, "all", "or when jumps and overlaps are below this length", fits=FROM_0
    )
    max_it: int = _option(10_000, "all", "most inner steps, and most outer ones", fits=FROM_0)
    pc_type: str = _option(
        "auto",
        "pcpg",
        "preconditioner; auto takes dirichlet with pcpg and none with smalse, which takes no other",
        ("auto", "none", *PRECONDITIONERS),
    )
    scaling: str = _option(
        "stiffness",
        "all",
        "weights of the rows of B: the diagonal of K, which suits graded meshes and jumps of "
        "stiffness, or one per torn copy",
        ("stiffness", "multiplicity"),
    )
    kplus_type: str = _option(
        "regularized", "subdomains", "generalised inverse of a subdomain", tuple(KPLUS_TYPES)
    )
    homogenization: str = _option(
        "natural",
        "smalse",
        "λ̄ with Gλ̄ = e: natural is Gᵀ(GGᵀ)⁻¹e, feasible the smallest one with λ̄_N ≥ 0",
        ("natural", "feasible"),
    )
    norm_steps: int = _option(15, "smalse", "Lanczos steps that estimate ‖PFP‖", fits=FROM_1)
    smalse_rho: float = _option(_SMALSE.rho, "smalse", "penalty ρ in units of ‖PFP‖", fits=ABOVE_0)
    smalse_M: float = _option(_SMALSE.M, "smalse", "M₀ in units of ‖PFP‖", fits=ABOVE_0)
    smalse_beta: float = _option(
        _SMALSE.beta,
        "smalse",
        "factor β on M, in (0, 1)",
        fits=Range("between 0 and 1", lambda value: 0.0 < value < 1.0),
    )
    smalse_eta: float = _option(_SMALSE.eta, "smalse", "η in units of ‖b‖", fits=ABOVE_0)
    mpgp_gamma: float = _option(_SMALSE.gamma, "mprgp", "Γ of the proportioning test", fits=ABOVE_0)
    mpgp_alpha: float = _option(
        _SMALSE.alpha_bar,
        "mprgp",
        "step length ᾱ in units of 1/‖A‖",
        fits=Range("more than 0, at most 2", lambda value: 0.0 < value <= 2.0),
    )
    mpgp_expansion: str = _option(
        _SMALSE.expansion, "mprgp", "expansion step: fixed, or projcg", tuple(EXPANSIONS)
    )
    error_if_not_converged: bool = _option(
        True, "all", "raise ConvergenceError where a solver stops before its tolerance"
    )
    bbt: bool = _option(
        False,
        "all",
        "put the extreme eigenvalues of B Bᵀ and B D⁻¹ Bᵀ into the report; needs slepc4py",
    )
    monitor: bool = _option(False, "all", "print a line per step")
    converged_reason: bool = _option(False, "all", "print why the solver stopped")
    view: bool = _option(False, "all", "print the options, the sizes and the report")

    def smalse(self) -> SmalseParameters:
        """Parameters of SMALSE-M."""
        return SmalseParameters(
            rho=self.smalse_rho,
            M=self.smalse_M,
            beta=self.smalse_beta,
            eta=self.smalse_eta,
            gamma=self.mpgp_gamma,
            alpha_bar=self.mpgp_alpha,
            expansion=self.mpgp_expansion,
        )

    def view_text(self, prefix: str) -> str:
        """One line per option."""
        return "\n".join(f"-{prefix}{f.name} {getattr(self, f.name)}" for f in fields(self))


def parse_options(given: Mapping[str, Any] | None, prefix: str) -> Options:
    """Options from the command line, else from a dictionary, else the defaults.

    Args:
        given: Options of the program, with or without the prefix.
        prefix: Prefix of all options, e.g. ``"tfeti_"``.

    Raises:
        InputError: An option is unknown, its value does not fit, or the command line has options
            that PETSc was not given.
    """
    named = _without_prefix(given, prefix)
    database = PETSc.Options(prefix)
    _check_reached(named, database, prefix)
    named |= {name: database.getString(name, "") for name in database.getAll()}
    known = {f.name: f for f in fields(Options)}
    for name in named:
        if name not in known and not FACTOR_OPTION.fullmatch(name):
            raise InputError(
                f"unknown option -{prefix}{name}; expected one of "
                + ", ".join(f"-{prefix}{n}" for n in known)
            )
    options = Options(
        **{n: _converted(known[n], v, prefix) for n, v in named.items() if n in known}
    )
    if options.qp_type == "smalse":
        check_preconditioner(options, prefix)
    return options


def factor_options(given: Mapping[str, Any] | None, prefix: str) -> dict[str, Any]:
    """Those options of a dictionary that PETSc itself reads, without the prefix."""
    named = _without_prefix(given, prefix)
    return {name: value for name, value in named.items() if FACTOR_OPTION.fullmatch(name)}


def check_preconditioner(options: Options, prefix: str) -> None:
    """Raise if a preconditioner is asked for that SMALSE-M would ignore.

    Raises:
        InputError: ``pc_type`` is neither auto nor none.
    """
    if options.pc_type not in ("auto", "none"):
        raise InputError(
            f"-{prefix}pc_type {options.pc_type} with smalse, which solves scenes with contact: "
            "SMALSE-M takes no preconditioner, since it would not preserve the bounds; expected "
            "auto or none"
        )


def _without_prefix(given: Any, prefix: str) -> dict[str, Any]:
    """The options given, without the prefix."""
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


def _check_reached(named: Mapping[str, Any], database: PETSc.Options, prefix: str) -> None:
    """Raise if the command line has options that PETSc was not given."""
    known = set(named) | set(database.getAll())
    for word in sys.argv[1:]:
        if word.startswith(f"-{prefix}") and word.removeprefix(f"-{prefix}") not in known:
            raise InputError(
                f"{word} on the command line did not reach PETSc; call petsc4py.init(sys.argv) "
                "before dolfinx is imported"
            )


def _converted(f: Field[Any], value: Any, prefix: str) -> Any:
    """The value as the type of the option, in its range."""
    what, kind = f"-{prefix}{f.name}", type(f.default)
    try:
        result = CONVERSIONS[kind](value)
    except (TypeError, ValueError, OverflowError):
        raise InputError(
            f"{what} {shown(value)}: expected a value of type {kind.__name__}"
        ) from None
    choices, fits = f.metadata["choices"], f.metadata["fits"]
    if choices and result not in choices:
        raise InputError(f"{what} {result}: expected one of {', '.join(choices)}")
    if kind in (int, float) and not (math.isfinite(result) and fits.holds(result)):
        raise InputError(f"{what} {result}: expected {fits.text}")
    return result


def _as_bool(value: Any) -> bool:
    if isinstance(value, str):
        table = {"": True, "1": True, "true": True, "yes": True, "on": True}
        table |= {"0": False, "false": False, "no": False, "off": False}
        if value.lower() not in table:
            raise ValueError(value)
        return table[value.lower()]
    if value is not None and value not in (0, 1):
        raise ValueError(value)
    return True if value is None else bool(value)


def _as_float(value: Any) -> float:
    if isinstance(value, (bool, np.bool_)):
        raise TypeError(value)
    return float(value)


def _as_int(value: Any) -> int:
    if isinstance(value, str):
        return int(value)
    if _as_float(value) != int(value):
        raise ValueError(value)
    return int(value)


def _as_text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError(value)
    return value


CONVERSIONS: dict[type, Callable[[Any], Any]] = {
    bool: _as_bool,
    float: _as_float,
    int: _as_int,
    str: _as_text,
}


def options_table() -> str:
    """The table of docs/options.md."""
    lines = ["| option | algorithm | default | effect |", "|---|---|---|---|"]
    for f in fields(Options):
        choices = f.metadata["choices"]
        values = " (" + ", ".join(choices) + ")" if choices else ""
        default = str(f.default).lower() if isinstance(f.default, bool) else f"{f.default}"
        lines.append(
            f"| `-tfeti_{f.name}` | {f.metadata['algorithm']} | {default} "
            f"| {f.metadata['text']}{values} |"
        )
    return "\n".join(lines)
