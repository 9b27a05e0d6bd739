"""Parameters of the solvers; options and documents follow from what stands here."""

from __future__ import annotations

from dataclasses import dataclass

from tfeti_dolfinx.common.validation import ABOVE_0, Range, described


@dataclass(frozen=True)
class NewtonParameters:
    """Parameters of block Newton; options say themselves what they are.

    Attributes:
        enough: Share of (ᾱ/2)‖g^P‖², which the gradient step promises, that a step lowers q by.
        final: Of the rule's tolerance: what no solve goes below, as ‖g^P‖ is not quite ‖P_f g‖.
        stage: What a solve on a face that stays reduces its residual to, before step 1 looks at it.
        patience: Steps in a row that neither halve ‖g^P‖ nor lower q beyond its rounding.
        unfelt: Of the gradient: multipliers of Gλ = e that make it longer than that are rounding of
            motions that a face does not see.
        lost: Of ‖F‖‖λ‖: what rounding of λ − ᾱs leaves of ‖g^P‖.
        rounding: Of the largest entry of a way: less is none.
        hidden: Of the terms of q: what its differences may be wrong by.
        short: Of a gradient: a projection that is shorter may be rounding.
        beyond: Of the way to the first bound, where no curvature ends it: more rows than one are
            to leave.
        apart: Of ‖d‖: rows that want gaps so far apart exclude each other, less may be rounding.
        takes_part: Of the largest force of such a direction: rows with less have no part in it.
        far: How far such a direction is followed, to end in Ω's cone of recession.
        unseen: Of ‖F‖‖w‖: what may be left of Fw where F is not to see a direction w.
        purifying: Most steps of PCPG to that.
    """

    gamma: float = described(
        1.0,
        "newton",
        "Γ of the proportioning test between two faces",
        name="newton_gamma",
        symbol="Γ",
        fits=ABOVE_0,
    )
    reduction: float = described(
        0.5,
        "newton",
        "what a solve on a face that may change reduces its residual to, in (0, 1)",
        name="newton_reduction",
        fits=Range("between 0 and 1", lambda value: 0.0 < value < 1.0),
    )
    enough: float = 0.1
    final: float = 0.9
    stage: float = 0.1
    patience: int = 10
    unfelt: float = 1e6
    lost: float = 2e-15
    rounding: float = 1e-10
    hidden: float = 1e-15
    short: float = 1e-6
    beyond: float = 10.0
    apart: float = 1e-8
    takes_part: float = 1e-3
    far: float = 1e30
    unseen: float = 1e-14
    purifying: int = 200


@dataclass(frozen=True)
class SmalseParameters:
    """Parameters of SMALSE-M and of its inner MPRGP, for F scaled to ‖PFP‖ = 1.

    Attributes:
        enough: Of the rule's tolerance: inner problems are not solved more exactly, as M may be
            too small.
        rounding: Of the Lagrangian: what its value may be wrong by.
        change: Where nothing fulfils Bx = 0, ‖Bx‖ tends to a limit: a change by less than this
            share is none; the slowest scenes change by 1e-3 a step.
        patience: Outer steps without a change of ‖Bx‖ and M that are a stall.
    """

    rho: float = described(
        1.0,
        "smalse",
        "penalty ρ in units of ‖PFP‖",
        name="smalse_rho",
        symbol="ρ",
        fits=ABOVE_0,
    )
    M: float = described(
        1.0, "smalse", "M₀ in units of ‖PFP‖", name="smalse_M", symbol="M", fits=ABOVE_0
    )
    beta: float = described(
        0.9,
        "smalse",
        "factor β on M, in (0, 1)",
        name="smalse_beta",
        symbol="β",
        fits=Range("between 0 and 1", lambda value: 0.0 < value < 1.0),
    )
    eta: float = described(
        0.1, "smalse", "η in units of ‖b‖", name="smalse_eta", symbol="η", fits=ABOVE_0
    )
    gamma: float = described(
        1.0, "mprgp", "Γ of the proportioning test", name="mpgp_gamma", symbol="Γ", fits=ABOVE_0
    )
    alpha_bar: float = described(
        1.95,
        "mprgp",
        "step length ᾱ in units of 1/‖A‖",
        name="mpgp_alpha",
        symbol="ᾱ",
        fits=Range("more than 0, at most 2", lambda value: 0.0 < value <= 2.0),
    )
    enough: float = 1e-3
    rounding: float = 1e-14
    change: float = 1e-3
    patience: int = 1000
