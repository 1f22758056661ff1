"""The figures of a gap report, and the page."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from conftest import needs_effects
from gap_plant import MODEL

from simopt_envs.gap.confusion import Partner, Separation
from simopt_envs.gap.curves import Curve
from simopt_envs.gap.error import moving_channels
from simopt_envs.gap.figures import candidates_figure, curve_figure, error_figure, overlay_figure, regime_figure
from simopt_envs.gap.hypothesis import Candidate
from simopt_envs.gap.localise import Partition, Row, tabulate
from simopt_envs.gap.report import diff, effects, table, verdict, warnings
from simopt_envs.gap.result import Estimate, Named, two_directions
from simopt_envs.measured.channels import Channel
from simopt_envs.measured.recording import Recording
from simopt_envs.measured.states import States
from simopt_envs.measured.windows import Windows
from simopt_envs.physics.effects import EFFECTS
from simopt_envs.report.figures import save_figure
from simopt_envs.report.page import write_page

pytestmark = needs_effects


RNG = np.random.default_rng(0)
WINDOWS, SAMPLES = 6, 20


@pytest.fixture
def windows():
    """Two recordings of three windows of a joint that moves and one that stands."""
    time = np.arange(SAMPLES) * 0.02
    starts = np.tile([0.0, 0.5, 1.0], 2)
    moves = np.sin(starts[:, None] + time)
    noise = 1e-3 * RNG.standard_normal((WINDOWS, SAMPLES, 2))
    return Windows(
        channels=tuple(Channel(f"qpos/{name}", "qpos", i, i, "rad") for i, name in enumerate(("elbow", "locked"))),
        offsets=time,
        start_time=starts,
        recording=("a",) * 3 + ("b",) * 3,
        measured=np.stack([moves, np.zeros_like(moves)], axis=-1) + noise,
        commands=np.zeros((WINDOWS, SAMPLES - 1, 0)),
        past_commands=np.zeros((WINDOWS, 1, 0)),
        starts=States(*(np.zeros((WINDOWS, 2)) for _ in range(5))),
        stride=1,
        rounding=np.zeros(2),
    )


def test_overlays_show_channels_that_move(windows):
    simulated = [windows.measured + offset for offset in (0.1, 0.05, 0.0)]
    figure = overlay_figure(windows, simulated, np.full(2, 1e-3))
    assert [axis.get_title(loc="left") for axis in figure.axes] == ["qpos/elbow", "simulated minus measured"]
    assert [axis.get_ylabel() for axis in figure.axes] == ["[rad]", ""]
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == ["measured", "as given", "refitted", "repaired"]
    errors = [line for line in figure.axes[1].lines if line.get_label() == "repaired"]
    assert all(np.allclose(line.get_ydata(), 0.0) for line in errors)


@pytest.mark.parametrize("name", ["time in it", "speed of arm: elbow $x_1$"])
def test_regimes_are_blank_within_the_noise(name, tmp_path):
    late = np.zeros((24, SAMPLES), dtype=bool)
    late[:, SAMPLES // 2 :] = True
    errors = RNG.standard_normal((24, SAMPLES, 2))
    errors[..., 0] += 4.0 * late
    parts = [Partition("all", {"": np.ones_like(late)}), Partition(name, {"early": ~late, "late": late})]
    rows = tabulate(["qpos/elbow", "qpos/wrist"], errors, np.ones(errors.shape, dtype=bool), parts)
    figure = regime_figure(rows)
    bars, cells = figure.axes[:2]
    assert save_figure(figure, tmp_path / "regimes.png").exists()
    assert [text.get_parse_math() for text in cells.texts if name.split()[-1] in text.get_text()] == ["$" not in name]
    assert [label.get_text() for label in bars.get_yticklabels()] == ["qpos/elbow", "qpos/wrist"]
    assert [label.get_text() for label in cells.get_xticklabels()] == ["early", "late"]
    shown = cells.images[0].get_array()
    assert np.isfinite(shown.filled(np.nan)[0, 1])
    assert np.isnan(shown.filled(np.nan)[:, 0]).all()


@pytest.mark.parametrize(
    ("refit", "after", "said"),
    [
        (0.5, 0.2, "That explains 75% of the error that noise does not; the rest"),
        (0.5, 0.1, "With it, the mean square of the errors is 2.4 times that of noise; the rest"),
    ],
)
def test_a_part_that_is_named_never_explains_all(refit, after, said):
    gap = SimpleNamespace(
        verdict="partly",
        errors=SimpleNamespace(before=1.0, refit=refit, after=after, noise_floor=0.1),
        effects=["coulomb_friction at joint:elbow"],
        explanation=SimpleNamespace(final=SimpleNamespace(excess=1.4)),
        remarks=(),
    )
    assert said in verdict(gap, None).content["sentence"]


def test_what_moves_is_told_from_noise():
    scale, noise = np.array([1.0, 1e-3]), np.full(2, 1e-3)
    assert moving_channels(("qpos/a", "qpos/b"), scale, noise).tolist() == [True, False]
    with pytest.raises(ValueError, match="nothing moves in the recordings held out: qpos/b show noise alone"):
        moving_channels(("qpos/b",), scale[1:], noise[1:])


def test_regimes_of_a_model_without_any():
    assert regime_figure([Row("qpos/elbow", "all", 1.0, 1.0, 0.3)]).axes


@pytest.mark.parametrize("values", [(0.4, 0.2, 0.05), (40.0, 0.2, 0.05), (0.4, 0.2)])
def test_errors_with_their_noise_floor(tmp_path, values):
    figure = error_figure(values, [(0.9 * v, 1.1 * v) for v in values], 0.04)
    axis = figure.axes[0]
    assert [label.get_text() for label in axis.get_yticklabels()] == ["as given", "refitted", "repaired"][: len(values)]
    assert axis.get_xscale() == ("log" if values[0] > 1 else "linear")
    assert "noise floor 0.04" in axis.get_legend_handles_labels()[1]
    assert save_figure(figure, tmp_path / "errors.png").stat().st_size > 5000


def test_candidates_and_curve(tmp_path):
    figure = candidates_figure(["one", "two"], [500.0, -3.0], [80.0, -50.0], [1.02, 38.1], 5.0, 20.0)
    assert [bar.get_width() for bar in figure.axes[0].patches] == [500.0, -3.0, 80.0, -50.0]
    assert [label.get_text() for label in figure.axes[0].child_axes[0].get_yticklabels()] == ["1.02", "38.10"]
    assert save_figure(figure, tmp_path / "candidates.png").exists()
    x = np.linspace(-1, 1, 30)
    curve = Curve("force on elbow", "N m", "velocity of elbow", "rad/s", 0.9, x, x**3, np.tile(x**3, (4, 1)))
    axis = curve_figure(curve).axes[0]
    assert axis.get_ylabel() == "missing force on elbow [N m]"
    assert len(axis.lines) == 4 + 1 + 1  # each recording, all together, zero


def test_friction_and_a_constant_force_are_told_as_friction_of_two_directions():
    model = mujoco.MjModel.from_xml_string(MODEL)

    def of(effect, place, **numbers):
        parameters = {n: Estimate(x, "N m", (x - 0.1, x + 0.1)) for n, x in numbers.items()}
        return Named(Candidate(EFFECTS[effect], place), parameters, {}, ())

    friction, force = (
        of("coulomb_friction", "joint:elbow", frictionloss=2.0),
        of("actuator_bias", "actuator:elbow", force=-0.5),
    )
    (told,) = two_directions(model, [friction, force])
    assert "2.5 N m forwards, 1.5 N m backwards, 1 N m [0.8, 1.2] apart" in told
    elsewhere, stronger = (
        of("actuator_bias", "actuator:shoulder", force=-0.5),
        of("actuator_bias", "actuator:elbow", force=3.0),
    )
    assert not [*two_directions(model, [friction, elsewhere]), *two_directions(model, [friction, stronger])]


def test_sections_say_it_in_html(tmp_path):
    coulomb = Candidate(EFFECTS["coulomb_friction"], "joint:elbow")
    deadband, delay, bias = (
        Candidate(EFFECTS[name], "actuator:e") for name in ("deadband", "actuator_delay", "actuator_bias")
    )
    commands = Recording(np.arange(3) * 0.02, {"ctrl/e": np.zeros(3)}, "fast reversals")
    partners = (
        Partner(deadband, 0.93, 12.0, Separation(commands, 0.4, nats=140.2, nats_recorded=3.1)),
        Partner(delay, 0.92, None, Separation(commands, 0.99, nats=0.7, nats_recorded=0.2)),
        Partner(bias, 0.91, None),
    )
    named = Named(coulomb, {"frictionloss": Estimate(0.208, "N m", (0.201, 0.216))}, {}, partners)
    sections = [
        *effects([named]),
        diff("--- a\n+++ b\n@@ -1 +1 @@\n-<joint/>\n+<joint frictionloss='0.2'/>\n"),
        *warnings(["qpos/elbow: gaps"]),
        table("Empty", ("a", "b"), [], hint="nothing moved"),
    ]
    page = write_page(tmp_path / "report.html", "title", "subtitle", sections).read_text()
    for text in ("coulomb_friction at joint:elbow", "0.201 … 0.216", "f = -F sign(v)", "12 nats behind"):
        assert text in page
    for text in (
        "deadband at actuator:e</code> (correlation 0.93, 12 nats behind): to tell them apart: fast reversals (expected"
        " 140 nats; the recordings here: 3), commands in separate/coulomb_friction.elbow_vs_deadband.e.csv",
        "actuator_delay at actuator:e</code> (correlation 0.92): no motion tried would tell them apart",
        "actuator_bias at actuator:e</code> (correlation 0.91): nothing to command",
    ):
        assert text in page
    assert "vs_actuator_delay" not in page  # there is no such file
    assert "&lt;joint frictionloss=&#39;0.2&#39;/&gt;" in page
    assert "qpos/elbow: gaps" in page
    assert "nothing moved" in page
    assert list(effects([])) == []
    assert list(warnings([])) == []
