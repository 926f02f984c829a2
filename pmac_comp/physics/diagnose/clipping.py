"""Torque that was asked for and did not come.

What lives here: the level at which the drive cuts its torque off, told from what the motor did
under the recorded command, without any simulation, and the sentence on it. May import ``records``.

A drive that clips what it is asked for leaves the loop open for a while. Beside strong wind-up no
simulation follows that closely enough for a name; but each sample says by itself how much torque
moved the axis.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import butter, sosfiltfilt

from pmac_comp.base.arrays import BoolArray, FloatArray, IntArray
from pmac_comp.files.bench import Bench
from pmac_comp.physics.diagnose.records import Record
from pmac_comp.physics.identify.derivatives import FILTER_ORDER, motion_of
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.drive import DriveModel

_CUTOFF_Hz = 40.0  # below the first modes of such axes
_PER_PERIOD = 5
_CREEP_m_per_s = 1e-3  # below it friction has any value within its level
_LEVELS = 20  # between the usual torque and the largest, and as many around the best of them
_FEW = 40  # samples beyond a level that are enough, and as many that are not
# Of the square of the acceleration that the torque does not explain: what a level may leave of it.
_LEFT = 0.3
_CAME = 0.15  # of the torque beyond the level: more of it came than a drive that clips gives


@dataclass(frozen=True)
class Clipped:
    """Torque that did not come.

    Parameters
    ----------
    level_Nm : float
        Where it was cut off.
    count, of : int
        Samples whose command is beyond, and all in motion.
    peak_Nm : float
        Largest command.
    """

    level_Nm: float
    count: int
    of: int
    peak_Nm: float


def told_of_clipping(records: Sequence[Record], bench: Bench) -> tuple[str, ...]:
    """A sentence on torque that did not come; none where all that was asked for came."""
    found = clipped(records, bench)
    if found is None:
        return ()
    return (
        f"The torque command passes {found.level_Nm:.3g} N m on {found.count} of {found.of} "
        f"samples in motion (up to {found.peak_Nm:.3g} N m), and the motor moved there as with "
        f"{found.level_Nm:.3g} N m: the drive clipped the torque. Look at its current limit, its "
        "voltage and the output of the card, or capture gentler motions: what these runs tell of "
        "other effects is of a loop that was open for that time.",
    )


def clipped(records: Sequence[Record], bench: Bench) -> Clipped | None:
    """The level at which torque was cut off; None where what was asked for came.

    Parameters
    ----------
    records : sequence of Record
        Runs with torque.
    bench : Bench
        Gives the lag from the command to the torque.

    Returns
    -------
    Clipped or None
    """
    runs = [run for run in (_run(r, bench) for r in records) if run is not None]
    if not runs:
        return None
    sizes = np.concatenate([np.abs(r.command_Nm[r.counted]) for r in runs])
    if sizes.size < 2 * _FEW:
        return None
    top = float(np.sort(sizes)[-_FEW])
    low, step = float(np.median(sizes)), (top - float(np.median(sizes))) / _LEVELS
    unclipped, _ = _left(runs, np.inf)
    level = _best(runs, np.linspace(low, top, _LEVELS + 1))
    if _left(runs, level)[0] > _LEFT * unclipped:
        return None
    level = _best(runs, np.linspace(level - step, level + step, _LEVELS + 1))
    if abs(_left(runs, level)[1]) > _CAME:
        return None
    return Clipped(level, int(np.sum(sizes > level)), sizes.size, float(sizes.max()))


def _best(runs: Sequence["_Run"], levels_Nm: FloatArray) -> float:
    """The level that leaves the least."""
    left = [_left(runs, level)[0] for level in levels_Nm]
    return float(levels_Nm[int(np.argmin(left))])


@dataclass(frozen=True)
class _Run:
    """Command when it acts, shape (n,), and what the motor did in ``rows`` of it, in motion.

    ``whole_Nm`` is the command in ``rows``, filtered by ``sections`` as the motion is.
    """

    command_Nm: FloatArray
    sections: FloatArray
    whole_Nm: FloatArray
    acceleration: FloatArray
    friction: FloatArray
    counted: BoolArray
    rows: IntArray

    def torque(self, level_Nm: float) -> FloatArray:
        """Torque of a drive that clips in ``rows``, filtered as the motion is."""
        given = np.clip(self.command_Nm, -level_Nm, level_Nm)
        return np.asarray(sosfiltfilt(self.sections, given)[self.rows])


def _run(record: Record, bench: Bench) -> _Run | None:
    if record.torque_Nm is None:
        return None
    motion = motion_of(record.measured_m[:, 0], record.period_s, record.valid, cutoff_Hz=_CUTOFF_Hz)
    vector = DriveModel.base(bench).kernel_vector()
    time_s = record.period_s * np.arange(record.torque_Nm.size)
    rate = float(vector[s.CURRENT_RATE])
    lag_s = float(vector[s.DELAY]) + (1.0 / rate if rate else 0.0) + 0.5 * record.period_s
    counted = motion.usable & (np.abs(motion.velocity_m_per_s) > _CREEP_m_per_s)
    # What is left below the corner of the filters is known from a few samples of each period.
    apart = max(1, int(1.0 / (_PER_PERIOD * _CUTOFF_Hz * record.period_s)))
    rows = np.flatnonzero(counted & (np.arange(counted.size) % apart == 0))
    v = motion.velocity_m_per_s[rows]
    command_Nm = np.interp(time_s - lag_s, time_s, record.torque_Nm)
    corner_Hz = min(_CUTOFF_Hz, 0.2 / record.period_s)
    sections = butter(FILTER_ORDER, corner_Hz, fs=1.0 / record.period_s, output="sos")
    return _Run(
        command_Nm,
        sections,
        sosfiltfilt(sections, command_Nm)[rows],
        motion.acceleration_m_per_s2[rows],
        np.column_stack([v, np.sign(v), np.ones_like(v)]),
        counted,
        rows,
    )


def _left(runs: Sequence[_Run], level_Nm: float) -> tuple[float, float]:
    """Mean square of the acceleration that the clipped torque leaves, and how much came beyond."""
    columns, wanted = [], []
    for run in runs:
        torque = run.torque(level_Nm)
        beyond = run.whole_Nm - torque
        columns.append(np.column_stack([torque, beyond, run.friction]))
        wanted.append(run.acceleration)
    x, y = np.concatenate(columns), np.concatenate(wanted)
    scale = np.abs(x).max(axis=0)
    scale[scale == 0.0] = 1.0
    kept = x[:, [0, 2, 3, 4]] / scale[[0, 2, 3, 4]]
    found, *_ = np.linalg.lstsq(kept, y, rcond=None)
    missed = y - kept @ found
    whole, *_ = np.linalg.lstsq(x / scale, y, rcond=None)
    gains = whole[:2] / scale[:2]
    return float(np.mean(missed**2)), float(gains[1] / gains[0]) if gains[0] else np.inf
