"""Options: one typed dataclass from which parsing, ``view`` and docs/options.md are made."""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping
from dataclasses import Field, dataclass, field, fields
from typing import Any

from petsc4py import PETSc

from tfeti_dolfinx.dual.operator import PRECONDITIONERS
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.qp.mprgp import EXPANSIONS
from tfeti_dolfinx.qp.smalse import SmalseParameters
from tfeti_dolfinx.subdomains.kplus import KPLUS_TYPES

_SMALSE = SmalseParameters()
# what the factors of the subdomains and of the coarse problem read from PETSc's options
FACTOR_OPTION = re.compile(r"(sub|coarse)_(pc_factor|mat)_\w+")


def _option(default: Any, algorithm: str, text: str, choices: tuple[str, ...] = ()) -> Any:
    return field(
        default=default, metadata={"algorithm": algorithm, "text": text, "choices": choices}
    )


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
        1e-6, "all", "stop when the displacement of each body is right to this, in the maximum norm"
    )
    atol: float = _option(0.0, "all", "or when jumps and overlaps are below this length")
    max_it: int = _option(10_000, "all", "most inner steps, and most outer ones")
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
    norm_steps: int = _option(15, "smalse", "Lanczos steps that estimate ‖PFP‖")
    smalse_rho: float = _option(_SMALSE.rho, "smalse", "penalty ρ in units of ‖PFP‖")
    smalse_M: float = _option(_SMALSE.M, "smalse", "M₀ in units of ‖PFP‖")
    smalse_beta: float = _option(_SMALSE.beta, "smalse", "factor β on M, in (0, 1)")
    smalse_eta: float = _option(_SMALSE.eta, "smalse", "η in units of ‖b‖")
    mpgp_gamma: float = _option(_SMALSE.gamma, "mprgp", "Γ of the proportioning test")
    mpgp_alpha: float = _option(_SMALSE.alpha_bar, "mprgp", "step length ᾱ in units of 1/‖A‖")
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
    _check_ranges(options, prefix)
    return options


def factor_options(given: Mapping[str, Any] | None, prefix: str) -> dict[str, Any]:
    """Those options of a dictionary that PETSc itself reads, without the prefix."""
    named = _without_prefix(given, prefix)
    return {name: value for name, value in named.items() if FACTOR_OPTION.fullmatch(name)}


def _without_prefix(given: Mapping[str, Any] | None, prefix: str) -> dict[str, Any]:
    return {name.removeprefix("-").removeprefix(prefix): v for name, v in (given or {}).items()}


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
    """The value as the type of the option."""
    choices = f.metadata["choices"]
    kind: Any = type(f.default)
    try:
        if kind is bool:
            result: Any = _as_bool(value)
        else:
            result = kind(value)
    except (TypeError, ValueError):
        raise InputError(
            f"-{prefix}{f.name} {value!r}: expected a value of type {kind.__name__}"
        ) from None
    if choices and result not in choices:
        raise InputError(f"-{prefix}{f.name} {value}: expected one of {', '.join(choices)}")
    return result


def _as_bool(value: Any) -> bool:
    if isinstance(value, str):
        table = {"": True, "1": True, "true": True, "yes": True, "on": True}
        table |= {"0": False, "false": False, "no": False, "off": False}
        if value.lower() not in table:
            raise ValueError(value)
        return table[value.lower()]
    return True if value is None else bool(value)


def _check_ranges(options: Options, prefix: str) -> None:
    ranges = {
        "rtol": (options.rtol >= 0.0, "0 or more"),
        "atol": (options.atol >= 0.0, "0 or more"),
        "max_it": (options.max_it >= 0, "0 or more"),
        "norm_steps": (options.norm_steps >= 1, "1 or more"),
        "smalse_rho": (options.smalse_rho > 0.0, "more than 0"),
        "smalse_M": (options.smalse_M > 0.0, "more than 0"),
        "smalse_beta": (0.0 < options.smalse_beta < 1.0, "between 0 and 1"),
        "smalse_eta": (options.smalse_eta > 0.0, "more than 0"),
        "mpgp_gamma": (options.mpgp_gamma > 0.0, "more than 0"),
        "mpgp_alpha": (0.0 < options.mpgp_alpha <= 2.0, "more than 0, at most 2"),
    }
    for name, (fits, expected) in ranges.items():
        if not fits:
            raise InputError(f"-{prefix}{name} {getattr(options, name)}: expected {expected}")
    if options.qp_type == "smalse" and options.pc_type not in ("auto", "none"):
        raise InputError(
            f"-{prefix}pc_type {options.pc_type} with -{prefix}qp_type smalse: SMALSE-M takes no "
            "preconditioner, since it would not preserve the bounds; expected none"
        )


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
