"""Which of the samples of a run are its motion, and whether they are of this motion alone."""

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.errors import CaptureError

TAIL_s = 0.15  # kept after the last motion of a run
LEAD_IN_s = 0.05  # kept before the first
_STILL_m = 1e-9  # a command that changes by less stands
# Of the stroke: a soft start lies some tenths of a second off, as the card draws parabolas between
# points; of two shares one is not just touched by a wiggle.
_BEGUN = (0.005, 0.01)
_LENGTH_s = 0.1  # by which a run may be longer or shorter than its motion


def moving_range(
    commanded: FloatArray,
    period_s: float,
    planned: FloatArray,
    skipped: int,
    *,
    with_rests: bool = False,
) -> tuple[int, int]:
    """First and one past the last sample of the motion, with rest kept at both ends.

    Parameters
    ----------
    commanded : FloatArray, shape (n,)
        Command of all samples, m.
    period_s : float
        Between two of them.
    planned : FloatArray
        Command of the motion as it was planned, m.
    skipped : int
        First samples of the motion that only prepared it.
    with_rests : bool
        Whether rests that the motion itself begins and ends with are kept whole.

    Raises
    ------
    CaptureError
        The axis was not commanded to move, or for longer or shorter than the motion takes.
    """
    moving = np.flatnonzero(np.abs(commanded - commanded[0]) > _STILL_m)
    if moving.size == 0:
        raise CaptureError(
            "The axis was not commanded to move while it was gathered.",
            code="PC-AXI-004",
            hint="Check that the motion program runs (`pmac-comp status`).",
        )
    # The first sample that moves stands for the first one planned to: all others follow from it.
    begins = int(np.flatnonzero(np.abs(planned - planned[0]) > _STILL_m)[0])
    start = int(moving[0]) + max(0, skipped - begins)
    first = max(0, start - int(LEAD_IN_s / period_s))
    _require_length(commanded, planned, period_s)
    steps = np.flatnonzero(np.diff(commanded) != 0.0)
    last = int(steps[-1]) + 2
    if with_rests:
        first = max(0, first - begins)
        last = max(last, int(moving[0]) - begins + planned.size)
    return first, min(commanded.size, last + int(TAIL_s / period_s))


def _require_length(commanded: FloatArray, planned: FloatArray, period_s: float) -> None:
    """Refuse samples whose command moves for longer or shorter than its motion does.

    Raises
    ------
    CaptureError
        Something else moved the axis, or ended its program.
    """
    stroke_m = float(np.ptp(planned))
    lengths = [
        (
            _moving_s(planned, share * stroke_m, period_s),
            _moving_s(commanded, share * stroke_m, period_s),
        )
        for share in _BEGUN
    ]
    if any(abs(found_s - asked_s) <= _LENGTH_s for asked_s, found_s in lengths):
        return
    asked_s, found_s = lengths[0]
    raise CaptureError(
        f"The axis was commanded to move for {found_s:.2f} s, the motion takes {asked_s:.2f} s: "
        "the run is not kept.",
        code="PC-WRK-004",
        hint="Another program or terminal moved the axis or ended its motion: see that nobody else "
        "works at this controller, then run it again.",
    )


def _moving_s(command: FloatArray, near_m: float, period_s: float) -> float:
    """Time from where a command leaves its first place by a way to where it is as near its last."""
    left = np.flatnonzero(np.abs(command - command[0]) > near_m)
    there = np.flatnonzero(np.abs(command - command[-1]) > near_m)
    return float(there[-1] - left[0]) * period_s if left.size and there.size else 0.0
