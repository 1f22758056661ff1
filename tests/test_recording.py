"""Recordings: files read and written, foreign logs mapped, time stamps made uniform."""

from __future__ import annotations

import importlib.util
import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.io import savemat

from simopt_envs.measured import Finding, LogMapping, Recording, Source, load_recording, load_recordings
from simopt_envs.measured.recording import warnings_of, with_distinct_names
from simopt_envs.measured.resample import band_limited, hold

parquet_format = pytest.param(
    ".parquet", marks=pytest.mark.skipif(importlib.util.find_spec("pyarrow") is None, reason="needs pyarrow")
)


def sine(rate: float = 100.0, seconds: float = 4.0, frequency: float = 1.0) -> Recording:
    time = np.arange(round(rate * seconds)) / rate
    phase = 2 * np.pi * frequency * time
    return Recording(
        time,
        {"ctrl/motor": np.sign(np.sin(phase)), "qpos/hinge": np.sin(phase), "sensor/imu/0": np.cos(phase)},
        name="sine",
    )


def test_columns_must_be_as_long_as_time():
    with pytest.raises(ValueError, match=r"'qpos/a' has shape \(2,\), time has \(3,\)"):
        Recording(np.arange(3.0), {"qpos/a": np.zeros(2)})
    with pytest.raises(ValueError, match=r"unknown column 'qpos/hing'; did you mean 'qpos/hinge'\?"):
        sine()["qpos/hing"]


@pytest.mark.parametrize("suffix", [".csv", ".npz", parquet_format])
def test_every_format_keeps_every_bit(tmp_path, suffix):
    recording = sine()
    recording["qpos/hinge"][7] = np.nan
    again = load_recording(recording.save(tmp_path / f"log{suffix}"))
    assert again.name == "log"
    assert list(again.columns) == list(recording.columns)
    np.testing.assert_array_equal(again.time, recording.time)
    for name in recording.columns:
        np.testing.assert_array_equal(again[name], recording[name])


def test_an_unknown_suffix_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"one of \.csv, \.parquet, \.npz, got 'log\.xls'"):
        sine().save(tmp_path / "log.xls")
    (tmp_path / "log.xls").write_text("x")
    with pytest.raises(ValueError, match="unknown kind of recording; known are"):
        load_recording(tmp_path / "log.xls")
    with pytest.raises(FileNotFoundError, match=r"no recording .*missing\.csv"):
        load_recording(tmp_path / "missing.csv")


def test_commands_are_held_and_signals_interpolated():
    recording = sine(rate=100)
    fine = recording.resample(0.002)
    np.testing.assert_array_equal(fine["ctrl/motor"], np.repeat(recording["ctrl/motor"], 5)[: len(fine)])
    truth = np.sin(2 * np.pi * fine.time)
    assert np.abs(fine["qpos/hinge"] - truth).max() < 2e-5
    assert np.abs(np.interp(fine.time, recording.time, recording["qpos/hinge"]) - truth).max() > 2e-4  # a line would


def test_resampling_does_not_fold_frequencies_back():
    """45 Hz sampled at 20 Hz would appear as 5 Hz; 1 Hz must come through unchanged and undelayed."""
    time = np.arange(4000) / 1000
    slow, fast = np.sin(2 * np.pi * time), np.sin(2 * np.pi * 45 * time)
    coarse = Recording(time, {"qpos/a": slow + fast, "ctrl/a": slow + fast}).resample(0.05)
    inside = (coarse.time > 0.5) & (coarse.time < 3.5)
    truth = np.sin(2 * np.pi * coarse.time[inside])
    assert np.abs(coarse["qpos/a"][inside] - truth).max() < 0.01
    assert np.abs(coarse["ctrl/a"][inside] - truth).max() > 0.5, "plain sampling, for contrast, does fold back"


