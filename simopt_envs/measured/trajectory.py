"""What one episode of a policy leaves behind, on the real system or in simulation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Trajectory:
    """One episode: T actions and the T + 1 observations around them.

    Attributes:
        observations: (T + 1, o), the first one before any action; NaN where a sensor dropped out.
        actions: (T, a), as commanded.
        success: whether the episode ended in success; None where the system cannot tell.
    """

    observations: NDArray[np.float64]
    actions: NDArray[np.float64]
    success: bool | None = None

    def __post_init__(self) -> None:
        """Raise ValueError where the lengths do not fit together."""
        if self.observations.ndim != 2 or self.actions.ndim != 2 or len(self.observations) != len(self.actions) + 1:
            raise ValueError(
                "a trajectory needs observations (T + 1, o) and actions (T, a), got shapes "
                f"{self.observations.shape} and {self.actions.shape}"
            )

    def __len__(self) -> int:
        return len(self.actions)
