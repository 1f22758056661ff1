"""Films of policies in a registered environment, side by side: a strip of frames, and an MP4 or GIF."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import gymnasium as gym
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from numpy.typing import NDArray

from simopt_envs.adaptation.protocols import Policy
from simopt_envs.report.figures import GREEN, INK, ORANGE, save_figure, styled

Frames = NDArray[np.uint8]
STRIP = "film.png"
_FRAME_RATE = 10.0  # per second; a frame can take half a second to draw without a graphics card
_STRIP_FRAMES = 6
_LAST_FRAME_HOLDS = 1.5  # s
_CAPTION_HEIGHT = 40  # pixels


@dataclass(frozen=True)
class Clip:
    """One episode, as drawn.

    Attributes:
        label: what it shows.
        frames: (n, height, width, 3).
        period: seconds from one frame to the next.
        success: whether the episode ended in success; None where the environment does not tell.
    """

    label: str
    frames: Frames
    period: float
    success: bool | None

    @property
    def caption(self) -> str:
        """The label and how it ended."""
        return self.label if self.success is None else f"{self.label}: {'success' if self.success else 'no success'}"


def film_policies(
    env_id: str, policies: Mapping[str, Policy], parameters: Mapping[str, float], directory: Path, seed: int = 0
) -> list[Path]:
    """Film an episode of each policy under the same physics from the same start.

    Args:
        env_id: a registered environment that renders "rgb_array".
        policies: label -> policy, in the order of the film.
        parameters: name -> value of what differs from nominal.
        directory: where ``film.png`` (the strip) and ``film.mp4`` or ``film.gif`` are written.
        seed: of the episodes.

    Raises:
        RuntimeError: where nothing can be drawn, saying why: no render mode, no OpenGL, a package missing.
    """
    try:
        import imageio.v3  # noqa: F401
    except ImportError:
        raise RuntimeError('a film needs imageio: pip install "simopt-envs[report]"') from None
    clips = [record_clip(env_id, policy, parameters, label, seed) for label, policy in policies.items()]
    moving = write_film(clips, directory / "film")
    strip = save_figure(strip_figure(clips), directory / f".{STRIP}")
    return [strip.replace(directory / STRIP), moving]  # last and at once: where there is a strip, all is there


def record_clip(env_id: str, policy: Policy, parameters: Mapping[str, float], label: str, seed: int = 0) -> Clip:
    """Run one episode and draw about ten frames a second; see :func:`film_policies`."""
    if "rgb_array" not in _render_modes(env_id):
        raise RuntimeError(f"{env_id} does not render (its render_modes lack 'rgb_array')")
    env = gym.make(env_id, render_mode="rgb_array")
    try:
        fps = float(env.metadata.get("render_fps", _FRAME_RATE))
        every = max(1, round(fps / _FRAME_RATE))
        observation, _ = env.reset(seed=seed, options={"parameters": dict(parameters)})
        frames, done, step, info = [_draw(env)], False, 0, dict[str, object]()
        while not done:
            action = np.asarray(policy.act(np.asarray(observation, dtype=np.float64)[None]))[0]
            observation, _, terminated, truncated, info = env.step(action)
            done, step = terminated or truncated, step + 1
            if done or step % every == 0:
                frames.append(_draw(env))
    finally:
        env.close()
    return Clip(label, np.stack(frames), every / fps, bool(info["is_success"]) if "is_success" in info else None)


@styled
def strip_figure(clips: Sequence[Clip]) -> Figure:
    """A row of frames for each clip, evenly spread over the episode."""
    height, width = clips[0].frames.shape[1:3]
    cell = 11.0 / _STRIP_FRAMES  # inches
    layout = ConstrainedLayoutEngine(w_pad=0.02, h_pad=0.03, wspace=0.0, hspace=0.02)
    figure = Figure(figsize=(11.0, (cell * height / width + 0.28) * len(clips)), layout=layout)
    panels = figure.subplots(len(clips), _STRIP_FRAMES, squeeze=False)
    for clip, row in zip(clips, panels, strict=True):
        chosen = np.linspace(0, len(clip.frames) - 1, _STRIP_FRAMES).round().astype(int)
        for frame, axis in zip(chosen, row, strict=True):
            axis.imshow(clip.frames[frame])
            axis.set_axis_off()
            time = f"{frame * clip.period:.1f} s"
            axis.annotate(time, (0.97, 0.95), xycoords="axes fraction", ha="right", va="top", size=8)
        row[0].set_title(clip.caption, color=_colour(clip))
    return figure


def write_film(clips: Sequence[Clip], path: Path) -> Path:
    """Write the clips side by side; MP4 where ``imageio-ffmpeg`` is installed, else a GIF of half the size.

    Args:
        clips: of equal frame size; one that ends early shows its last frame until all have ended.
        path: of the file, without suffix.

    Returns:
        The file's path.
    """
    import imageio.v3 as iio

    period, length = clips[0].period, max(len(clip.frames) for clip in clips)
    pictures = np.concatenate([_captioned(clip, length) for clip in clips], axis=2)
    pictures = np.concatenate([pictures, np.repeat(pictures[-1:], round(_LAST_FRAME_HOLDS / period), axis=0)])
    if importlib.util.find_spec("imageio_ffmpeg") is not None:
        film = path.with_suffix(".mp4")
        iio.imwrite(film, _even(pictures), plugin="FFMPEG", fps=1 / period, codec="libx264", macro_block_size=2)
    else:
        film = path.with_suffix(".gif")
        iio.imwrite(film, pictures[:, ::2, ::2], duration=1000 * period, loop=0)
    return film


def _draw(env: gym.Env) -> Frames:
    try:
        return np.asarray(env.render(), dtype=np.uint8)
    except RuntimeError:
        raise  # says already what is missing
    except Exception as error:  # environments of others: drivers and bindings fail in ways of their own
        raise RuntimeError(f"OpenGL cannot draw here ({type(error).__name__}: {error})") from error


def _render_modes(env_id: str) -> Sequence[str]:
    env = gym.make(env_id)
    env.close()
    return env.metadata.get("render_modes", ())


def _colour(clip: Clip) -> str:
    return INK if clip.success is None else GREEN if clip.success else ORANGE


def _captioned(clip: Clip, length: int) -> Frames:
    """The frames under a line of text, the last one repeated up to a length."""
    frames = np.concatenate([clip.frames, np.repeat(clip.frames[-1:], length - len(clip.frames), axis=0)])
    caption = _text(clip.caption, frames.shape[2], _colour(clip))
    return np.concatenate([np.broadcast_to(caption, (length, *caption.shape)), frames], axis=1)


def _text(text: str, width: int, colour: str) -> Frames:
    """A line of text as an image, (_CAPTION_HEIGHT, width, 3)."""
    figure = Figure(figsize=(width / 100, _CAPTION_HEIGHT / 100), dpi=100)
    figure.text(0.02, 0.5, text, va="center", size=13, weight="bold", color=colour)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba(), dtype=np.uint8)[..., :3]


def _even(pictures: Frames) -> Frames:
    """Cut to an even number of rows and columns, as video coding needs."""
    return pictures[:, : pictures.shape[1] // 2 * 2, : pictures.shape[2] // 2 * 2]
