"""Motions of subdomains that are no kernel, since something holds them, maybe softly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import block_diag, csr_array

from tfeti_dolfinx.arrays import TINY, Array, joined
from tfeti_dolfinx.subdomains.block import Block

# of a mode of length 1: what is left of it outside of the kernel is rounding
IN_KERNEL = 1e-6


@dataclass(frozen=True)
class SoftMotions:
    """Motions R̂ of a rank that have a diagonal R̂ᵀKR̂ = D.

    Attributes:
        rows: R̂ on the trace, scipy CSR, shape ``(t, k)``.
        energy: D, shape ``(k,)``.
        amplification: max diag(K) / min D of each Block, 0 without springs.
    """

    rows: csr_array
    energy: Array
    amplification: list[float]


def sprung(blocks: Sequence[Block]) -> SoftMotions:
    """What springs hold in each Block."""
    modes, energies = zip(*map(_outside, blocks), strict=True) if blocks else ((), ())
    trace = [R[block.trace_dofs] for R, block in zip(modes, blocks, strict=True)]
    rows = csr_array(block_diag(trace)) if trace else csr_array((0, 0))
    largest = [
        float(block.diagonal.max() / max(D.min(), TINY)) if len(D) else 0.0
        for block, D in zip(blocks, energies, strict=True)
    ]
    return SoftMotions(rows, joined(energies), largest)


def _outside(block: Block) -> tuple[Array, Array]:
    """R̂, orthonormal, orthogonal to the kernel, shape ``(n, k)``, and the diagonal of R̂ᵀKR̂."""
    modes, R = block.modes, block.kernel
    count = modes.shape[1] - R.shape[1]
    if count <= 0:
        return np.zeros((len(modes), 0)), np.zeros(0)
    sizes = np.linalg.norm(modes, axis=0)
    rest = modes / np.where(sizes > 0.0, sizes, 1.0)
    for _ in range(2):  # once leaves rounding of the kernel
        rest = rest - R @ (R.T @ rest)
    U, sizes, _ = np.linalg.svd(rest, full_matrices=False)
    U = U[:, :count][:, sizes[:count] > IN_KERNEL]
    KU = np.array([block.multiply(u) for u in U.T]).reshape(-1, len(modes)).T
    energies, V = np.linalg.eigh(U.T @ KU)
    return U @ V, np.maximum(energies, 0.0)
