"""Array aliases and helpers shared by the numerical packages."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]


def frozen(array: NDArray[np.float64]) -> NDArray[np.float64]:
    """The same array, made read-only before it is stored in a value."""
    array.setflags(write=False)
    return array
