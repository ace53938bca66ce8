"""Bootstrap interval of a mean difference, resampling whole scenes."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from freegeo.errors import UserError

_CHUNK_DRAWS = 4_000_000


class Interval(NamedTuple):
    """A mean and the percentile interval around it."""

    mean: float
    low: float
    high: float

    @property
    def excludes_zero(self) -> bool:
        """Whether the whole interval lies on one side of zero."""
        return self.low > 0 or self.high < 0


def paired_interval(
    differences: np.ndarray | Sequence[float],
    clusters: Sequence[object] | np.ndarray | None = None,
    *,
    confidence: float = 0.95,
    resamples: int = 10_000,
    seed: int = 0,
) -> Interval:
    """Percentile bootstrap interval of the mean of paired differences.

    Entries of one cluster (the seeds, view sets or domains of one scene) are not independent, so clusters are drawn
    with replacement and enter with all their entries; the statistic is the plain mean over all drawn entries.

    Args:
        differences: (n,) score of one method minus score of the other on the same item.
        clusters: (n,) a hashable label per entry; None takes every entry as its own cluster.
        confidence: share of the bootstrap distribution inside the interval, in (0, 1).
        resamples: number of bootstrap draws.
        seed: of the NumPy generator; equal arguments give equal intervals.

    Raises:
        UserError: nothing to resample, entries that are not finite, or labels of another length.
    """
    values = np.asarray(differences, dtype=np.float64)
    if values.ndim != 1 or values.size == 0 or not np.isfinite(values).all():
        raise UserError("A bootstrap interval needs a non-empty list of finite differences.")
    if not 0 < confidence < 1 or resamples < 1:
        raise UserError(f"confidence must lie in (0, 1) and resamples be positive, not {confidence} and {resamples}.")
    sums, counts = _cluster_totals(values, clusters)
    means = _resampled_means(sums, counts, resamples, np.random.default_rng(seed))
    low, high = np.quantile(means, [(1 - confidence) / 2, (1 + confidence) / 2])
    return Interval(float(values.mean()), float(low), float(high))


def _cluster_totals(
    values: np.ndarray, clusters: Sequence[object] | np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Sum and number of entries per cluster, each (clusters,)."""
    if clusters is None:
        return values, np.ones_like(values)
    labels = list(clusters)
    if len(labels) != values.size:
        raise UserError(f"{len(labels)} cluster labels do not fit {values.size} differences.")
    numbers = {label: number for number, label in enumerate(dict.fromkeys(labels))}
    index = np.array([numbers[label] for label in labels])
    return np.bincount(index, weights=values), np.bincount(index).astype(np.float64)


def _resampled_means(sums: np.ndarray, counts: np.ndarray, resamples: int, rng: np.random.Generator) -> np.ndarray:
    """Mean of each bootstrap draw (resamples,), in chunks that bound the memory."""
    clusters = sums.size
    step = max(1, _CHUNK_DRAWS // clusters)
    means = np.empty(resamples)
    for start in range(0, resamples, step):
        drawn = rng.integers(clusters, size=(min(step, resamples - start), clusters))
        means[start : start + step] = sums[drawn].sum(axis=1) / counts[drawn].sum(axis=1)
    return means
