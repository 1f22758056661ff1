"""The report of a gap search: one page that says what is missing, how much of the gap that was, and how it is known."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from simopt_envs.gap import thresholds
from simopt_envs.gap.confusion import Partner, commands_file
from simopt_envs.gap.describe import Description
from simopt_envs.gap.figures import candidates_figure, curve_figure, error_figure, overlay_figure, regime_figure
from simopt_envs.gap.localise import Row
from simopt_envs.report.figures import save_figure, svg_of
from simopt_envs.report.page import Section, data_uri, write_page
from simopt_envs.report.run import installed_versions

if TYPE_CHECKING:
    from simopt_envs.gap.result import Gap, Named

_MOVED = 1.0  # prior standard deviations from which a plain parameter is shown
_LABELS = {"named": "explained", "none": "explained"}  # by which the page colours a verdict
_HEADLINES = {
    "named": "Named.",
    "partly": "Partly named.",
    "none": "Nothing is missing.",
    "unexplained": "Unexplained.",
}


def write_report(
    gap: Gap,
    folder: str | Path,
    rows: Sequence[Row],
    description: Description | None = None,
) -> Path:
    """Write ``report.html`` and its figures as PNG (folder ``plots``).

    Args:
        gap: what was found.
        folder: to write into; it is made.
        rows: where the refitted model and the recordings disagree.
        description: what the part that is not explained looks like.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    plots = _Plots(folder / "plots")
    if gap.verdict in ("named", "none"):
        description = None  # there is nothing left to describe
    found = [
        verdict(gap, description),
        *error(gap, plots),
        *effects(gap.effects),
        where(rows, plots),
        *left(description, plots),
        *candidates(gap, plots),
        diff(gap.diff),
        plain(gap),
        *warnings([str(warning) for warning in gap.warnings]),
        settings(gap),
    ]
    names = [recording.name for recording in gap.data.held_out_recordings]
    subtitle = f"judged on {', '.join(names)}, which no fit saw"
    return write_page(folder / "report.html", "Where simulation and recordings disagree", subtitle, found)


class _Plots:
    """Saves figures as PNG for other uses, and makes sections of them."""

    def __init__(self, folder: Path):
        self._folder = folder

    def section(self, title: str, name: str, figure: Figure, caption: str, width: str = "100%") -> Section:
        save_figure(figure, self._folder / f"{name}.png")
        image = data_uri(svg_of(figure), ".svg")
        return Section(title, "figure.html", {"image": image, "width": width, "caption": caption})


def verdict(gap: Gap, description: Description | None) -> Section:
    """The verdict in one sentence, and the numbers that a reader looks for first."""
    errors = gap.errors
    removable = max(errors.refit - errors.noise_floor, 1e-12)
    removed = f"{np.clip((errors.refit - errors.after) / removable, 0, 1):.0%}"
    explains = f"That explains {removed} of the error that noise does not"
    if removed == "100%":  # of an average in which the rest does not show
        explains = (
            f"With it, the mean square of the errors is {1 + gap.explanation.final.excess:.3g} times that of noise"
        )
    names = " and ".join(str(named) for named in gap.effects)
    sentence = {
        "named": f"The model lacks {names}. With it, what is left on recordings that no fit saw is noise.",
        "partly": f"The model lacks {names}. {explains}; the rest has another cause, or the law has another form.",
        "none": "With its plain parameters refitted, the model predicts the recordings as well as their noise and "
        "what the fit leaves uncertain allow.",
        "unexplained": "The model lacks something that is not in the library of effects, or the recordings cannot "
        "show which it is. No effect is named.",
    }[gap.verdict]
    tiles = [("Error, as given", f"{errors.before:.3g}"), ("Refitted", f"{errors.refit:.3g}")]
    if gap.effects:
        tiles.append(("Repaired", f"{errors.after:.3g}"))
    tiles.append(("Noise alone", f"{errors.noise_floor:.3g}"))
    notes = [*gap.remarks, *([] if description is None else [f"What is left: {description.text}"])]
    content = {"headline": _HEADLINES[gap.verdict], "sentence": sentence, "tiles": tiles, "notes": notes}
    return Section("", "verdict.html", {"label": _LABELS.get(gap.verdict, "unexplained"), **content})


