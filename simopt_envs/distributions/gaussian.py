"""The multivariate normal distribution of ξ."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import solve_triangular

from simopt_envs.physics.parameters import Array, ParameterSpace

_LEAST_VALID_FRACTION = 1e-3
_TRIES_BEFORE_JUDGING = 5000


class Gaussian:
    """N(mean, covariance) over the unconstrained coordinates of a space: log-normal in scale-like quantities.

    Args:
        space: the d parameters.
        mean: (d,), unconstrained.
        covariance: (d, d), unconstrained, symmetric positive definite.

    Raises:
        ValueError: for a wrong shape, a number that is not finite, or a covariance that is not symmetric positive
            definite.
    """

    kind = "gaussian"

    def __init__(self, space: ParameterSpace, mean: ArrayLike, covariance: ArrayLike):
        d = len(space)
        self.space = space
        self.mean: Array = _finite("mean", mean, (d,))
        covariance = _finite("covariance", covariance, (d, d))
        if not np.allclose(covariance, covariance.T, rtol=1e-8, atol=1e-12 * np.abs(covariance).max(initial=0.0)):
            i, j = np.unravel_index(np.argmax(np.abs(covariance - covariance.T)), covariance.shape)
            raise ValueError(
                f"covariance must be symmetric; {space.names[i]} with {space.names[j]} is {covariance[i, j]:g}"
                f" one way and {covariance[j, i]:g} the other"
            )
        self.covariance: Array = (covariance + covariance.T) / 2
        try:
            self._cholesky = np.linalg.cholesky(self.covariance)
        except np.linalg.LinAlgError:
            least = np.linalg.eigvalsh(self.covariance)[0]
            raise ValueError(f"covariance must be positive definite; its smallest eigenvalue is {least:g}") from None
        for array in (self.mean, self.covariance, self._cholesky):
            array.flags.writeable = False

    @classmethod
    def around_nominal(cls, space: ParameterSpace, std: ArrayLike) -> Self:
        """Independent parameters around their nominal values.

        Args:
            space: the d parameters.
            std: a number or (d,), > 0, unconstrained: relative (0.1 is about 10 %) for logarithmic quantities, in
                the parameter's unit for the others.
        """
        std = np.asarray(std, dtype=np.float64)
        if std.shape not in ((), (1,), (len(space),)):
            raise ValueError(f"std must be a number or one per parameter, ({len(space)},), got shape {std.shape}")
        if not (np.isfinite(std) & (std > 0)).all():
            raise ValueError(f"std must be positive and finite, got {std}")
        return cls(space, space.to_unconstrained(space.nominal), np.diag(np.broadcast_to(std**2, len(space))))

    @property
    def std(self) -> Array:
        """(d,), unconstrained standard deviations of the single parameters."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def median(self) -> Array:
        """(d,), physical: the value of each parameter that half of the (untruncated) distribution lies below."""
        return self.space.from_unconstrained(self.mean)

    @property
    def correlation(self) -> Array:
        """(d, d), of the unconstrained coordinates."""
        return self.covariance / np.outer(self.std, self.std)

    def __repr__(self) -> str:
        rows = (
            f"  {p.name}: {m:.4g} {p.unit}, " + (f"std {100 * s:.3g} %" if p.coordinate == "log" else f"std {s:.3g}")
            for p, m, s in zip(self.space, self.median, self.std, strict=True)
        )
        return "Gaussian(\n" + "\n".join(rows) + "\n)"

    def sample(self, n: int, rng: np.random.Generator) -> Array:
        """Draw n vectors of physical values, (n, d), all within the bounds: draws outside are drawn again.

        So samples follow the Gaussian truncated to the space's bounds, while the density, entropy and KL are those of
        the Gaussian without truncation.

        Raises:
            ValueError: if fewer than about one draw in a thousand is valid.
        """
        drawn = np.empty((n, len(self.space)))
        filled, tried, batch = 0, 0, n
        while filled < n:
            x = self.space.from_unconstrained(
                self.mean + rng.standard_normal((batch, len(self.space))) @ self._cholesky.T
            )
            valid = x[self.space.contains(x)][: n - filled]
            drawn[filled : filled + len(valid)] = valid
            filled, tried = filled + len(valid), tried + batch
            if tried > _TRIES_BEFORE_JUDGING and filled < tried * _LEAST_VALID_FRACTION:
                raise ValueError(
                    f"only {filled} of {tried} draws lie within the parameters' bounds; the distribution is\n"
                    + "\n".join(
                        f"  {p.name} = {m:.4g} {p.unit}, {p.coordinate} std {s:.3g}, bounds {p.low:g} to {p.high:g}"
                        for p, m, s in zip(self.space, self.median, self.std, strict=True)
                    )
                )
            batch = max(n - filled, 100)  # few in a batch are valid where the first one left some to draw
        return drawn

    def log_prob(self, x: ArrayLike) -> Array:
        """Log density, over unconstrained coordinates, of physical values (n, d) -> (n,); see :meth:`sample`."""
        z = self.space.to_unconstrained(x)
        white = solve_triangular(
            self._cholesky, (z - self.mean).reshape(-1, len(self.space)).T, lower=True, check_finite=False
        )
        square = np.sum(white**2, axis=0).reshape(z.shape[:-1])
        log_density = -0.5 * (square + len(self.space) * np.log(2 * np.pi)) - self._half_log_determinant
        return np.where(np.isfinite(z).all(axis=-1), log_density, -np.inf)

    def entropy(self) -> float:
        """Differential entropy over unconstrained coordinates, in nats."""
        return float(0.5 * len(self.space) * (1 + np.log(2 * np.pi)) + self._half_log_determinant)

    def kl(self, other: Gaussian) -> float:
        """KL(self || other) in nats, in closed form.

        Raises:
            TypeError: if the other is not a Gaussian.
            ValueError: if it is one over other parameters.
        """
        if not isinstance(other, Gaussian):
            raise TypeError(f"the KL divergence of a Gaussian needs a Gaussian, got {type(other).__name__}")
        if other.space != self.space:
            raise ValueError(f"the KL divergence needs equal spaces, got {self.space.names} and {other.space.names}")
        ratio = solve_triangular(other._cholesky, self._cholesky, lower=True)
        shift = solve_triangular(other._cholesky, other.mean - self.mean, lower=True)
        log_ratio = 2 * (other._half_log_determinant - self._half_log_determinant)
        return float(0.5 * (np.sum(ratio**2) + shift @ shift - len(self.space) + log_ratio))

    def marginal(self, names: Sequence[str]) -> Gaussian:
        """The distribution of the named parameters alone."""
        space = self.space.subset(names)
        at = [self.space.index(name) for name in names]
        return Gaussian(space, self.mean[at], self.covariance[np.ix_(at, at)])

    def to_dict(self) -> dict[str, Any]:
        """A description made of what JSON holds."""
        return {
            "kind": self.kind,
            "parameters": list(self.space.names),
            "mean": self.mean.tolist(),
            "covariance": self.covariance.tolist(),
        }

    @classmethod
    def from_dict(cls, description: dict[str, Any], space: ParameterSpace) -> Self:
        """The Gaussian that :meth:`to_dict` described, over the parameters of ``space`` that it names."""
        return cls(space.subset(description["parameters"]), description["mean"], description["covariance"])

    @property
    def _half_log_determinant(self) -> float:
        # contiguous, as NumPy 1 rounds the logarithms of a strided array by where their memory happens to lie
        return float(np.sum(np.log(np.diag(self._cholesky).copy())))


def _finite(name: str, value: ArrayLike, shape: tuple[int, ...]) -> Array:
    array = np.array(value, dtype=np.float64)
    if array.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, one per parameter of the space, got shape {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite, got {array}")
    return array
