"""Linear least squares that knows its residual is coloured and says what data cannot determine.

What lives here: one regression with a sandwich covariance and the test of its excitation. What may
not: any drive. Imports ``base``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.errors import NotIdentifiable

# Columns scaled to unit length: beyond this condition number, 1 % of model error in one column
# changes a coefficient by its own size.
MAX_CONDITION = 100.0


@dataclass(frozen=True)
class Regression:
    """Coefficients with covariance; ``residual`` in the unit of the target, shape (n,)."""

    names: tuple[str, ...]
    coefficients: FloatArray
    covariance: FloatArray
    white_std: FloatArray
    residual: FloatArray
    relative_error: float

    def std(self, name: str) -> float:
        """Standard deviation of one coefficient."""
        i = self.names.index(name)
        return float(np.sqrt(self.covariance[i, i]))

    def value(self, name: str) -> float:
        """One coefficient."""
        return float(self.coefficients[self.names.index(name)])


def regress(
    names: Sequence[str],
    columns: FloatArray,
    target: FloatArray,
    *,
    block: int,
    advice: Mapping[str, str],
) -> Regression:
    """Least-squares coefficients with a covariance that holds for coloured residuals.

    Parameters
    ----------
    names : sequence of str
        One name per column.
    columns : ndarray, shape (n, p)
        Regressors.
    target : ndarray, shape (n,)
        What they explain.
    block : int
        Length in rows over which the residual may be correlated.
    advice : Mapping of str to str
        For each name the run that would determine it.

    Raises
    ------
    NotIdentifiable
        A column carries nothing or some columns say the same; names them and the run to make.

    Source
    ------
    White (1980) sandwich with block sums; the covariance of ordinary least squares with white
    residuals, which publications quote, is kept as ``white_std``.
    """
    check_excitation(names, columns, advice)
    coefficients, *_ = np.linalg.lstsq(columns, target, rcond=None)
    residual = target - columns @ coefficients
    n, p = columns.shape
    inverse = np.linalg.inv(columns.T @ columns)
    white = inverse * float(residual @ residual) / max(n - p, 1)
    scores = block_sums(columns * residual[:, np.newaxis], block)
    meat = scores.T @ scores * _small_sample(scores.shape[0], p)
    return Regression(
        tuple(names),
        np.asarray(coefficients, dtype=np.float64),
        np.asarray(inverse @ meat @ inverse, dtype=np.float64),
        np.sqrt(np.diag(white)),
        np.asarray(residual, dtype=np.float64),
        float(np.linalg.norm(residual) / max(float(np.linalg.norm(target)), 1e-300)),
    )


def check_excitation(
    names: Sequence[str], columns: FloatArray, advice: Mapping[str, str]
) -> FloatArray:
    """Singular values, shape (p,), of scaled columns, shape (n, p).

    Raises
    ------
    NotIdentifiable
        They do not suffice to tell the parameters apart.
    """
    n, p = columns.shape
    if n < 5 * p:
        raise NotIdentifiable(
            f"Only {n} usable samples are left for {p} parameters.",
            code="PC-IDN-001",
            hint="Capture at least a few seconds of motion without dropped samples.",
        )
    length = np.linalg.norm(columns, axis=0)
    empty = [name for name, size in zip(names, length, strict=True) if size == 0.0]
    if empty:
        raise _not_identifiable(empty, advice, "nothing in the captures excites")
    _, values, directions = np.linalg.svd(columns / length, full_matrices=False)
    if values[0] > MAX_CONDITION * values[-1]:
        weak = np.abs(directions[-1])
        tied = [name for name, w in zip(names, weak, strict=True) if w > 0.3 * weak.max()]
        raise _not_identifiable(tied, advice, "these captures cannot tell apart")
    return np.asarray(values, dtype=np.float64)


def block_sums(rows: FloatArray, block: int) -> FloatArray:
    """Sums over consecutive blocks of rows, shape (ceil(n / block), p)."""
    return np.add.reduceat(rows, np.arange(0, rows.shape[0], max(block, 1)), axis=0)


# Regressors that are no parameter of a drive, as a reader knows them.
_WORDS = {
    "acceleration": "the moving inertia",
    "speed": "viscous friction",
    "direction": "Coulomb friction",
    "bias": "a constant force",
    "static": "the static error of scale and screw",
}


def _small_sample(n_blocks: int, p: int) -> float:
    return n_blocks / max(n_blocks - p, 1)


def _not_identifiable(
    tied: Sequence[str], advice: Mapping[str, str], reason: str
) -> NotIdentifiable:
    runs = list(dict.fromkeys(advice[name] for name in tied if name in advice))
    said = list(dict.fromkeys(_WORDS.get(name.rstrip("0123456789"), name) for name in tied))
    return NotIdentifiable(
        f"Not identifiable: {reason} {' and '.join(said)}.",
        code="PC-IDN-002",
        hint="Capture " + "; and ".join(runs) + "." if runs else "Capture richer motion.",
        context={"parameters": list(tied)},
    )
