"""Windows in which something happened that no candidate explains: they are left out, and the verdict says so.

A finger caught in the recording and slipped in the model, say. In the square of errors one such window outweighs all
others, and whatever happens to bend its error a little looks like what is missing.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from simopt_envs.gap.explanation import Stage
from simopt_envs.gap.fit import by_part
from simopt_envs.gap.thresholds import EXPLAINED, OUTLYING, UNTAKEN
from simopt_envs.gap.trial import Data, of_median_window
from simopt_envs.measured.recording import Finding
from simopt_envs.physics.parameters import Array


def without_outliers(stage: Stage, data: Data) -> Data:
    """Without the outliers: windows with a part of which all candidates leave far more than the best of the median one.

    None may take much of it either, as the effect that it is of would, in whatever form. Only where the best makes the
    median window right, but not all together. If they were more than half, all stay.

    Args:
        stage: the first, whose fits count errors in the sensors' noise.
        data: that it is of.
    """
    trials = [stage.base, *(score.trial for score in stage.scores)]
    best = min(trials, key=lambda trial: trial.excess)
    median = of_median_window(best.held_out.errors)
    if best.excess < EXPLAINED - 1 or median > EXPLAINED:
        return data
    fitted, held_out = (
        _astray([_of_worst_part(errors, data.parts) for errors in of_each], OUTLYING * max(median, 1.0))
        for of_each in ([t.fit.errors for t in trials], [t.held_out.errors for t in trials])
    )
    count, total = int(np.sum(fitted) + np.sum(held_out)), len(fitted) + len(held_out)
    if count == 0 or max(np.mean(fitted), np.mean(held_out)) > 0.5:
        return data
    message = f"{count} of {total} left out, where something happened that no candidate explains"
    left = data.of_those(~fitted, ~held_out, Finding.warning("windows", "outliers", message))
    return replace(left, outliers=data.outliers + data.stretches(fitted, held_out))


def _astray(left: list[Array], most: float) -> NDArray[np.bool_]:
    """Of which windows all trials, the base first, leave more than is told, and most of what the base leaves, (w,)."""
    least = np.min(left, axis=0)
    astray: NDArray[np.bool_] = (least > most) & (least > UNTAKEN * left[0])
    return astray


def _of_worst_part(errors: Array, parts: int) -> Array:
    """Mean square of the whitened errors (w, S, c) in the worst of equal parts of each window, (w,)."""
    sums = by_part(np.sum(errors**2, axis=2), parts).reshape(-1, parts)
    of_worst: Array = np.max(sums, axis=1) * parts / errors[0].size
    return of_worst
