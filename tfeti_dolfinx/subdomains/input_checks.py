"""Is a subdomain's stiffness symmetric, are its load and stiffness finite?"""

from __future__ import annotations

from typing import Any

import numpy as np

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.errors import InputError

# Largest entry of K − Kᵀ over that of K: far above what rounding of assembly leaves, far below any
# term of a form that matters.
SYMMETRY = 1e-8


def check_stiffness(
    name: str, K: Any, what: str = "the stiffness", form: str = "a linear elastic form"
) -> None:
    """Raise if a stiffness is not finite, not symmetric or has a diagonal entry of 0 or less.

    Args:
        name: Whose it is.
        K: The matrix.
        what: What it is called.
        form: What it should come from.

    Raises:
        InputError: It says which of them.
    """
    if not np.all(np.isfinite(K.data)):
        raise InputError(f"{name}: {what} has entries that are not finite")
    scale = np.abs(K.data).max(initial=0.0)
    skew = np.abs((K - K.T).data).max(initial=0.0)
    if skew > SYMMETRY * scale:
        raise InputError(
            f"{name}: {what} is not symmetric (|K − Kᵀ| = {skew:.3g}, |K| = {scale:.3g}); "
            f"expected {form}"
        )
    lowest = K.diagonal().min(initial=np.inf)
    if lowest <= 0.0:
        raise InputError(
            f"{name}: {what} has a diagonal entry {lowest:.3g}; "
            f"expected {form}, positive on all unknowns"
        )


def check_load(name: str, f: Array) -> None:
    """Raise if a load is not finite.

    Raises:
        InputError: It says how many entries are not.
    """
    if not np.all(np.isfinite(f)):
        raise InputError(f"{name}: the load has {np.sum(~np.isfinite(f))} entries not finite")
