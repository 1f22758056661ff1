"""How the columns of foreign logs are named, scaled and converted."""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path

import numpy as np
import pytest

from simopt_envs.measured import LogMapping, Recording, Source, load_recording

EXAMPLES = Path(__file__).parents[1] / "simopt_envs" / "measured" / "examples"
needs_yaml = pytest.mark.skipif(importlib.util.find_spec("yaml") is None, reason="needs pyyaml")


def mapping_file(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "mapping.yaml"
    path.write_text(text)
    return path


@needs_yaml
def test_a_mapping_renames_scales_shifts_and_converts(tmp_path):
    mapping = mapping_file(
        tmp_path,
        """
        time: {from: stamp, unit: ms}
        columns:
          ctrl/drive: {from: vir, scale: 35.1507}
          qpos/hinge: {from: angle, unit: deg, offset: 0.5}
          qpos/slide: {from: x, unit: mm, scale: -1}
          sensor/plain: raw
        """,
    )
    (tmp_path / "log.csv").write_text("stamp,vir,angle,x,raw,other\n0,1,180,100,7,9\n2,2,90,200,8,9\n")
    recording = load_recording(tmp_path / "log.csv", mapping)
    np.testing.assert_allclose(recording.time, [0, 0.002])
    np.testing.assert_allclose(recording["ctrl/drive"], [35.1507, 70.3014])
    np.testing.assert_allclose(recording["qpos/hinge"], [np.pi + 0.5, np.pi / 2 + 0.5])
    np.testing.assert_allclose(recording["qpos/slide"], [-0.1, -0.2])
    assert set(recording.columns) == {"ctrl/drive", "qpos/hinge", "qpos/slide", "sensor/plain"}


@needs_yaml
def test_text_without_names_or_stamps(tmp_path):
    (tmp_path / "log.txt").write_text("made by: a rig\nrate, 200\n  10 1\n 20 2\n 30 3\n 40 4\n")
    mapping = mapping_file(
        tmp_path,
        "header_lines: 2\ncolumn_names: [angle, volt]\nsample_rate: 200\nstart: 0.005\nend: 0.015\n"
        "columns: {qpos/a: {from: angle, unit: deg}}",
    )
    recording = load_recording(tmp_path / "log.txt", mapping)
    np.testing.assert_allclose(recording.time, [0.005, 0.010])
    np.testing.assert_allclose(recording["qpos/a"], np.deg2rad([20, 30]))
    with pytest.raises(ValueError, match="no line of column names; give column_names"):
        load_recording(tmp_path / "log.txt", LogMapping({"qpos/a": Source("angle")}, header_lines=2))


@needs_yaml
@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("columns: {qpos/a: {from: x, unit: degree}}", "unknown unit of 'x': 'degree'; did you mean 'deg'"),
        ("columns: {qpos/a: {form: x}}", r"expected a name or \{from: name"),
        ("columns: {qpos/a: {from: x, sacle: 2}}", "unknown key of column 'qpos/a': 'sacle'; did you mean 'scale'"),
        ("columns: {qpos/a: {from: x, scale: two}}", "scale of 'qpos/a' must be a number, got 'two'"),
        ("columns: {qpos/a: {from: x, scale: 0}}", "scale not 0"),
        ("columns: {qpos/a: x}\nsamplerate: 3", "unknown key 'samplerate'; did you mean 'sample_rate'"),
        ("columns: {qpos/a: x}\nsample_rate: -3", "must be positive, got -3 Hz"),
        ("columns: {}", "at least one column"),
        ("rows: []", "has a key 'columns', or 'shown'"),
        ("columns: 3", "'columns' has recording columns as keys, got 3"),
        ("shown: {angle: {sacle: 2}}", "unknown key of column 'angle': 'sacle'; did you mean 'scale'"),
        ("shown: {angle: {scale: 0}}", "whose scale is 0 shows nothing"),
        ("shown: {angle: }", "expected some of scale, bias, delay, lag_share, got None"),
        ("shown: {angel: {bias: 1}}", "unknown column that is shown 'angel'; did you mean 'angle'"),
        ("columns: [", "is not YAML"),
        ("columns: {qpos/a: angel}", "unknown column of the log 'angel'; did you mean 'angle'"),
    ],
)
def test_a_wrong_mapping_says_what_is_wrong(tmp_path, text, message):
    (tmp_path / "log.csv").write_text("time,angle\n0,1\n1,2\n")
    with pytest.raises(ValueError, match=message):
        load_recording(tmp_path / "log.csv", mapping_file(tmp_path, text))


def test_columns_of_unequal_length_are_named():
    log = {"time": np.arange(100.0), "q": np.zeros(100), "u": np.zeros(99)}
    with pytest.raises(ValueError, match="column 'ctrl/a' has 99 values, expected one for each of 100 rows"):
        LogMapping({"qpos/a": Source("q"), "ctrl/a": Source("u")}, start=1.0).apply(log)


def test_the_stamps_must_agree_with_a_declared_rate(tmp_path):
    time = np.arange(400) / 100
    path = Recording(time, {"qpos/hinge": np.sin(time)}).save(tmp_path / "log.csv")
    columns = {"qpos/hinge": Source("qpos/hinge")}
    assert len(load_recording(path, LogMapping(columns, sample_rate=100.0))) == 400
    with pytest.raises(
        ValueError, match=r"wrong rate: the median interval .* is 0\.01 s, the mapping declares 1000 Hz"
    ):
        load_recording(path, LogMapping(columns, sample_rate=1000.0))


# --- foreign formats ------------------------------------------------------------------------------------------------


@needs_yaml
@pytest.mark.skipif(not os.environ.get("SIMOPT_DATA"), reason="needs the recordings that SIMOPT_DATA names")
def test_the_example_mappings_read_the_public_logs():
    data = Path(os.environ["SIMOPT_DATA"])
    emps = load_recording(data / "emps" / "DATA_EMPS.mat", EXAMPLES / "emps.yaml")
    assert len(emps) == 24841
    assert emps["ctrl/drive"].max() == pytest.approx(145.4708, rel=1e-5)
    swing = load_recording(data / "free_swing" / "pendulum_free_swing_data_02.txt", EXAMPLES / "free_swing.yaml")
    assert swing.time[0] == pytest.approx(1.1)
    assert np.abs(swing["qpos/link"]).max() < 2.0
    pendulum = load_recording(data / "double_pendulum" / "trajectory_12.csv", EXAMPLES / "double_pendulum.yaml")
    assert set(pendulum.commands) == {"ctrl/shoulder", "ctrl/elbow"}
    assert pendulum.period == pytest.approx(0.00162, rel=0.01)
