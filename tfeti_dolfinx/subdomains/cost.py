"""What local operators cost, by a model, to choose between them."""

from __future__ import annotations

from dataclasses import dataclass

from tfeti_dolfinx.subdomains.factor import REAL, FactorSize

# What one core of a few years ago does; of a faster one all times are shorter alike, and only their
# ratios choose. Bytes read from memory, and operations of sweeps over a factor and of dense
# products of matrices, each per second; seconds of a call that comes through Python and PETSc.
BANDWIDTH, SWEEPS, PRODUCTS, CALL = 1.2e10, 9e9, 1.6e10, 2e-5
# Seconds of one entry of a sparse matrix times one number, and bytes of its column.
SPARSE_ENTRY, INDEX = 1.2e-9, 4
# Right sides that go through a factor at once: enough that it is not read for each, and few enough
# that they fit beside it into the cache.
TOGETHER = 32


@dataclass(frozen=True)
class Cost:
    """Seconds, by the model.

    Attributes:
        setup: Of making it, but for factors.
        multiplication: Of one multiplication.
        traffic: Bytes that one multiplication reads and writes.
    """

    setup: float
    multiplication: float
    traffic: float = 0.0

    def of(self, multiplications: int) -> float:
        """All of so many multiplications."""
        return self.setup + multiplications * self.multiplication


def sweeps(factor: FactorSize, n: int, count: int) -> float:
    """Seconds of a solve with a factor of n unknowns and as many right sides."""
    reading = sweeps_traffic(factor, n, count) / BANDWIDTH
    return max(reading, 4.0 * factor.entries * count / SWEEPS) + CALL * -(-count // TOGETHER)


def sweeps_traffic(factor: FactorSize, n: int, count: int) -> float:
    """Bytes that go through memory for it: the factor twice, and the right sides."""
    return 2.0 * -(-count // TOGETHER) * factor.memory + 4.0 * REAL * n * count


def sparse_traffic(entries: int, count: int) -> float:
    """Bytes that go through memory for products of a sparse matrix with as many vectors."""
    return (REAL + INDEX) * entries * count


def sparse_products(entries: int, count: int) -> float:
    """Seconds of products of a sparse matrix with as many vectors."""
    return SPARSE_ENTRY * entries * count + CALL


def dense_product(t: int, count: int) -> float:
    """Seconds of a product of a dense symmetric t × t matrix with as many vectors."""
    reading = dense_traffic(t, count) / BANDWIDTH
    if count == 1:
        return reading + CALL
    return max(reading, 2.0 * t * t * count / PRODUCTS) + CALL


def dense_traffic(t: int, count: int) -> float:
    """Bytes that go through memory for it; of a matrix that is used alone half is stored."""
    if count == 1:
        return REAL * t * t / 2.0
    return REAL * (t * t + 4.0 * t * count)