def error(gap: Gap, plots: _Plots) -> Iterator[Section]:
    """The gap before, refitted and after, in numbers and as traces."""
    errors, stages = gap.errors, 3 if gap.effects else 2
    values = (errors.before, errors.refit, errors.after)[:stages]
    yield plots.section(
        "The gap",
        "errors",
        error_figure(values, errors.intervals[:stages], errors.noise_floor),
        "Root-mean-square error of windows, each channel relative to its own standard deviation. Refitted: the same "
        "structure with its plain parameters fitted. The dashed line is what noise leaves a right model with.",
    )
    yield plots.section(
        "Simulation against measurement",
        "overlays",
        overlay_figure(gap.data.held_out, errors.simulated[:stages], gap.explanation.null.sensor_noise),
        "Around the worst window of each channel, on recordings that no fit saw. Every window starts from the state "
        "estimated there, where the lines jump.",
    )


def effects(named: Sequence[Named]) -> Iterator[Section]:
    """What is missing: laws, numbers and what else it could be."""
    if not named:
        return
    content = [
        {
            "name": effect.candidate.effect.name,
            "place": effect.candidate.place,
            "law": effect.candidate.effect.law,
            "parameters": [
                {"name": name, "value": e.value, "unit": e.unit, "low": e.interval95[0], "high": e.interval95[1]}
                for name, e in effect.parameters.items()
            ],
            "partners": [
                {
                    "name": str(partner.candidate),
                    "closeness": f"correlation {partner.correlation:.2f}"
                    + ("" if partner.behind is None else f", {_ahead(partner.behind)}"),
                    "motion": _motion(effect, partner),
                }
                for partner in effect.partners
            ],
        }
        for effect in named
    ]
    yield Section("What is missing", "effects.html", {"effects": content})


def where(rows: Sequence[Row], plots: _Plots) -> Section:
    """By channel and regime."""
    return plots.section(
        "Where they disagree",
        "regimes",
        regime_figure(rows),
        "The refitted model. Bars: the share of the squared errors in each channel, blue where they are more than "
        "noise. Cells: how many times the channel's average a regime has; empty where it is within the noise. Errors "
        "build up after their cause, in all channels that it reaches.",
    )


def left(description: Description | None, plots: _Plots) -> Iterator[Section]:
    """What is unexplained, against the variable that describes it best."""
    if description is not None and description.curve is not None:
        figure = curve_figure(description.curve)
        yield plots.section("What is left", "description", figure, description.text, width="70%")


def candidates(gap: Gap, plots: _Plots) -> Iterator[Section]:
    """What each candidate would have gained alone."""
    scores = gap.explanation.stages[0].scores
    names = [str(score.candidate) for score in scores]
    fitted, held_out = ([getattr(score, of) for score in scores] for of in ("fitted", "held_out"))
    leaves = [1 + score.trial.excess for score in scores]
    yield plots.section(
        "Candidates",
        "candidates",
        candidates_figure(names, fitted, held_out, leaves, thresholds.EVIDENCE_EACH, thresholds.EVIDENCE),
        "The best of the whole library, each alone fitted together with all plain parameters: what it gains over the "
        "refitted model, less the price of its parameters on the fitted recordings.",
    )
    cells = [
        (name, f"{f:,.0f}", f"{h:,.0f}", f"{left:.3g}", "yes" if score.earned else "no")
        for name, f, h, left, score in zip(names, fitted, held_out, leaves, scores, strict=True)
    ]
    columns = ("candidate", "gain, fitted", "gain, held out", "mean square left, noise = 1", "enough to be named")
    yield table("", columns, cells, numbers=(1, 2, 3, 4))


