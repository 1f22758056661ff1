"""The report of a run: what it says, that it stands alone, and the films."""

import json
import re
import sys
from pathlib import Path

import gymnasium as gym
import imageio.v3 as iio
import matplotlib
import numpy as np
import pytest
from toy_reach import SPACE, LeanTrainer, ReachEnv

from simopt_envs.adaptation import HiddenSystem, SimOpt
from simopt_envs.distributions import Gaussian
from simopt_envs.report import Details, Run, write_report
from simopt_envs.report.figures import overlay_figure, parameters_figure
from simopt_envs.report.film import film_policies, record_clip, strip_figure
from simopt_envs.report.sections import directions

TRUTH = {"force": 0.6, "gain": 1.3}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A run of two iterations on the toy."""
    directory = tmp_path_factory.mktemp("run") / "out"
    loop = SimOpt(
        "Toy/Reach-v0",
        Gaussian.around_nominal(SPACE, [0.2, 0.3, 0.2]),
        LeanTrainer(),
        HiddenSystem("Toy/Reach-v0", TRUTH, noise=0.005, dropout=0.05),
        simulated_rollouts=60,
        evaluation_episodes=20,
        directory=directory,
    )
    list(loop.run(2))
    return directory


@pytest.fixture
def run(finished, tmp_path):
    """A copy of that run's folder."""
    for source in finished.rglob("*"):
        if source.is_file():
            copy = tmp_path / source.relative_to(finished)
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(source.read_bytes())
    return tmp_path


def text_of(page):
    """What a reader sees: without style, tags and embedded data."""
    html = re.sub(r"<style>.*?</style>", "", page.read_text(), flags=re.S)
    return re.sub(r"\s+", " ", re.sub(r"<[^>]*>", " ", html))


def test_the_page_tells_the_run(run):
    Details("simopt-envs adapt Toy/Reach-v0", "the toy", 0.1, TRUTH, ("a warning",), {"mujoco": "1.2.3"}).save(run)
    size = matplotlib.rcParams["font.size"]
    text = text_of(write_report(run))
    assert matplotlib.rcParams["font.size"] == size  # the user's style is left alone
    entries = json.loads((run / "result.json").read_text())["iterations"]
    first, last = entries[0], entries[-1]
    assert f"{first['target_success']:.0%} → {last['target_success']:.0%}" in text
    assert f"{first['discrepancy']['min']:.3g} → {last['discrepancy']['min']:.3g}" in text
    assert f"{sum(e['sim_rollouts'] for e in entries):,}" in text
    for expected in (
        last["verdict"]["label"],
        "a warning",
        "1.2.3",
        "adapt Toy/Reach-v0",
        "the toy · 2 iterations",
        *SPACE.names,
    ):
        assert expected in text
    assert "update.epsilon" in text  # the settings
    assert "hidden truth" in text


def test_the_truth_is_shown_only_where_it_is_known(run):
    def legend():
        return [text.get_text() for text in parameters_figure(Run.load(run)).legends[0].get_texts()]

    assert "hidden truth" not in legend()  # no details at all
    Details(truth=None).save(run)
    assert "hidden truth" not in legend()
    Details(truth={}).save(run)  # known to be nominal
    assert "hidden truth" in legend()
    np.testing.assert_array_equal(Run.load(run).truth, SPACE.nominal)


def test_channels_have_the_units_that_are_known_and_dollars_as_they_are(run):
    result = json.loads((run / "result.json").read_text())
    names = result["observation_names"]
    (run / "result.json").write_text(json.dumps(result | {"observation_names": ["$a_1$", *names[1:]]}))
    Details(channel_units={"$a_1$": "rad"}).save(run)
    axes = overlay_figure(Run.load(run)).axes
    labels = {axis.yaxis.label.get_text(): axis.yaxis.label.get_parse_math() for axis in axes if axis.get_ylabel()}
    assert labels == {"$a_1$\n[rad]": False} | dict.fromkeys(names[1:], True)


def test_the_page_stands_alone(run):
    (run / "film.png").write_bytes(iio.imwrite("<bytes>", np.zeros((8, 8, 3), np.uint8), extension=".png"))
    html = write_report(run).read_text()
    links = re.findall(r'(?:src|href)="([^"]{0,30})', html)
    assert len(links) == 5  # film, progress, parameters, overlays, correlation
    assert all(link.startswith("data:") for link in links)
    assert not re.search(r"https?://|@import|url\(", html)


def test_plots_are_written_and_not_blank(run):
    write_report(run)
    plots = sorted((run / "plots").iterdir())
    assert [p.name for p in plots] == ["correlation.png", "overlays.png", "parameters.png", "progress.png"]
    for plot in plots:
        picture = iio.imread(plot)
        assert min(picture.shape[:2]) > 300
        assert picture.std() > 5


def test_what_users_write_is_escaped(run):
    Details(command="<script>alert(1)</script>").save(run)
    html = write_report(run).read_text()
    assert "<script>" not in html
    assert "&lt;script&gt;" in html


def test_a_run_without_policies_trajectories_or_successes(run):
    result = json.loads((run / "result.json").read_text())
    result["iterations"] = result["iterations"][:1]
    for entry in result["iterations"]:
        entry["target_success"] = entry["sim_success"] = None
    (run / "result.json").write_text(json.dumps(result))
    for file in (run / "checkpoints").rglob("*.npz"):
        file.unlink()
    text = text_of(write_report(run))
    assert "Success on the target" not in text
    assert "Simulation against measurement" not in text


