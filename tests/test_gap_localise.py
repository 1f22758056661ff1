"""Where errors are: shares, lifts and z-scores of channels and regimes."""

import mujoco
import numpy as np
import pytest
from conftest import needs_effects

from simopt_envs.gap.circumstances import Circumstances, circumstances
from simopt_envs.gap.localise import EVERYWHERE, Partition, localise, partitions, tabulate
from simopt_envs.measured import cut_windows
from simopt_envs.measured.recording import Recording

pytestmark = needs_effects


CHANNELS = ("qpos/a", "qpos/b", "qpos/c")
SLIDER = """
<mujoco><option timestep="0.005" gravity="0 0 0"/><worldbody>
  <body><joint name="slide" type="slide" axis="1 0 0"/><geom size="0.1" mass="1" contype="0" conaffinity="0"/></body>
</worldbody><actuator><position name="drive" joint="slide" kp="100" kv="20"/></actuator></mujoco>
"""


def sliding(windows=24, samples=26, period=0.02):
    """The circumstances of one joint on a sine of 1 Hz, with a command step in each window."""
    time = np.arange(windows * samples).reshape(windows, samples) * period
    phase = 2 * np.pi * time
    command = np.where(np.arange(samples) < 13, 0.0, 1.0) * np.ones((windows, 1))
    return Circumstances(
        joints=("slide",),
        actuators=("drive",),
        position=np.sin(phase)[..., None],
        velocity=2 * np.pi * np.cos(phase)[..., None],
        acceleration=-4 * np.pi**2 * np.sin(phase)[..., None],
        load=np.cos(3 * phase)[..., None],
        command=command[..., None],
        contact=np.zeros(time.shape, dtype=bool),
        stopped=np.abs(np.sin(phase))[..., None] > 0.99,
        time=time,
        period=period,
    )


def rows_of(errors, around):
    return tabulate(CHANNELS[: errors.shape[2]], errors, np.ones(errors.shape, dtype=bool), partitions(around))


def test_shares_of_a_partition_sum_to_one():
    around = sliding()
    rows = rows_of(np.random.default_rng(0).standard_normal((24, 26, 3)), around)
    totals: dict[str, float] = {}
    for row in rows:
        partition = row.regime.split(": ")[0]
        totals[partition] = totals.get(partition, 0.0) + row.share
    assert {"all", "speed of slide", "position of slide", "command", "time in the recording"} <= set(totals)
    assert "contact" not in totals  # nothing ever touches: there is nothing to tell apart
    assert list(totals.values()) == pytest.approx([1.0] * len(totals))
    assert [row.share for row in rows] == sorted((row.share for row in rows), reverse=True)


def test_scores_are_standard_normal_without_a_gap():
    """Noise whose size was estimated, as a search does, from second differences of as many samples."""
    rng, around, z = np.random.default_rng(1), sliding(), []
    for _ in range(40):
        noise = rng.standard_normal((24, 26, 3))
        scale = np.sqrt(np.mean(np.diff(noise, n=2, axis=1) ** 2, axis=(0, 1)) / 6)
        z += [row.z for row in rows_of(rng.standard_normal(noise.shape) / scale, around)]
    assert abs(np.mean(z)) < 0.25
    assert 0.8 < np.std(z) < 1.15
    assert np.mean(np.abs(z) > 3) < 0.01


def test_finds_the_channel_and_the_regime():
    rng, around = np.random.default_rng(2), sliding()
    errors = rng.standard_normal((24, 26, 3))
    fast = np.abs(around.velocity[..., 0]) > 5.0
    errors[..., 1] += 3.0 * fast
    rows = {(row.channel, row.regime): row for row in rows_of(errors, around)}
    assert next(iter(rows)) == ("qpos/b", EVERYWHERE)
    high, low = (rows["qpos/b", f"speed of slide: {part}"] for part in ("high", "low"))
    assert high.z > 8
    assert high.lift > 1.5
    assert abs(low.z) < 4
    assert low.lift < 0.5
    assert all(abs(row.z) < 4 for (channel, _), row in rows.items() if channel != "qpos/b")


def test_errors_of_one_window_are_not_taken_for_many():
    """Sixteen samples that go together in each window scatter as much as one: no z beyond chance."""
    rng, z = np.random.default_rng(3), []
    everywhere = [Partition(EVERYWHERE, {"": np.ones((24, 16), dtype=bool)})]
    for _ in range(200):
        errors = np.repeat(rng.standard_normal((24, 1, 1)), 16, axis=1)
        z += [row.z for row in tabulate(["x"], errors, np.ones(errors.shape, dtype=bool), everywhere)]
    assert 0.7 < np.std(z) < 1.6
    assert np.mean(np.array(z) > 3) < 0.01


