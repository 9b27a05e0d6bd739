"""The type of all numpy arrays here; their shapes and units stand in the docstrings."""

from typing import Any

import numpy as np
import numpy.typing as npt

Array = np.ndarray[Any, np.dtype[Any]]
ArrayLike = npt.ArrayLike

__all__ = ["Array", "ArrayLike"]
