"""What several test files share."""

import mujoco
import pytest

needs_batch = pytest.mark.skipif(
    tuple(map(int, mujoco.__version__.split(".")[:2])) < (3, 17), reason="mujoco.batch needs mujoco >= 3.17"
)
needs_effects = pytest.mark.skipif(int(mujoco.__version__.split(".")[0]) < 4, reason="effects need mujoco >= 4.0")


def _compiles(xml: str) -> bool:
    try:
        mujoco.MjModel.from_xml_string(xml)
    except ValueError:
        return False
    return True


needs_examples = pytest.mark.skipif(
    not _compiles('<mujoco><worldbody><body simple="false"/></worldbody></mujoco>'),
    reason="the example models use body/simple, which this MuJoCo lacks",
)