def diff(text: str) -> Section:
    """The difference between the model as given and the repaired one."""
    colours = {"+": "green", "-": "orange", "@": "soft"}
    lines = [(line, colours.get(line[:1], "")) for line in text.splitlines()]
    hint = "What changes in the model, its refitted plain parameters included." if lines else "Nothing changes."
    return Section("The repaired model", "listing.html", {"hint": hint, "lines": lines})


def plain(gap: Gap) -> Section:
    """The plain parameters that moved far."""
    null, final = gap.explanation.null, gap.explanation.final
    hypothesis = null.hypothesis
    d = hypothesis.num_plain
    mean = hypothesis.xi(np.zeros((1, d)))[0]
    refit, repaired = hypothesis.xi(null.fit.u[None])[0], final.hypothesis.xi(final.fit.u[None])[0]
    off = null.hypothesis.off(null.fit.u), final.hypothesis.off(final.fit.u)
    moved = np.max(np.abs([off[0][:d], off[1][:d]]), axis=0)
    cells = [
        (
            hypothesis.space.names[i],
            f"{mean[i]:.4g}",
            *(f"{values[i]:.4g} ({sds[i]:+.1f})" for values, sds in zip((refit, repaired), off, strict=True)),
            hypothesis.space.units[i],
        )
        for i in np.argsort(-moved)
        if moved[i] > _MOVED
    ]
    hint = (
        f"In brackets: prior standard deviations from the prior's mean. {d - len(cells)} more moved by less than one."
    )
    if not cells:
        hint = f"None of the {d} moved by more than a prior standard deviation."
    columns = ("parameter", "prior", "refitted", "with the effects", "unit")
    return table("Plain parameters that moved", columns, cells, numbers=(1, 2, 3), hint=hint)


def warnings(messages: Sequence[str]) -> Iterator[Section]:
    """What the audit of the recordings found."""
    if messages:
        yield table("Warnings about the recordings", ("",), [(message,) for message in messages])


def settings(gap: Gap) -> Section:
    """What it takes to run it again."""
    fitted, held_out = gap.data.fitted, gap.data.held_out
    used = {
        "fitted": f"{len(fitted)} windows of {', '.join(r.name for r in gap.data.fitted_recordings)}",
        "held out": f"{len(held_out)} windows of {', '.join(r.name for r in gap.data.held_out_recordings)}",
        "window": f"{gap.data.seconds:g} s, {len(fitted.offsets)} samples of {len(fitted.channels)} channels",
        **{name: _numbers(getattr(thresholds, name)) for name in sorted(vars(thresholds)) if name.isupper()},
        "time": f"{gap.seconds:.0f} s",
        **installed_versions(),
    }
    return table("How it was made", ("", ""), list(used.items()))


def _numbers(values: float | Sequence[float]) -> str:
    """A setting, or the several of one, as it is printed."""
    return ", ".join(f"{value:g}" for value in np.ravel(values))


def _ahead(behind: float) -> str:
    """How a partner stands to the effect named, in words."""
    return f"{abs(behind):.0f} nats {'behind' if behind > 0 else 'ahead'}"


def _motion(effect: Named, partner: Partner) -> str:
    """What to record next to tell an effect from a partner, in words."""
    found = partner.separation
    if found is None:
        return "nothing to command: the model has no actuators, or no motion of them that stays near the recorded ones"
    saved = f", commands in {commands_file(effect.candidate, partner.candidate)}" if found.separates else ""
    return f"{found}{saved}"


def table(
    title: str, columns: Sequence[str], rows: Sequence[Sequence[str]], numbers: Sequence[int] = (), hint: str = ""
) -> Section:
    """A table of cells; ``numbers`` are the columns to align right."""
    return Section(title, "table.html", {"columns": columns, "rows": rows, "numbers": numbers, "hint": hint})