def test_jittered_stamps_are_made_uniform():
    rng = np.random.default_rng(0)
    time = np.cumsum(rng.uniform(0.0005, 0.0035, 2000))
    uniform = Recording(time, {"qpos/a": np.sin(2 * np.pi * time)}).resample(0.002)
    np.testing.assert_allclose(np.diff(uniform.time), 0.002, rtol=1e-9)
    # As if the samples were equally far apart, the error would be that of a wandering clock.
    assert np.abs(uniform["qpos/a"] - np.sin(2 * np.pi * uniform.time)).max() < 1e-5


def test_signals_are_missing_inside_a_gap_and_beyond_the_ends():
    time = np.delete(np.arange(1000) / 1000, np.s_[400:450])
    grid = np.arange(1000) / 1000
    filled = band_limited(time, np.sin(time), grid)
    assert np.isnan(filled[401:449]).all()
    assert np.isfinite(np.delete(filled, np.s_[400:450])).all()
    assert np.isnan(band_limited(time, np.sin(time), np.array([-0.1, 0.5, 1.2]))[[0, 2]]).all()
    assert np.isfinite(
        band_limited(np.delete(time, np.s_[100:102]), np.sin(np.delete(time, np.s_[100:102])), grid)[:400]
    ).all()


def test_hold_before_the_first_stamp_and_within_rounding_of_a_stamp():
    time, values = np.array([0.1, 0.2, 0.3]), np.array([1.0, 2.0, 3.0])
    np.testing.assert_array_equal(hold(time, values, np.array([0.0, 0.1, 0.2 - 1e-9, 0.19, 0.9])), [1, 1, 2, 1, 3])


def test_time_that_repeats_is_thinned_and_time_that_runs_backward_refused():
    repeated = Recording(np.array([0.0, 0.1, 0.1, 0.2]), {"qpos/a": np.array([0.0, 1.0, 2.0, 3.0])})
    np.testing.assert_array_equal(repeated.in_order()["qpos/a"], [0, 2, 3])
    with pytest.raises(ValueError, match="never run backward"):
        Recording(np.array([0.0, 0.2, 0.1]), {}).resample(0.1)


@pytest.mark.parametrize("late", [1e-6, 1e-4])
def test_a_stamp_just_before_the_next_makes_no_leap(late):
    """As where a logger writes a sample late: a spline through both would turn noise into a motion."""
    rng, time = np.random.default_rng(0), np.arange(2000) / 100
    values = np.sin(time) + 1e-3 * rng.standard_normal(2000)
    for row in (300, 700, 1500):
        time[row] = time[row + 1] - late
    uniform = Recording(time, {"qpos/a": values}).resample(0.01)
    assert np.abs(uniform["qpos/a"] - np.sin(uniform.time)).max() < 0.01


def test_what_is_all_but_gap_is_not_resampled():
    time = np.r_[0.0, 1.7e9 + np.arange(299) / 100]  # a clock that was set
    with pytest.raises(ValueError, match=r"300 samples in 1.7e\+09 s: cut it where time jumps"):
        Recording(time, {"qpos/a": np.zeros(300)}).resample(0.01)


def test_names_are_made_distinct():
    named = [replace(sine(), name=name) for name in ("run", "run (2)", "run", "other", "run")]
    assert [r.name for r in with_distinct_names(named)] == ["run", "run (2)", "run (3)", "other", "run (4)"]


def test_select_split_and_windows():
    recording = sine(rate=100, seconds=10)
    part = recording.select(2.0, 3.0)
    assert (part.time[0], len(part)) == (2.0, 100)
    with pytest.raises(ValueError, match=r"no sample in \[20, inf\) s; it spans 0 to 9.99 s"):
        recording.select(start=20)
    fitted, held_out = recording.split(0.6, guard=0.5)
    assert fitted.time[-1] < 6.0
    assert held_out.time[0] - fitted.time[-1] >= 0.5
    with pytest.raises(ValueError, match="0 < fraction < 1"):
        recording.split(1.0)
    windows = list(recording.windows(1.0, step=2.0))
    assert [w.time[0] for w in windows] == [0, 2, 4, 6, 8]
    assert all(len(w) == 101 for w in windows)
    assert list(sine(rate=100, seconds=0.8).windows(1.0)) == [], "it is shorter"
    holed = Recording(np.delete(recording.time, np.s_[450:470]), {"qpos/a": np.zeros(980)})
    assert [round(w.time[0], 2) for w in holed.windows(1.0)] == [0, 1, 2, 3, 5, 6, 7, 8]


