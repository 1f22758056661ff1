"""What several test files share."""

import os
from pathlib import Path

import mujoco
import pytest

needs_batch = pytest.mark.skipif(
    tuple(map(int, mujoco.__version__.split(".")[:2])) < (3, 17), reason="mujoco.batch needs mujoco >= 3.17"
)


@pytest.fixture(scope="session")
def measured_data() -> Path:
    """The folder of measured recordings, which SIMOPT_DATA names."""
    if "SIMOPT_DATA" not in os.environ:
        pytest.skip("SIMOPT_DATA does not name the folder of measured recordings")
    return Path(os.environ["SIMOPT_DATA"])
