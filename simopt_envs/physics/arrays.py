"""What lets the same code run on NumPy arrays and on torch tensors, wherever these live.

The functions used must be ones that both libraries spell alike (``abs``, ``where``, ``einsum``, ``concatenate`` with
``axis``, ...); torch takes NumPy's ``axis`` for its ``dim``.
"""

from __future__ import annotations

from typing import Any

import numpy as np


def namespace(array: Any) -> Any:
    """The library that an array is of: ``numpy`` or ``torch``."""
    if isinstance(array, np.ndarray):
        return np
    import torch

    return torch


def to_numpy(array: Any) -> np.ndarray:
    """An array in the host's memory; a copy only where it is elsewhere."""
    return array if isinstance(array, np.ndarray) else array.cpu().numpy()