@pytest.mark.parametrize(
    ("content", "error", "message"),
    [
        (None, FileNotFoundError, "holds no result.json"),
        ("{", ValueError, "not valid JSON"),
        ("[]", ValueError, "must hold a JSON object"),
        ('{"effects": []}', ValueError, "not the result of an adaptation"),
    ],
)
def test_folders_without_a_run(tmp_path, content, error, message):
    if content is not None:
        (tmp_path / "result.json").write_text(content)
    with pytest.raises(error, match=message):
        write_report(tmp_path)
    assert not (tmp_path / "report.html").exists()


def test_directions_find_the_combination_that_was_determined():
    prior = np.array([0.1, 0.5, 2.0])
    direction = np.array([0.6, -0.8, 0.0])  # in prior standard deviations
    white = np.eye(3) - (1 - 0.05**2) * np.outer(direction, direction)
    result = {"parameter_names": ["a", "b", "c"], "iterations": []}
    for covariance in (np.diag(prior**2), prior[:, None] * white * prior):
        result["iterations"].append({"covariance": covariance.tolist()})
    found = list(directions(Run(Path(), result, {}, Details())))
    assert found[0]["text"] == "0.80 b − 0.60 a"
    np.testing.assert_allclose([d["ratio"] for d in found], [0.05, 1.0, 1.0], rtol=1e-9)


class PaintedEnv(ReachEnv):
    """Renders how far the mass is as brightness."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012

    def __init__(self, render_mode=None, broken=False):
        super().__init__()
        self.render_mode, self.broken = render_mode, broken

    def render(self):
        if self.broken:
            raise AttributeError("'NoneType' object has no attribute 'eglQueryString'")
        return np.full((30, 41, 3), int(np.clip(100 * self.state[0, 0], 0, 255)), np.uint8)


gym.register("Toy/Painted-v0", entry_point=PaintedEnv)
gym.register("Toy/Broken-v0", entry_point=PaintedEnv, kwargs={"broken": True})


class Constant:
    def __init__(self, force):
        self.force = force

    def act(self, observations):
        return np.full((len(observations), 1), self.force)


def test_a_clip_shows_the_episode_under_the_given_physics():
    strong, weak = (record_clip("Toy/Painted-v0", Constant(0.5), {"gain": gain}, "x") for gain in (2.0, 0.5))
    assert strong.period == pytest.approx(0.1)  # every second of 20 frames a second
    assert strong.frames.shape == (21, 30, 41, 3)  # the start and every second of 40 steps
    assert strong.frames[-1].mean() > 1.5 * weak.frames[-1].mean()
    assert strong.frames[0].mean() == weak.frames[0].mean()
    assert strong.caption == "x: no success"


@pytest.mark.parametrize("has_ffmpeg", [True, False])
def test_films(tmp_path, monkeypatch, has_ffmpeg):
    if has_ffmpeg:
        pytest.importorskip("imageio_ffmpeg")
    else:
        monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    policies = {"before": Constant(0.2), "after": Constant(1.0)}
    strip, film = film_policies("Toy/Painted-v0", policies, {}, tmp_path)
    assert strip == tmp_path / "film.png"
    assert film.suffix == (".mp4" if has_ffmpeg else ".gif")
    frames = iio.imread(film, **({"plugin": "FFMPEG"} if has_ffmpeg else {}))
    assert len(frames) > 20
    half = frames.shape[2] // 2
    before, after = frames[-1, -8:, :half].mean(), frames[-1, -8:, half + 4 :].mean()
    assert after > 1.5 * before


def test_a_film_that_is_cut_short_leaves_no_strip(tmp_path, monkeypatch):
    def killed(clips, path):
        raise KeyboardInterrupt

    monkeypatch.setattr("simopt_envs.report.film.write_film", killed)
    with pytest.raises(KeyboardInterrupt):
        film_policies("Toy/Painted-v0", {"before": Constant(0.2)}, {}, tmp_path)
    assert not (tmp_path / "film.png").exists()


def test_the_strip_has_a_row_of_frames_for_each_policy():
    clips = [record_clip("Toy/Painted-v0", Constant(1.0), {}, label) for label in ("before", "after")]
    panels = strip_figure(clips).axes
    assert len(panels) == 12
    assert [panels[i].get_title(loc="left") for i in (0, 6)] == [clip.caption for clip in clips]


@pytest.mark.parametrize(
    ("env_id", "message"), [("Toy/Broken-v0", "OpenGL cannot draw here"), ("Toy/Reach-v0", "does not render")]
)
def test_where_nothing_can_be_drawn(tmp_path, env_id, message):
    with pytest.raises(RuntimeError, match=message):
        film_policies(env_id, {"before": Constant(0.0)}, {}, tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_missing_package_is_named(monkeypatch):
    for module in [m for m in sys.modules if m.startswith("simopt_envs.report")]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, "jinja2", None)
    with pytest.raises(ImportError, match=r"jinja2: pip install \"simopt-envs\[report\]\""):
        import simopt_envs.report  # noqa: F401
