"""Whether an effect has one size in every run.

What lives here: the test that a name stands for a quantity. No names. May import ``estimates``,
``gram`` and ``refit``.

A cause has the same size whatever the axis does. What only imitates it is fitted as a compromise
between runs that ask for different sizes: letting the size differ from run to run then earns about
as much as the effect itself.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pmac_comp.base.arrays import FloatArray, IntArray
from pmac_comp.base.errors import ModelError
from pmac_comp.physics.diagnose.contenders import Contender
from pmac_comp.physics.diagnose.estimates import Told
from pmac_comp.physics.diagnose.gram import Gram
from pmac_comp.physics.diagnose.growth import Grown
from pmac_comp.physics.diagnose.refit import evaluate, refit

_APART = 0.2  # of what an effect earns, earned by sizes of its own in every run
_BY_CHANCE = 10.0  # chi-square per size
_MATERIAL = 0.01  # chi-square per sample
_OWN_STEPS = 25.0  # a run that says nothing of a size leaves it within half of itself
_RIDGE = 1e-9
_ROUNDS = 3


@dataclass(frozen=True)
class _Parts:
    """Columns of an effect and all others."""

    own: IntArray
    others: IntArray


def inconstant(grown: Grown, told: Told) -> frozenset[str]:
    """Effects whose size would have to differ from run to run.

    Parameters
    ----------
    grown : Grown
        Result of the growth loop.
    told : Told
        Its model linearised on the fitting samples.

    Returns
    -------
    frozenset of str

    Source
    ------
    Test of parameter constancy between parts of the data (Chow 1960), in proportion to what the
    parameter earns: models idealise, and with enough data any of them differs between parts.
    """
    return frozenset(c.effect for c in grown.accepted if _differs(grown, told, c))


def _differs(grown: Grown, told: Told, accepted: Contender) -> bool:
    chosen = [
        i
        for i, d in enumerate(told.directions)
        if d.run is None and d.label.partition(".")[0] == accepted.effect
    ]
    if not chosen:
        return False
    gain, sizes = gain_apart(told.gram, chosen)
    rows = float(told.gram.rows[told.gram.fitting].sum())
    if gain < max(_BY_CHANCE * sizes, _MATERIAL * rows, _APART * accepted.fit_gain):
        return False
    # What it earned was counted by the noise of its round; the last one is asked what it earns now.
    try:
        bare = grown.final.model.without_effect(accepted.effect)
        less = refit(told.part, evaluate(told.part, bare), rounds=_ROUNDS)
    except ModelError:
        return False
    return gain > _APART * (less.chi2 - told.point.chi2)


def gain_apart(gram: Gram, chosen: Sequence[int]) -> tuple[float, float]:
    """What some columns earn on fitting blocks if they may differ from record to record.

    Parameters
    ----------
    gram : Gram
        Products at the joint optimum, with the record of every block.
    chosen : sequence of int
        The columns that may differ; the others stay common.

    Returns
    -------
    tuple of float
        Drop of chi-square, and how many sizes more the data determines.
    """
    parts = _Parts(np.asarray(chosen), np.setdiff1d(np.arange(gram.n_columns), chosen))
    precision = 1.0 / gram.prior.sigma**2
    pull = precision * gram.prior.centre
    others = parts.others
    matrix, right = np.diag(precision[others]), pull[others]
    gain, sizes = 0.0, 0.0
    of_record = np.zeros(gram.rows.size, np.int64) if gram.record is None else gram.record
    for number in np.unique(of_record[gram.fitting]).tolist():
        here = gram.blocks[gram.fitting & (of_record == number)].sum(axis=0)
        reduced = _eliminated(here, parts)
        matrix, right = matrix + reduced[0], right + reduced[1]
        gain, sizes = gain + reduced[2], sizes + reduced[3]
    joint = _drop(gram.total[:-1, :-1] + np.diag(precision), gram.total[:-1, -1] + pull)
    return gain + _drop(matrix, right) - joint, sizes - len(chosen)


def _eliminated(products: FloatArray, parts: _Parts) -> tuple[FloatArray, FloatArray, float, float]:
    """What one record says of the common columns once its own sizes are free."""
    own, others = parts.own, parts.others
    square = products[np.ix_(own, own)]
    inverse = np.linalg.inv(square + np.eye(own.size) / _OWN_STEPS**2)
    cross, seen = products[np.ix_(others, own)], products[own, -1]
    return (
        products[np.ix_(others, others)] - cross @ inverse @ cross.T,
        products[others, -1] - cross @ inverse @ seen,
        float(seen @ inverse @ seen),
        float(np.trace(inverse @ square)),
    )


def _drop(matrix: FloatArray, right: FloatArray) -> float:
    """Drop of chi-square by least squares."""
    unit = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    scaled = matrix * np.outer(unit, unit) + _RIDGE * np.eye(right.size)
    return float((right * unit) @ np.linalg.solve(scaled, right * unit))