def test_what_begins_at_rest_does_so_until_its_beginning_is_cut_off():
    recording = replace(sine(rate=100, seconds=10), at_rest=True)
    early, late = recording.split(0.6)
    assert (early.at_rest, late.at_rest) == (True, False)
    assert recording.resample(0.02).at_rest
    assert [window.at_rest for window in recording.windows(4.0)] == [True, False]
    assert not sine(rate=100, seconds=10).at_rest, "unless it is told"


# --- mappings -------------------------------------------------------------------------------------------------------


def test_matlab_vectors_of_either_orientation(tmp_path):
    time = np.arange(50) / 100
    savemat(
        tmp_path / "log.mat",
        {"t": time[None], "qm": np.sin(time)[:, None], "gain": 3.0, "Q": np.ones((50, 2)), "note": "x"},
    )
    recording = load_recording(
        tmp_path / "log.mat", LogMapping({"qpos/a": Source("qm"), "qpos/b": Source("Q/1")}, Source("t"))
    )
    np.testing.assert_array_equal(recording.time, time)
    np.testing.assert_array_equal(recording["qpos/a"], np.sin(time))
    with pytest.raises(ValueError, match="unknown column of the log 'gain'"):
        load_recording(tmp_path / "log.mat", LogMapping({"qpos/a": Source("gain")}, Source("t")))


def test_lerobot_episodes(tmp_path):
    pa = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    (tmp_path / "meta").mkdir()
    (tmp_path / "data" / "chunk-000").mkdir(parents=True)
    features = {
        "action": {"dtype": "float32", "shape": [2], "names": {"motors": ["pan", "lift"]}},
        "observation.state": {"dtype": "float32", "shape": [2], "names": ["pan", "lift"]},
    }
    (tmp_path / "meta" / "info.json").write_text(json.dumps({"fps": 30, "features": features}))
    state = np.arange(20.0).reshape(10, 2)
    table = pa.table(
        {
            "action": (state + 100).tolist(),
            "observation.state": state.tolist(),
            "timestamp": np.tile(np.arange(5) / 30, 2),
            "frame_index": np.tile(np.arange(5), 2),
            "episode_index": np.repeat([3, 4], 5),
            "task": ["pick"] * 10,
        }
    )
    path = tmp_path / "data" / "chunk-000" / "file-000.parquet"
    parquet.write_table(table, path)
    mapping = LogMapping(
        {"ctrl/lift": Source("action/lift"), "qpos/lift": Source("observation.state/lift", unit="deg")}
    )
    for source in (tmp_path, path):
        first, second = load_recordings(source, mapping)
        assert (first.name, second.name) == ("episode_000003", "episode_000004")
        np.testing.assert_allclose(second.time, np.arange(5) / 30)
        np.testing.assert_allclose(second["ctrl/lift"], [111, 113, 115, 117, 119])
        np.testing.assert_allclose(first["qpos/lift"], np.deg2rad([1, 3, 5, 7, 9]))
    with pytest.raises(ValueError, match="holds 2 episodes: name one, episode=0 to 1"):
        load_recording(path, mapping)
    assert load_recording(path, mapping, episode=1).name == "episode_000004"
    by_its_name = replace(mapping, time=Source("timestamp"))
    np.testing.assert_allclose(load_recording(path, by_its_name, episode=1).time, np.arange(5) / 30)
    assert set(load_recording(path, episode=0).columns) == {
        "action/pan", "action/lift", "observation.state/pan", "observation.state/lift",
    }  # fmt: skip


