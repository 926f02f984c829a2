"""Whether the torque that was recorded is what the bench file's control law gives.

What lives here: the law computed from a capture's own command and reading, without any plant. May
import ``records`` and ``physics.model``.

A wrong gain in the bench file looks like missing physics, and no effect explains it. But the law is
known to the last bit and a capture holds what went into it and what came out.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from pmac_comp.base.arrays import BoolArray, FloatArray
from pmac_comp.files.bench import Bench
from pmac_comp.physics.diagnose.records import Record
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.drive import DriveModel

_NAMES = (
    "proportional gain",
    "integral gain",
    "derivative gain",
    "velocity feed-forward",
    "acceleration feed-forward",
)
_FORGOTTEN_s = 0.05  # in which filters forget where they began
_LEAST_SHARE = 0.02  # of the torque's rms: less is rounding, or the moment of a sample
_MUCH = 0.1  # the same where no gains explain it
_EXPLAINED = 0.2  # of that difference is all that other gains may leave
_OFF, _SAME = 0.03, 0.01  # of a gain
_CARRIES = 0.5  # of the difference: a gain that makes so much of it is off, however little
_SHIFTS = (0, 1, -1)  # samples by which torque and positions may have been gathered apart


@dataclass(frozen=True)
class _Law:
    """Parts of the law of one run, and what was recorded."""

    parts: FloatArray
    recorded: FloatArray
    free: FloatArray


@dataclass(frozen=True)
class _Factors:
    """Factors of the gains that fit all runs best, and rms in N m.

    NaN is the factor of a gain that does nothing in these runs. ``sizes_Nm`` are those of the terms
    of the gains, ``before_Nm`` and ``left_Nm`` the differences without and with these factors.
    """

    gains: FloatArray
    sizes_Nm: FloatArray
    left_Nm: float
    before_Nm: float
    torque_Nm: float


def told_of_law(records: Sequence[Record], bench: Bench) -> tuple[str, ...]:
    """A sentence where the bench file's law does not give the recorded torque; else none.

    Parameters
    ----------
    records : sequence of Record
        All runs. Those without a torque, with lost samples, not sampled at every servo cycle or
        with a clipped output tell nothing.
    bench : Bench
        Gives the control law; cascades of another make are not checked.

    Returns
    -------
    tuple of str
    """
    vector = DriveModel.base(bench).kernel_vector()
    whole = [r for r in records if _is_whole(r, bench, vector)]
    if vector[s.LAW] >= 0.5 or not whole:
        return ()
    found = min((_factors(whole, vector, shift) for shift in _SHIFTS), key=lambda f: f.left_Nm)
    if found.left_Nm > _EXPLAINED * found.before_Nm:
        much = found.before_Nm > _MUCH * found.torque_Nm
        return (_beside(found.before_Nm),) if much else ()
    if found.before_Nm < _LEAST_SHARE * found.torque_Nm:
        return ()
    wrong = _listed(found)
    if not wrong:
        return ()
    return (
        "The torque recorded is not what the control law of the bench file makes of the recorded "
        f"command and motor position: it is that of {wrong}. Correct the gains in the bench file "
        "first: what follows takes them for true.",
    )


def _beside(before_Nm: float) -> str:
    return (
        f"The torque recorded differs by {before_Nm:.2g} N m rms from what the control law of the "
        "bench file makes of the recorded command and motor position, and no other gains give it: "
        "something else acts on torque or command (a compensation that is on, a feed-forward or "
        "filter that the bench file lacks). Capture without it, or what follows takes it for the "
        "drive's."
    )


def _listed(found: _Factors) -> str:
    """Gains that are off, in words; nothing where none is.

    Terms that nearly cancel, as where the axis lags far behind without feed-forward, make much of
    a fraction of a per cent of one of them.
    """
    gains = found.gains
    used = gains[np.isfinite(gains)]
    carries = np.abs(gains - 1.0) * found.sizes_Nm > _CARRIES * found.before_Nm
    if np.ptp(used) < _SAME and abs(used.mean() - 1.0) > _OFF:
        return (
            f"all gains {used.mean():.3g} times the stated ones (the factor that they share, or "
            "the torque per unit of the output)"
        )
    return ", ".join(
        f"{name} {gain:.{3 if abs(gain - 1.0) > _OFF else 4}g} times the stated one"
        for name, gain, much in zip(_NAMES, gains.tolist(), carries.tolist(), strict=True)
        if abs(gain - 1.0) > _OFF or much
    )


def _is_whole(record: Record, bench: Bench, vector: FloatArray) -> bool:
    if record.torque_Nm is None or not record.capture.mask.all():
        return False
    error = np.abs(record.desired_m - record.measured_m[:, 0]).max()
    return bool(
        record.capture.n == record.desired_m.size
        and abs(record.period_s / bench.servo_period_s - 1.0) < 1e-3
        and np.abs(record.torque_Nm).max() < 0.999 * vector[s.LIMIT]
        and error < vector[s.FE_LIMIT]
    )


def _factors(records: Sequence[Record], vector: FloatArray, shift: int) -> _Factors:
    laws = [_law(r, vector, shift) for r in records]
    projected = [_without(law.free, np.column_stack([law.parts, law.recorded])) for law in laws]
    every = np.concatenate(projected)
    parts, recorded = every[:, :-1], every[:, -1]
    size = np.sqrt(np.mean(parts**2, axis=0))
    used = size > 1e-3 * float(np.std(recorded))  # what does nothing is not off
    gains = np.full(size.size, np.nan)
    missed = recorded - parts.sum(axis=1)
    gains[used] = 1.0 + np.linalg.lstsq(parts[:, used], missed, rcond=None)[0]
    left = recorded - parts[:, used] @ gains[used]
    return _Factors(gains, size, _rms(left), _rms(missed), _rms(recorded))


def _law(record: Record, vector: FloatArray, shift: int) -> _Law:
    torque = np.zeros(record.desired_m.size) if record.torque_Nm is None else record.torque_Nm
    if record.feedforward_Nm is not None:
        torque = torque - record.feedforward_Nm
    ts, desired, read = record.period_s, record.desired_m, record.measured_m[:, 0]
    error = desired - read
    moved = np.diff(desired, prepend=desired[0])
    speed = moved / ts
    filtered = lfilter(
        [vector[s.FILTER]],
        [1.0, vector[s.FILTER] - 1.0],
        np.diff(read, prepend=read[0]) / ts,
    )
    parts = np.column_stack(
        [
            vector[s.KP] * error,
            vector[s.KI] * ts * _summed(error, moved, vector),
            -vector[s.KD] * filtered,
            vector[s.KVFF] * speed,
            vector[s.KAFF] * np.diff(speed, prepend=speed[0]) / ts,
        ]
    )
    n1, n2, d1, d2 = vector[s.NOTCH : s.NOTCH + 4]
    parts = lfilter([1.0, n1, n2], [1.0, d1, d2], parts, axis=0)
    beside = vector[s.FRICTION_FF] * np.sign(moved) * (np.abs(moved) > 1e-12)
    recorded = np.roll(torque - beside, shift)
    kept = np.arange(recorded.size) > max(2, round(_FORGOTTEN_s / ts))
    kept[-2:] = False
    # Where the integrator began, and what a zero of the encoder elsewhere makes it run away by.
    free = np.column_stack([np.ones(recorded.size), np.linspace(-1.0, 1.0, recorded.size)])
    return _Law(parts[kept], recorded[kept], free[kept])


def _summed(error: FloatArray, moved: FloatArray, vector: FloatArray) -> FloatArray:
    """Sum of the errors that the integrator has taken in before each cycle."""
    taken: BoolArray = np.ones(error.size, dtype=np.bool_)
    if vector[s.INTEGRATE_AT_REST] >= 0.5:
        taken = np.abs(moved) <= 1e-12
    return np.concatenate([[0.0], np.cumsum(np.where(taken, error, 0.0))[:-1]])


def _without(free: FloatArray, columns: FloatArray) -> FloatArray:
    return np.asarray(columns - free @ np.linalg.lstsq(free, columns, rcond=None)[0])


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))
