"""A repaired model as a file."""

import matplotlib.image
import mujoco
import numpy as np
import pytest
from conftest import needs_effects
from gap_plant import MODEL

from simopt_envs.gap.hypothesis import Candidate, Hypothesis
from simopt_envs.gap.plain import plain_parameters
from simopt_envs.gap.repair import difference, observation_model, to_xml_in
from simopt_envs.measured import Recording, load_recording
from simopt_envs.physics.columns import ColumnModel
from simopt_envs.physics.effects import EFFECTS, Motion

pytestmark = needs_effects

ROBOT = """
<mujoco><compiler meshdir="meshes" texturedir="pictures"/>
  <asset>
    <mesh name="link" file="link.obj"/><texture name="paint" type="2d" file="paint.png"/>
    <texture name="sky" type="skybox" builtin="flat" width="8" height="48"/><material name="paint" texture="paint"/>
  </asset>
  <worldbody><body><joint/><geom type="mesh" mesh="link" material="paint"/></body></worldbody>
</mujoco>"""
TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


@pytest.mark.parametrize("given_as", ["model.xml", "robot/model.xml"])
def test_a_repaired_model_finds_its_meshes_and_textures_from_where_it_is_saved(tmp_path, monkeypatch, given_as):
    robot, out = tmp_path / "robot", tmp_path / "out" / "gap"
    for folder in (robot / "meshes", robot / "pictures", out):
        folder.mkdir(parents=True)
    (robot / "model.xml").write_text(ROBOT)
    (robot / "meshes" / "link.obj").write_text(TETRAHEDRON)
    matplotlib.image.imsave(robot / "pictures" / "paint.png", np.zeros((4, 4, 3)))
    monkeypatch.chdir(robot if given_as == "model.xml" else tmp_path)
    spec = mujoco.MjSpec.from_file(given_as)
    mass = spec.compile().body_mass
    (out / "model.repaired.xml").write_text(to_xml_in(spec, out))
    monkeypatch.chdir("/")
    saved = mujoco.MjModel.from_xml_path(str(out / "model.repaired.xml"))
    np.testing.assert_allclose(saved.body_mass, mass)
    assert (spec.compiler.meshdir, spec.compiler.texturedir) == ("meshes", "pictures")


@pytest.mark.parametrize("share", [0.0, 0.4])
def test_recordings_are_read_as_the_repaired_model_means_them(tmp_path, share):
    """What MJCF cannot hold, two things of one sensor, stands in the diff and in a mapping."""
    pytest.importorskip("yaml")
    plain, time = plain_parameters(mujoco.MjSpec.from_string(MODEL)), 0.01 * np.arange(200)
    motion = Motion(*np.ones((5, 2)))
    of_sensor = [Candidate(EFFECTS[name], "joint:elbow") for name in ("sensor_scale", "sensor_delay")]
    hypothesis = Hypothesis(plain, of_sensor, motion)
    names = hypothesis.space.names
    sizes = {"scale": 1.05, "lag_share": share, "delay": 0.02}
    chosen = {next(n for n in names if n.startswith("sensor_") and n.endswith(key)): v for key, v in sizes.items()}
    xi = hypothesis.space.values(chosen)
    true = {"ctrl/elbow": np.cos(3 * time), "qpos/shoulder": np.cos(time), "qpos/elbow": np.sin(3 * time)}
    shown = ColumnModel(hypothesis.space, ["qpos/elbow"]).shown(true["qpos/elbow"][None, None, :, None], xi[None], 0.01)
    Recording(time, {**true, "qpos/elbow": shown[0, 0, :, 0]}).save(tmp_path / "log.csv")
    columns = observation_model(hypothesis, xi, true)
    (tmp_path / "columns.yaml").write_text(columns)
    read = load_recording(tmp_path / "log.csv", tmp_path / "columns.yaml")
    assert [*read.columns] == [*true]
    assert np.isnan(read["qpos/elbow"]).sum() == 2, "what it shows only later is not known"
    tolerance = 0.5 * (3 * 0.02) ** 2 * share + 1e-5  # a lag is undone as if it were dead time
    for name, values in true.items():
        np.testing.assert_allclose(read[name][20:-2], values[20:-2], rtol=0, atol=tolerance)
    diff = difference(hypothesis.spec, hypothesis.spec, columns)
    assert [line for line in diff.splitlines() if line.startswith("+  ")] == [f"+{columns.splitlines()[1]}"]


def test_a_repaired_model_finds_the_sides_of_a_sky(tmp_path):
    matplotlib.image.imsave(tmp_path / "side.png", np.zeros((4, 4, 3)))
    sides = " ".join(f'file{side}="side.png"' for side in ("right", "left", "up", "down", "front", "back"))
    (tmp_path / "model.xml").write_text(f"<mujoco><asset><texture type='skybox' {sides}/></asset></mujoco>")
    (tmp_path / "out").mkdir()
    saved = to_xml_in(mujoco.MjSpec.from_file(str(tmp_path / "model.xml")), tmp_path / "out")
    (tmp_path / "out" / "model.xml").write_text(saved)
    assert mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "model.xml")).ntex == 1


def test_a_repaired_model_without_files_tells_of_no_folder(tmp_path):
    spec = mujoco.MjSpec.from_string("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
    spec.compile()
    assert to_xml_in(spec, tmp_path) == spec.to_xml()
    plain = plain_parameters(mujoco.MjSpec.from_string(MODEL))
    assert (
        observation_model(Hypothesis(plain, (), Motion(*np.ones((5, 2)))), plain.prior.space.nominal, ["qpos/elbow"])
        == ""
    )