def test_parquet_of_whole_nanoseconds_and_long_lists(tmp_path):
    pa = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    lists = pa.array([[1.0, 2.0], [3.0, 4.0]], type=pa.large_list(pa.float64()))
    stamps = pa.array([1_700_000_000_000_000_001, 1_700_000_000_010_000_001], type=pa.int64())
    parquet.write_table(pa.table({"t": stamps, "q": lists}), tmp_path / "a.parquet")
    recording = load_recording(tmp_path / "a.parquet", LogMapping({"qpos/a": Source("q/1")}, Source("t", unit="ns")))
    assert np.diff(recording.time) == pytest.approx(0.01, abs=1e-6)
    np.testing.assert_array_equal(recording["qpos/a"], [2, 4])
    parquet.write_table(
        pa.table({"time": stamps.cast(pa.timestamp("ns")), "qpos/a": [1.0, 2.0]}), tmp_path / "b.parquet"
    )
    with pytest.raises(ValueError, match=r"column 'time' holds no numbers \(timestamp\[ns\] ...\)"):
        load_recording(tmp_path / "b.parquet")


# --- damaged files --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.csv", b"", "the file is empty"),
        ("a.csv", b"\n\n", "holds no line of data"),
        ("a.csv", b"time,qpos/a\n", "holds no row of data"),
        ("a.csv", b"time,qpos/a\n0\n", "no row has the 2 values"),
        ("a.csv", b"time,qpos/a\n2024-01-01 12:00,1\n", r"column 'time' holds no numbers \('2024-01-01 12:00' ...\)"),
        ("a.csv", b"time,qpos/a,qpos/a\n0,1,2\n", "'qpos/a' appears more than once"),
        ("a.csv", b"t,qpos/a\n0,1\n", "no column 'time' among t, qpos/a"),
        ("a.csv", b"\xff\xfe\x00\x81", "is not UTF-8 text"),
        ("a.npz", b"PK no archive", "cannot be read"),
        ("a.mat", b"no matlab", "cannot be read"),
    ],
)
def test_a_damaged_file_is_a_clear_error(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=message):
        load_recording(tmp_path / name)


def test_parquet_without_or_with_its_package(tmp_path):
    (tmp_path / "a.parquet").write_bytes(b"no parquet")
    installed = importlib.util.find_spec("pyarrow") is not None
    error, message = (ValueError, "cannot be read") if installed else (ImportError, r"simopt-envs\[measured\]")
    with pytest.raises(error, match=message):
        load_recording(tmp_path / "a.parquet")


def test_no_file_can_run_code(tmp_path):
    np.savez(tmp_path / "a.npz", time=np.array([{"code": 1}], dtype=object))
    with pytest.raises(ValueError, match=r"a\.npz cannot be read: .* array 'time' cannot be read"):
        load_recording(tmp_path / "a.npz")


def test_dates_are_no_time_and_a_column_of_stamps_is(tmp_path):
    time, path = np.arange(3.0), tmp_path / "a.npz"
    np.savez(path, time=time[:, None], **{"qpos/a": time})
    np.testing.assert_array_equal(load_recording(path).time, time)
    np.savez(path, time=np.datetime64("2024-01-01") + time.astype("timedelta64[s]"))
    with pytest.raises(ValueError, match=r"a: column 'time' holds no numbers \('2024-01-01T00:00:00' ...\)"):
        load_recording(path)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("decimal commas.csv", "time;qpos/a;note\n0,01;-1,5;a, b\n0,02;2;\n"),
        ("decimal commas, tabs.csv", "time\tqpos/a\n0,01\t-1,5e0\n0,02\t2\n"),
        ("blanks before quotes.csv", '"time", "qpos/a"\n0.01, -1.5\n0.02, 2\n'),
        ("LOUD.CSV", "time,qpos/a\n0.01,-1.5\n0.02,2\n"),
        ("commas at the ends.csv", "time,qpos/a,,\n0.01,-1.5,,\n0.02,2,,\n"),
        ("commas in a name.csv", "time;qpos/a;note (a, b)\n0.01;-1.5;x\n0.02;2;\n"),
    ],
)
def test_text_as_others_write_it(tmp_path, name, content):
    (tmp_path / name).write_text(content)
    recording = load_recording(tmp_path / name)
    np.testing.assert_array_equal(recording.time, [0.01, 0.02])
    assert list(recording.columns) == ["qpos/a"]
    np.testing.assert_array_equal(recording["qpos/a"], [-1.5, 2])


