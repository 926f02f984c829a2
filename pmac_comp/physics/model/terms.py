"""Table terms: forces, torques and readings as tables over one coordinate.

With them a user's effect, or a flexible competitor of the diagnosis, enters the compiled loop
without being compiled itself. Imports ``base`` and the kernel layout.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from pmac_comp.base.arrays import FloatArray, finite_array
from pmac_comp.base.errors import ModelError
from pmac_comp.physics.model import slots as s


class Coordinate(IntEnum):
    """What a table is a function of."""

    TABLE_POSITION_M = 0
    TABLE_SPEED_M_PER_S = 1
    MOTOR_ANGLE_RAD = 2
    NUT_SINCE_REVERSAL_RAD = 3
    TIME_S = 4


class Site(IntEnum):
    """Where a table acts: positive torques and forces push along positive motion."""

    MOTOR_TORQUE_NM = 0
    NUT_TORQUE_NM = 1
    TABLE_FORCE_N = 2
    MOTOR_READING_M = 3
    TABLE_READING_M = 4
    NUT_FRICTION_NM = 5
    GUIDE_FRICTION_N = 6
    MOTOR_FRICTION_NM = 7


class Factor(IntEnum):
    """What a table is multiplied with."""

    ONE = 0
    GUIDE_FRICTION_STATE = 1
    NUT_FRICTION_STATE = 2
    TABLE_SPEED = 3


@dataclass(frozen=True)
class TableTerm:
    """A table over one coordinate, linear between equidistant knots.

    Parameters
    ----------
    coordinate, site, factor : Coordinate, Site, Factor
        What it depends on, where it acts and what multiplies it.
    start, step : float
        First knot and spacing, in the unit of the coordinate.
    values : ndarray, shape (k,)
        Values at the knots in the unit of the site; held beyond the ends.
    period : float
        Period of the coordinate, 0 if it does not repeat.
    """

    coordinate: Coordinate
    site: Site
    start: float
    step: float
    values: FloatArray
    factor: Factor = Factor.ONE
    period: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", finite_array("values", self.values, min_size=2))
        figures = finite_array("start, step, period", [self.start, self.step, self.period])
        if figures[1] <= 0.0 or figures[2] < 0.0:
            raise ModelError("A table term needs a positive knot spacing.", code="PC-MOD-004")


def packed(terms: Sequence[TableTerm]) -> tuple[FloatArray, FloatArray]:
    """Terms as arrays for the kernel, shapes (t, 7) and (t, k)."""
    rows = np.zeros((len(terms), s.TERM_COLUMNS))
    values = np.zeros((len(terms), max((term.values.size for term in terms), default=1)))
    for i, term in enumerate(terms):
        rows[i, s.TERM_COORDINATE] = term.coordinate
        rows[i, s.TERM_SITE] = term.site
        rows[i, s.TERM_FACTOR] = term.factor
        rows[i, s.TERM_START] = term.start
        rows[i, s.TERM_STEP] = term.step
        rows[i, s.TERM_COUNT] = term.values.size
        rows[i, s.TERM_PERIOD] = term.period
        values[i, : term.values.size] = term.values
    return rows, values