def test_a_gap_in_one_of_three_recordings_does_not_hide_itself():
    """What grows in one recording of three scatters as much as it is; a quarter more than noise in a window is none."""
    rng, around = np.random.default_rng(4), sliding()
    errors = rng.standard_normal((24, 26, 3))
    errors[:8, :, 0] *= np.linspace(1, 60, 8)[:, None]
    errors[:1, :, 1] *= 1.25
    rows = {row.channel: row for row in rows_of(errors, around) if row.regime == EVERYWHERE}
    assert rows["qpos/a"].z > 100
    assert abs(rows["qpos/b"].z) < 3
    assert abs(rows["qpos/c"].z) < 3


@pytest.mark.parametrize("drive", ["", "timeconst='0.1'"])
def test_the_load_is_what_a_drive_gives_by_what_it_was_told_before(drive):
    model = mujoco.MjModel.from_xml_string(SLIDER.replace('kv="20"', f'kv="20" {drive}'))
    data, rows = mujoco.MjData(model), []
    for i in range(200):
        data.ctrl[0] = 0.5 * np.sin(0.02 * i)
        mujoco.mj_forward(model, data)
        rows.append([data.ctrl[0], data.qpos[0], data.qfrc_actuator[0]])
        mujoco.mj_step(model, data)
    command, position, force = np.array(rows).T
    log = Recording(0.005 * np.arange(200), {"ctrl/drive": command, "qpos/slide": position})
    windows = cut_windows(model, log, seconds=0.2)
    around = circumstances(model, windows)
    told = np.interp(around.time[:, 5:-5], 0.005 * np.arange(200) - windows.start_time[0], force)
    np.testing.assert_allclose(around.load[:, 5:-5, 0], told, atol=0.1 * np.abs(force).max())


def test_reversals_holds_and_steps():
    around = sliding(windows=1, samples=100)
    still = Circumstances(**{**vars(around), "velocity": np.where(around.time[..., None] < 0.5, 0.0, around.velocity)})
    assert still.held()[0, :25].all()
    assert not still.held()[0, 26:].any()
    assert not around.held().any()  # it turns round, and never stays
    turns = np.flatnonzero(np.diff(around.direction()[0, :, 0]))
    assert turns * around.period == pytest.approx([0.25, 0.75, 1.25, 1.75], abs=0.03)
    assert np.flatnonzero(around.stepped()[0]).tolist() == [13]


def test_what_a_stop_does_is_told_by_its_regime():
    """A joint that touches both ends of its range in every second, of which the model knows little."""
    around = sliding()
    errors = np.random.default_rng(5).standard_normal((24, 26, 3))
    errors[..., 1] *= np.where(around.stopped[..., 0], 6.0, 1.0)
    rows = rows_of(errors, around)
    most = max((row for row in rows if row.regime != EVERYWHERE and row.lift > 1), key=lambda row: row.telling)
    assert (most.channel, most.regime) == ("qpos/b", "stop of slide: just reached")


@pytest.mark.parametrize(("limited", "at"), [("true", [0, 3, 4]), ("false", [])])
def test_joints_at_an_end_of_their_range(limited, at):
    xml = SLIDER.replace('axis="1 0 0"', f'axis="1 0 0" limited="{limited}" range="-1 0.5"')
    time = 0.02 * np.arange(31)
    position = np.interp(time, [0, 0.15, 0.3, 0.45, 0.6], [-1, -0.9, 0, 0.498, 0.51])
    model = mujoco.MjModel.from_xml_string(xml)
    windows = cut_windows(model, Recording(time, {"ctrl/drive": 0 * time, "qpos/slide": position}, "run"), 0.6)
    around = circumstances(model, windows)
    assert np.isin([0, 8, 15, 23, 30], np.flatnonzero(around.stopped[0, :, 0])).nonzero()[0].tolist() == at


def test_follows_measured_joints_and_simulates_the_others():
    model = mujoco.MjModel.from_xml_string(SLIDER)
    time = np.arange(0, 4, 0.02)
    columns = {"ctrl/drive": np.zeros_like(time), "qpos/slide": np.sin(3 * time)}
    windows = cut_windows(model, Recording(time, columns, "sine"), 0.5)
    around = circumstances(model, windows)
    inner = slice(3, -3)  # where the polynomials are centred
    assert around.position[:, inner, 0] == pytest.approx(np.sin(3 * around.time)[:, inner], abs=1e-3)
    assert around.velocity[:, inner, 0] == pytest.approx(3 * np.cos(3 * around.time)[:, inner], abs=0.05)
    force = -100 * around.position - 20 * around.velocity
    assert around.load == pytest.approx(force, abs=1e-9)
    rows = localise(windows, np.zeros(windows.measured.shape), model)
    assert {row.channel for row in rows} == {"qpos/slide"}
    whole = cut_windows(model, Recording(time, columns, "sine"))
    early = np.where(whole.offsets[None, :, None] < 1.0, 3.0, 1.0)
    (alone,) = localise(whole, early, model)
    assert alone.regime == EVERYWHERE
    assert 0 < alone.z < 2, "one window tells nothing of what goes with what"
    by_regime = {row.regime: row for row in localise(whole, early, model, parts=20)}
    assert by_regime["time in the recording: early"].lift > 2 > by_regime["time in the recording: late"].lift
