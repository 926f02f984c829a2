"""What comes back at the same place of the axis in every run: errors of screw or scale.

What lives here: the residual of a run foretold by place from the other runs. No decisions. May
import ``localise``, ``statistics`` and ``workbench``.

Flexible rivals follow position in a few straight pieces over the travel, as every one of them costs
a simulation. A dent in the screw, or a slope that changes, is shorter than those. A nut averages
over its turns, so that nothing shorter than a turn is a place.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pmac_comp.base.arrays import BoolArray, FloatArray
from pmac_comp.base.units import MM_PER_M, UM_PER_M
from pmac_comp.physics.diagnose.localise import Region
from pmac_comp.physics.diagnose.statistics import block_means, effective_size, sign_flip_p

_FEW_RUNS = 3
_MOST_KNOTS = 400
_LEAST = 50  # samples of a run


@dataclass(frozen=True)
class PlacePattern:
    """A residual that a run shares with the others at the same places.

    Parameters
    ----------
    region : Region
        Its shape along the axis.
    rms_um : float
        Rms that the other runs foretell of a run.
    p_value : float
        That they foretell as much by chance.
    """

    region: Region
    rms_um: float
    p_value: float


@dataclass(frozen=True)
class _Run:
    """Residual of a run, less its mean, and the share of every knot in each of its samples."""

    left_m: FloatArray
    hats: FloatArray


def place_pattern(
    residual_m: Sequence[FloatArray],
    position_m: Sequence[FloatArray],
    counted: Sequence[BoolArray],
    *,
    pitch_m: float,
    block: int,
) -> PlacePattern | None:
    """What runs share by place.

    Parameters
    ----------
    residual_m : sequence of ndarray, shape (n_i,)
        Residual of the table in each run, an unknown offset with it.
    position_m : sequence of ndarray, shape (n_i,)
        Where it was taken.
    counted : sequence of ndarray of bool, shape (n_i,)
        Samples that evidence may come from.
    pitch_m : float
        Travel per revolution: the shortest place.
    block : int
        Samples that are judged together.

    Returns
    -------
    PlacePattern or None
        None with fewer than three runs.
    """
    knots_m = _knots(position_m, pitch_m)
    triples = zip(residual_m, position_m, counted, strict=True)
    runs = [_run(r[c], x[c], knots_m) for r, x, c in triples if c.sum() > _LEAST]
    if len(runs) < _FEW_RUNS:
        return None
    foretold = [run.hats @ _shape(runs[:i] + runs[i + 1 :]) for i, run in enumerate(runs)]
    pairs = list(zip(runs, foretold, strict=True))
    drops = [run.left_m**2 - (run.left_m - f + f.mean()) ** 2 for run, f in pairs]
    blocks = np.concatenate([block_means(d, min(block, d.size)) for d in drops])
    explained = max(0.0, float(np.concatenate(drops).mean()))
    power = float(np.concatenate([run.left_m**2 for run in runs]).mean())
    p_value = sign_flip_p(blocks, seed=5)
    region = _region(knots_m, _shape(runs), explained / max(power, 1e-300), p_value)
    return PlacePattern(region, UM_PER_M * float(np.sqrt(explained)), p_value)


def _knots(position_m: Sequence[FloatArray], pitch_m: float) -> FloatArray:
    low = min(float(x.min()) for x in position_m)
    high = max(float(x.max()) for x in position_m)
    count = int(np.clip(np.ceil((high - low) / pitch_m), 1, _MOST_KNOTS))
    return np.linspace(low, high, count + 1)


def _run(left_m: FloatArray, position_m: FloatArray, knots_m: FloatArray) -> _Run:
    place = (position_m - knots_m[0]) / (knots_m[1] - knots_m[0])
    hats = np.maximum(0.0, 1.0 - np.abs(place[:, None] - np.arange(knots_m.size)[None, :]))
    return _Run(left_m - left_m.mean(), hats)


def _shape(runs: Sequence[_Run]) -> FloatArray:
    """Residual at the knots: fitted with an offset per run, and none where hardly a run was.

    As large beforehand as the residual itself; noise of a run that comes back to a knot later is
    another one, within its memory it is the same.
    """
    left = np.concatenate([run.left_m for run in runs])
    hats = np.concatenate([run.hats - run.hats.mean(axis=0) for run in runs])
    normal, moment = hats.T @ hats, hats.T @ left
    shape = np.zeros(moment.size)
    for _ in range(2):  # a shape has a memory of its own, which is none of the noise
        remainder = left - hats @ shape
        power, memory = float(remainder @ remainder), left.size / effective_size(remainder)
        weight = memory * power / max(float(left @ left), 1e-300)
        shape = np.linalg.solve(normal + weight * np.eye(moment.size), moment)
    return np.asarray(shape)


def _region(knots_m: FloatArray, shape_m: FloatArray, share: float, p_value: float) -> Region:
    worst = int(np.argmax(np.abs(shape_m)))
    centres = MM_PER_M * knots_m
    half = 0.5 * (centres[1] - centres[0])
    return Region(
        channel="table",
        coordinate="position",
        unit="mm",
        low=float(centres[worst] - half),
        high=float(centres[worst] + half),
        share=float(np.clip(share, 0.0, 1.0)),
        size_um=UM_PER_M * float(abs(shape_m[worst])),
        p_value=p_value,
        centres=tuple(centres.tolist()),
        means_um=tuple((UM_PER_M * shape_m).tolist()),
    )
