"""The sections of a run's report, in the order of the page."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.linalg import eigh

from simopt_envs.report.figures import (
    correlation_figure,
    overlay_figure,
    parameters_figure,
    progress_figure,
    save_figure,
    svg_of,
)
from simopt_envs.report.page import Section, data_uri, write_page
from simopt_envs.report.run import Run

_FILM_STRIP, _FILMS = "film.png", ("film.mp4", "film.gif")
_PLOTS = "plots"
_VERDICTS = {
    "explained": "Explained. The model explains what was measured: the best ξ drawn is as close to it as noise allows.",
    "uninformative": "Within the noise. Nearly every ξ that p(ξ) draws now fits within the measurement noise: rollouts "
    "like these have nothing more to say. What they left undetermined needs longer or livelier motion.",
    "unexplained": "Unexplained. No ξ drawn explains what was measured. Either p(ξ) has not arrived yet and more "
    "iterations help, or the model lacks an effect that none of its parameters stands for.",
}


def write_report(directory: str | Path) -> Path:
    """Write ``report.html`` and the figures as PNG (folder ``plots``) from what a run left in its folder.

    Raises:
        FileNotFoundError, ValueError: if the folder holds no result; see :meth:`Run.load`.
    """
    run = Run.load(directory)
    done = len(run.iterations) - 1
    system = run.details.system or run.result["env_id"]
    subtitle = f"{system} · {done} iteration{'s' * (done != 1)} · seed {run.result['seed']}"
    title = "Simulation adapted to a real system"
    return write_page(run.directory / "report.html", title, subtitle, list(sections(run)))


def sections(run: Run) -> Iterator[Section]:
    """Every section that the run has something to show in."""
    yield summary(run)
    if (run.directory / _FILM_STRIP).exists():
        yield film(run)
    yield Section(
        "Progress",
        "figure.html",
        {
            "image": _plot(run, "progress", progress_figure(run)),
            "width": "100%",
            "caption": "Iteration 0 knows nothing but the first p(ξ). The discrepancy is that of Eq. 4 of Chebotar et "
            "al. 2019, on a logarithmic scale; the dotted line is what a perfect simulation would still have.",
        },
    )
    yield Section(
        "How the parameters moved",
        "figure.html",
        {
            "image": _plot(run, "parameters", parameters_figure(run)),
            "width": "100%",
            "caption": "Median of p(ξ) and one standard deviation to either side, in physical units."
            + ("" if run.truth is None else " The adaptation never saw the dashed line."),
        },
    )
    if run.real(0):
        yield Section(
            "Simulation against measurement",
            "figure.html",
            {
                "image": _plot(run, "overlays", overlay_figure(run)),
                "width": "100%",
                "caption": "Every observed channel of the measured rollouts (of up to six), and the simulation of the "
                "best ξ drawn from p(ξ), started where they started. Gaps in the solid lines are drop-outs.",
            },
        )
    yield certainty(run)
    if len(run.names) > 1:
        yield Section(
            "Correlations of the last p(ξ)",
            "figure.html",
            {
                "image": _plot(run, "correlation", correlation_figure(run)),
                "width": "auto",
                "caption": "Parameters that are correlated here can stand in for one another in the data: only their "
                "combination is known. Values below 0.1 are not printed.",
            },
        )
    yield Section("Iterations", "iterations.html", {"iterations": run.iterations})
    yield settings(run)


def summary(run: Run) -> Section:
    """The verdict in words, and the numbers that a reader looks for first."""
    first, last = run.iterations[0], run.iterations[-1]
    tiles: list[tuple[str, str, str]] = []
    if first["target_success"] is not None and last["target_success"] is not None:
        tiles.append(("Success on the target", f"{first['target_success']:.0%}", f"{last['target_success']:.0%}"))
    before, after = (f"{entry['discrepancy']['min']:.3g}" for entry in (first, last))
    tiles.append(("Discrepancy, best ξ", before, after))
    totals = [
        ("Real rollouts", f"{sum(entry['real_rollouts'] for entry in run.iterations)}"),
        ("Simulated rollouts", f"{sum(entry['sim_rollouts'] for entry in run.iterations):,}"),
    ]
    if (seconds := sum(entry["train_seconds"] for entry in run.iterations)) > 0:
        totals.append(("Training", f"{seconds:.0f} s"))
    return Section(
        "",
        "summary.html",
        {
            "tiles": tiles,
            "totals": totals,
            "label": last["verdict"]["label"],
            "verdict": _VERDICTS[last["verdict"]["label"]].partition(". "),
            "numbers": last["verdict"],
            "notes": run.details.notes,
        },
    )


def film(run: Run) -> Section:
    """The policy on the target before and after, moving where there is a film."""
    moving = next((run.directory / name for name in _FILMS if (run.directory / name).exists()), None)
    return Section(
        "The policy on the target system",
        "film.html",
        {
            "strip": _embedded(run.directory / _FILM_STRIP),
            "moving": None if moving is None else _embedded(moving),
            "is_video": moving is not None and moving.suffix == ".mp4",
        },
    )


def certainty(run: Run) -> Section:
    """How much narrower the data made p(ξ): for each parameter, and for each combination of them."""
    prior, last = run.std[0], run.std[-1]
    low, median, high = (run.physical(run.mean[-1] + s * last) for s in (-1, 0, 1))
    truth = run.truth
    rows = [
        {
            "name": run.names[i],
            "unit": run.units[i],
            "prior": run.physical(run.mean[0])[i],
            "median": median[i],
            "low": low[i],
            "high": high[i],
            "truth": None if truth is None else truth[i],
            "ratio": last[i] / prior[i],
        }
        for i in np.argsort(last / prior)
    ]
    content = {"parameters": rows, "directions": list(directions(run))}
    return Section("What the data determined", "certainty.html", content)


def directions(run: Run, terms: int = 4) -> Iterator[dict[str, Any]]:
    """Eigenvectors of the last covariance relative to the first, the best determined one first.

    Along each, ``ratio`` is the posterior standard deviation over the prior one; ``text`` names the largest of its
    loadings, which count prior standard deviations.
    """
    variances, vectors = eigh(run.covariance[-1], run.covariance[0])
    for variance, vector in zip(variances, vectors.T, strict=True):
        loadings = vector * run.std[0]
        loadings *= np.sign(loadings[np.argmax(np.abs(loadings))])
        largest = [i for i in np.argsort(-np.abs(loadings))[:terms] if abs(loadings[i]) > 0.2]
        text = " ".join(f"{'+' if loadings[i] > 0 else '−'} {abs(loadings[i]):.2f} {run.names[i]}" for i in largest)
        yield {"text": text.removeprefix("+ "), "ratio": float(np.sqrt(max(variance, 0.0)))}


def settings(run: Run) -> Section:
    """What it takes to run it again."""
    return Section(
        "Settings",
        "settings.html",
        {
            "command": run.details.command,
            "settings": dict(_flat(run.settings)),
            "versions": run.details.versions,
        },
    )


def _plot(run: Run, name: str, figure: Figure) -> str:
    """Save a figure as PNG for other uses; return it as the SVG that the page carries."""
    save_figure(figure, run.directory / _PLOTS / f"{name}.png")
    return data_uri(svg_of(figure), ".svg")


def _embedded(path: Path) -> str:
    return data_uri(path.read_bytes(), path.suffix)


def _flat(settings: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Nested settings as "a.b" -> text; the matrices of the first distribution are on the page already."""
    for name, value in settings.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")
        elif f"{prefix}{name}" not in ("distribution.mean", "distribution.covariance"):
            yield f"{prefix}{name}", value if isinstance(value, str) else json.dumps(value)
