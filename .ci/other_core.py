"""Print a processor type that OpenBLAS can play on this machine and that rounds unlike its own.

For ``OPENBLAS_CORETYPE``. Nothing is printed where numpy's BLAS is another one, or has no kernels
to choose from.
"""

import ctypes
import platform
from pathlib import Path

import numpy.linalg  # noqa: F401  it loads the BLAS

# AVX-512, FMA, AVX, SSE3: each executes those after it, and sums in another order than they do
KINDS = [
    {"SkylakeX", "Cooperlake", "SapphireRapids"},
    {"Haswell", "Zen", "Excavator", "Steamroller", "Piledriver"},
    {"Sandybridge", "Bulldozer"},
    {"Prescott", "Core2", "Penryn", "Dunnington", "Atom", "Nehalem", "Barcelona", "Bobcat"},
]
PLAYED = ["SkylakeX", "Haswell", "Sandybridge", "Prescott"]
SYMBOLS = ["openblas_get_corename", "openblas_get_corename64_"]
SYMBOLS += [f"scipy_{name}" for name in SYMBOLS]


def own_core():
    """The type whose kernels OpenBLAS has chosen, or None."""
    mapped = {line.split()[-1] for line in Path("/proc/self/maps").read_text().splitlines()}
    for path in sorted(p for p in mapped if "openblas" in p and ".so" in p):
        library = ctypes.CDLL(path)
        for symbol in SYMBOLS:
            if hasattr(library, symbol):
                function = getattr(library, symbol)
                function.restype = ctypes.c_char_p
                return function().decode()
    return None


def other_core(own):
    """A type other than this one that the processor executes too, or None."""
    if platform.machine() == "aarch64":
        return "ARMV8" if own != "ARMV8" else None
    for kind, simpler in zip(KINDS, PLAYED[1:], strict=False):
        if own in kind:
            return simpler
    return None


if __name__ == "__main__":
    print(other_core(own_core()) or "")