def test_decimal_commas_are_told_from_thousands_and_from_columns(tmp_path):
    (tmp_path / "a.csv").write_text("time\tqpos/a\n0\t999.5\n1\t1,000.5\n")
    assert np.isnan(load_recording(tmp_path / "a.csv")["qpos/a"][1]), "no number is better than a wrong one"
    (tmp_path / "b.csv").write_text("0,01;1,5\n0,02;2\n")
    mapping = LogMapping({"qpos/a": Source("a")}, column_names=("time", "a"))
    np.testing.assert_array_equal(load_recording(tmp_path / "b.csv", mapping)["qpos/a"], [1.5, 2])


def test_rows_that_broke_and_cells_that_are_no_numbers_are_named(tmp_path):
    (tmp_path / "a.csv").write_text("time,qpos/a,mode\n0,1,run\n0.1,,run\n0.2,3\n0.3,err,run\n0.4,5,ru")
    recording = load_recording(tmp_path / "a.csv")
    np.testing.assert_allclose(recording.time, [0, 0.1, 0.3, 0.4])
    np.testing.assert_array_equal(recording["qpos/a"], [1, np.nan, np.nan, 5])
    assert list(recording.columns) == ["qpos/a"], "a column of text is no signal"
    (tmp_path / "b.csv").write_text("time,qpos/a,comment\n0,1,\n0.1,2,hit\n0.2,3,")
    assert list(load_recording(tmp_path / "b.csv").columns) == ["qpos/a"]
    messages = [str(warning) for warning in recording.warnings]
    assert messages == [
        "warning: 1 of 5 rows left out: they do not have 3 values; the first is data row 3",
        "warning: qpos/a: 1 cells are no numbers and read as missing, the first is 'err'",
    ]


def test_a_broken_row_keeps_its_place_where_rows_are_counted(tmp_path):
    (tmp_path / "a.txt").write_text("1\n2\n\n4\n5 6\n7\n\n")
    mapping = LogMapping({"qpos/a": Source("a")}, time=None, sample_rate=10.0, column_names=("a",))
    recording = load_recording(tmp_path / "a.txt", mapping)
    np.testing.assert_allclose(recording.time, np.arange(6) / 10)
    np.testing.assert_array_equal(recording["qpos/a"], [1, 2, np.nan, 4, np.nan, 7])
    assert "2 of 6 rows read as missing" in str(recording.warnings[0])


# --- real logs ------------------------------------------------------------------------------------------------------


def test_warnings_of_many_recordings_are_told_once():
    def log(name: str, *missing: str) -> Recording:
        found = tuple(Finding.warning(channel, "missing", f"{len(name)} are") for channel in missing)
        return Recording(np.arange(3.0), {}, name, found)

    logs = [log("one"), log("second", "qpos/a", "qpos/b"), log("third", "qpos/a"), log("fourth", "qpos/a", "qpos/a")]
    assert [str(warning) for warning in warnings_of(logs)] == [
        "warning: qpos/a: 6 are (second; 2 more like it)",
        "warning: qpos/b: 6 are (second)",
        "warning: qpos/a: 6 are (fourth)",
    ]
