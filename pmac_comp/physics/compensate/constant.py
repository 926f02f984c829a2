"""Torque that a drive needs in both directions alike, found in captures.

What lives here: the regression that parts it from friction. What may not: the model's fit,
controllers.

A slanted axis, a counterweight or a cable asks for torque that friction does not. At rest the two
look the same, and a law that takes all that the output holds for friction begins the next motion
with friction on the wrong side. Under way they part: friction turns with the direction, a constant
load does not. So the mean of both directions is what the load needs, whatever the friction is. What
rises along the travel is a spring: a gas spring, a cable chain, a cover. What rises with the speed,
either way, is viscous friction that differs between the directions.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import numpy as np

from pmac_comp.base.arrays import BoolArray, FloatArray
from pmac_comp.files.capture import Capture
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.compensate.loop import LoopRunner

_Place = TypeVar("_Place", float, FloatArray)
LOAD = "load"  # of a law's provenance, where captures show one
BY_PLACE = "torque_by_place"  # the same where it rises along the travel
UNEVEN = "uneven"  # the same where viscous friction differs between the directions
_CLEAR_m = 0.2e-3  # of way after a turn: friction has set in, whatever distance it slides
_LEAST_STRETCHES = 4  # of one direction each: fewer do not tell how far they scatter
_LEAST_ALONE = 0.2  # of a constant that direction, speed, acceleration and place do not imitate
LEAST_LOAD_FRAC = 0.02  # of the friction torque: less is not worth a change
_PLACE_FRAC = 0.05  # of the friction torque: what a load by place has at the runs' ends
_PLACE_SURE = 1.5  # times two standard deviations
_UNEVEN_FRAC = 0.05  # of the friction torque: what goes with the speed has at the runs' highest
_UNEVEN_SURE = 1.5  # times two standard deviations
_UNEVEN_ALONE = 0.05  # runs of few speeds part it from a constant poorly, as its std says
# Columns of the regression: a constant, direction, speed, acceleration, place, speed either way.
_ONE, _DIRECTION, _SPEED, _ACCELERATION, _PLACE, _EVEN = range(6)


@dataclass(frozen=True)
class ConstantTorque:
    """Torque in N m that a model lacks in both directions, and two standard deviations of it.

    That of the middle of the runs in m, how it rises along them: in N m per m, from end to end in
    m; and how it rises with the speed either way, up to the highest of the runs.
    """

    torque_Nm: float
    two_std_Nm: float
    slope_Nm_per_m: float = 0.0
    slope_two_std_Nm_per_m: float = 0.0
    reach_m: float = 0.0
    middle_m: float = 0.0
    uneven_Nm_s_per_m: float = 0.0
    uneven_two_std_Nm_s_per_m: float = 0.0
    fastest_m_per_s: float = 0.0

    @property
    def rises(self) -> bool:
        """Whether it is known to change along the runs."""
        return abs(self.slope_Nm_per_m) > _PLACE_SURE * self.slope_two_std_Nm_per_m

    def at(self, place_m: _Place) -> _Place:
        """Torque in N m at places of the table in m."""
        rise = self.slope_Nm_per_m if self.rises else 0.0
        return self.torque_Nm + rise * (place_m - self.middle_m)


def with_constant_torque(
    law: CompensationLaw, loop: LoopRunner, captures: Sequence[Capture]
) -> CompensationLaw:
    """Law that also sends the load that captures show beyond the model, constant and by place.

    The law stays as it is where the torque is not known to be there, or is nothing beside friction;
    the change is kept as ``trim``: it is not the model's word.

    Parameters
    ----------
    law : CompensationLaw
        Law of a model, with torque.
    loop : LoopRunner
        Closed loop of that model.
    captures : sequence of Capture
        Runs without compensation, with torque.
    """
    has_room = law.gap_half_m == 0.0
    least_uneven_Nm = _UNEVEN_FRAC * law.torque_coulomb_Nm if has_room else math.inf
    found = constant_torque(loop, captures, least_uneven_Nm=least_uneven_Nm)
    if found is None:
        return law
    law = _with_uneven(_with_load_by_place(law, found), found)
    least_Nm = LEAST_LOAD_FRAC * law.torque_coulomb_Nm
    if abs(found.torque_Nm) <= max(found.two_std_Nm, least_Nm):
        return law
    law = with_load(law, constant_Nm=found.torque_Nm)
    noted = {"torque_Nm": found.torque_Nm, "two_std_Nm": found.two_std_Nm}
    return law.noting({LOAD: noted})


def _with_uneven(law: CompensationLaw, found: ConstantTorque) -> CompensationLaw:
    """Law that sends what viscous friction has more one way than the other."""
    if found.uneven_Nm_s_per_m == 0.0:
        return law
    noted = {
        "torque_Nm_s_per_m": found.uneven_Nm_s_per_m,
        "two_std_Nm_s_per_m": found.uneven_two_std_Nm_s_per_m,
        "speed_m_per_s": found.fastest_m_per_s,
    }
    more = {"torque_uneven_Nm_s_per_m": found.uneven_Nm_s_per_m}
    return law.with_values(**more).with_trim(more).noting({UNEVEN: noted})


def with_load(
    law: CompensationLaw, *, constant_Nm: float = 0.0, slope_Nm_per_m: float = 0.0
) -> CompensationLaw:
    """Law that sends more, constant and along the travel; kept as ``trim``."""
    both = {"torque_constant_Nm": constant_Nm, "torque_place_Nm_per_m": slope_Nm_per_m}
    more = {name: value for name, value in both.items() if value != 0.0}
    values = {name: getattr(law, name) + value for name, value in more.items()}
    return law.with_values(**values).with_trim(more)


def _with_load_by_place(law: CompensationLaw, found: ConstantTorque) -> CompensationLaw:
    """Law that sends what rises along the runs, none of it at their middle."""
    at_end_Nm = 0.5 * found.reach_m * abs(found.slope_Nm_per_m)
    if not found.rises or at_end_Nm < _PLACE_FRAC * law.torque_coulomb_Nm:
        return law
    slope = found.slope_Nm_per_m
    law = with_load(law, constant_Nm=slope * (law.origin_m - found.middle_m), slope_Nm_per_m=slope)
    noted = {
        "slope_Nm_per_m": slope,
        "two_std_Nm_per_m": found.slope_two_std_Nm_per_m,
        "reach_m": found.reach_m,
    }
    return law.noting({BY_PLACE: noted})


def constant_torque(
    loop: LoopRunner, captures: Sequence[Capture], *, least_uneven_Nm: float = math.inf
) -> ConstantTorque | None:
    """Constant torque that captures show beyond a model; None where they cannot tell.

    What friction, damping or mass of the model miss, and what changes along the travel, is fitted
    beside it; the constant is that of the middle of the runs. Each stretch of one direction counts
    as one observation of what is left, as torque of the same turns repeats within it.

    Parameters
    ----------
    loop : LoopRunner
        Closed loop of the model.
    captures : sequence of Capture
        Runs without compensation.
    least_uneven_Nm : float
        What viscous friction must differ by at the highest speed of the runs to be told at all.

    Source
    ------
    Reversal averaging; variance by sums over clusters (Liang and Zeger 1986).
    """
    parts = [_rows(loop, c) for c in captures if c.torque_command_Nm is not None]
    if not parts:
        return None
    columns, rest_Nm, begins = (np.concatenate(part) for part in zip(*parts, strict=True))
    if begins.sum() < _LEAST_STRETCHES or np.ptp(columns[:, _DIRECTION]) == 0.0:
        return None
    reach_m = float(np.ptp(columns[:, _PLACE]))
    middle_m = float(columns[:, _PLACE].mean())
    columns[:, _PLACE] -= middle_m
    fastest_m_per_s = float(np.max(columns[:, _EVEN]))
    size = np.maximum(np.sqrt(np.mean(columns**2, axis=0)), 1e-30)
    columns /= size
    fit = partial(_of_columns, rest_Nm=rest_Nm, begins=begins)
    with_speed, constant, rise = fit(columns, (_EVEN, _ONE, _PLACE), alone=_UNEVEN_ALONE)
    uneven, uneven_two_std = (value / float(size[_EVEN]) for value in with_speed or (0.0, 0.0))
    if abs(uneven) <= max(_UNEVEN_SURE * uneven_two_std, least_uneven_Nm / fastest_m_per_s):
        uneven = 0.0
        constant, rise = fit(columns[:, :_EVEN], (_ONE, _PLACE), alone=_LEAST_ALONE)
        if constant is None:
            return None
    slope, slope_two_std = rise or (0.0, 0.0)
    unit_m = float(size[_PLACE])
    return ConstantTorque(
        *(constant or (0.0, 0.0)),
        slope_Nm_per_m=slope / unit_m,
        slope_two_std_Nm_per_m=slope_two_std / unit_m,
        reach_m=reach_m,
        middle_m=middle_m,
        uneven_Nm_s_per_m=uneven,
        uneven_two_std_Nm_s_per_m=uneven_two_std,
        fastest_m_per_s=fastest_m_per_s,
    )


def _of_columns(
    columns: FloatArray,
    which: Sequence[int],
    *,
    rest_Nm: FloatArray,
    begins: BoolArray,
    alone: float,
) -> list[tuple[float, float] | None]:
    """Torque that goes with columns and two standard deviations; None where others imitate one."""
    found, *_ = np.linalg.lstsq(columns, rest_Nm, rcond=1e-6)
    left_Nm = rest_Nm - columns @ found
    firsts = np.flatnonzero(begins)

    def of(column: int) -> tuple[float, float] | None:
        own, others = columns[:, column], np.delete(columns, column, axis=1)
        apart = own - others @ np.linalg.lstsq(others, own, rcond=1e-6)[0]
        weight = float(apart @ apart)
        if weight < alone * own.size:
            return None
        sums = np.add.reduceat(left_Nm * apart, firsts)
        few = sums.size / (sums.size - 1.0)
        two_std = 2.0 * float(np.sqrt(few * np.sum(sums**2))) / weight
        return float(apart @ rest_Nm) / weight, two_std

    return [of(column) for column in which]


def _rows(loop: LoopRunner, capture: Capture) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Columns of the regression, torque beyond the model, and where a stretch begins, row by row.

    Rows are the samples of a run on which the direction is clear; shapes (rows, 6), (rows,) and
    (rows,).
    """
    r, period = capture.commanded_position_m, capture.sample_period_s
    measured_Nm = np.zeros(0) if capture.torque_command_Nm is None else capture.torque_command_Nm
    v = np.gradient(r, period)
    a = np.gradient(v, period)
    columns = np.column_stack([np.ones_like(r), np.sign(v), v, a, r, np.abs(v)])
    use, stretch = _clear_way(r)
    use &= capture.mask
    numbers = stretch[use]
    begins = np.concatenate([np.ones(min(numbers.size, 1)), np.diff(numbers)]) != 0.0
    rest_Nm = measured_Nm[use] - loop(r, None, None).torque_Nm[use]
    return columns[use], rest_Nm, begins


def _clear_way(r: FloatArray) -> tuple[BoolArray, FloatArray]:
    """Moving samples far enough from the last turn, and the number of the stretch of each."""
    steps = np.diff(r, prepend=r[0])
    direction = np.sign(steps)
    moving = np.flatnonzero(direction != 0.0)
    turns = np.zeros(r.size)
    turns[moving[1:]] = np.diff(direction[moving]) != 0.0
    stretch = np.cumsum(turns)
    way = np.cumsum(np.abs(steps))
    first = np.searchsorted(stretch, np.arange(stretch[-1] + 1.0))
    since = way - way[first][stretch.astype(np.int64)]
    return (direction != 0.0) & (since > _CLEAR_m), stretch
