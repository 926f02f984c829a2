"""Where an axis stands while tables are switched: where what goes and what comes hardly step.

At the motor's zero every table corrects nothing. An axis whose zero lies outside its travel cannot
go there: it stands where the tables concerned correct least. What lives here: the choice of the
place, going there, and the words for it. What may not: the switching (``deploy``, ``upload``).
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.errors import MotorNotSafe, SafetyRefusal
from pmac_comp.base.units import MM_PER_M
from pmac_comp.machine.controller.contents.comp_table import BacklashTable, CompTable, Table
from pmac_comp.machine.controller.contents.safety import Limits, raise_all
from pmac_comp.machine.controller.contents.table_set import Key, TableSet, read_tables
from pmac_comp.machine.controller.motors import motors
from pmac_comp.machine.controller.tables.upload_checks import not_at_rest
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.motion.approach import RUN_UP_m

Sets = Callable[[TableSet], Sequence[TableSet]]
"""From the tables that stand, the sets that come in their place, one after the other."""
_THERE_ct = 1.0
_SETTLE_s = 0.3
_PLACES = 2001
_HARDLY = 0.1  # of the largest step allowed: below it the nearest place is as good as any


@dataclass(frozen=True)
class Place:
    """Where an axis stands to switch tables, and what they do there.

    Parameters
    ----------
    at_ct, place_ct : float
        Where the axis is and where it shall stand, counts.
    step_ct : float
        Largest step of a motor when tables are switched there, counts.
    from_below : bool
        Reached upwards: a backlash table corrects nothing after an upward motion.
    """

    at_ct: float
    place_ct: float = 0.0
    step_ct: float = 0.0
    from_below: bool = False

    @property
    def is_zero(self) -> bool:
        """Whether it is the motor's zero."""
        return self.place_ct == 0.0


def as_they_are(stand: TableSet) -> tuple[TableSet, ...]:
    """Nothing comes in their place: what stands is switched off and on."""
    del stand
    return ()


def uploading(tables: Iterable[Table], without: Iterable[Key] = ()) -> Sets:
    """What an upload of tables puts in the place of those that stand."""
    new, gone = tuple(tables), tuple(without)
    return lambda stand: (stand.with_tables(new, without=gone),)


def bringing_back(motor: int, backups: Callable[[], Iterable[TableSet]]) -> Sets:
    """What a rollback puts there: of each backup, read when needed, what goes by a motor."""

    def sets(stand: TableSet) -> list[TableSet]:
        others = [t for t in stand if not _goes_by(t, motor)]
        return [TableSet((*others, *(t for t in b if _goes_by(t, motor)))) for b in backups()]

    return sets


def find_place(axis: Axis, sets: Sets = as_they_are) -> Place | None:
    """Where the axis stands to switch tables; None with its loop open: then nothing moves.

    Raises
    ------
    MotorNotSafe
        Its zero is outside the travel, and tables step everywhere inside.
    """
    reading = motors.read_motor(axis.link, axis.motor)
    if not reading.status.is_closed_loop:
        return None
    limits = axis.scales.limits(axis.bench)
    if limits.min_position_ct <= 0.0 <= limits.max_position_ct:
        return Place(reading.position_ct)
    stand = read_tables(axis.link)
    place = _quietest(axis, limits, (stand, *sets(stand)), reading.position_ct)
    if place.step_ct > limits.max_step_ct:
        raise _no_place(axis, limits, place)
    return place


def place_refusals(axis: Axis, sets: Sets = as_they_are) -> list[SafetyRefusal]:
    """Refusal where tables could be switched nowhere without a step."""
    try:
        find_place(axis, sets)
    except SafetyRefusal as refusal:
        return [refusal]
    return []


def stand_to_switch(axis: Axis, sets: Sets = as_they_are) -> float:
    """Move a closed loop to where switching tables is no step; where it stands then, counts.

    Raises
    ------
    MotorNotSafe
        The motor executes a move that somebody else began, or there is no such place.
    """
    reading = motors.read_motor(axis.link, axis.motor)
    raise_all(not_at_rest(motors.executing_moves({axis.motor: reading})), "The move")
    place = find_place(axis, sets)
    if place is None:
        return reading.position_ct
    if place.from_below:
        axis.move_to(place.place_ct - axis.scales.counts(RUN_UP_m))
    if place.from_below or abs(place.at_ct - place.place_ct) > _THERE_ct:
        axis.move_to(place.place_ct)
        axis.link.clock.sleep_s(_SETTLE_s)
    return place.place_ct


def standing_lines(axis: Axis, sets: Sets = as_they_are) -> list[str]:
    """What moves before tables are switched, from where to where, for people.

    Raises
    ------
    MotorNotSafe
        There is no place for it.
    """
    place = find_place(axis, sets)
    if place is None:
        return ["the motor's loop is open: nothing moves"]
    if place.is_zero:
        why = "where every table corrects nothing"
        goal = f"its zero first, {why}"
    else:
        step = axis.scales.limits(axis.bench).text_um(place.step_ct)
        why = f"where tables step by {step} (its zero is outside [travel])"
        goal = f"{_mm(axis, place.place_ct)} first, {why}"
    if place.from_below:
        goal += f"; it comes there upwards over {RUN_UP_m * MM_PER_M:g} mm"
    elif abs(place.at_ct - place.place_ct) <= _THERE_ct:
        return [f"the axis stands at {_mm(axis, place.place_ct)}, {why}"]
    return [f"the axis moves from {_mm(axis, place.at_ct)} to {goal}"]


def _mm(axis: Axis, place_ct: float) -> str:
    return f"{place_ct * axis.scales.motor_m_per_ct * MM_PER_M:.1f} mm"


def _quietest(axis: Axis, limits: Limits, sets: Sequence[TableSet], at_ct: float) -> Place:
    """Place inside the travel where no set steps by more than elsewhere, the nearest of many."""
    inside_ct = axis.scales.counts(RUN_UP_m)
    low, high = limits.min_position_ct + inside_ct, limits.max_position_ct - inside_ct
    grid = np.rint(np.linspace(low, high, _PLACES))
    steps = np.zeros(grid.size)
    for tables in sets:
        steps = np.maximum(steps, _steps_ct(tables, axis.motor, grid))
    enough = max(float(steps.min()), _HARDLY * limits.max_step_ct)
    good = np.flatnonzero(steps <= enough)
    best = int(good[np.argmin(np.abs(grid[good] - at_ct))])
    by_direction = any(
        isinstance(t, BacklashTable) and t.motor == axis.motor for tables in sets for t in tables
    )
    return Place(at_ct, float(grid[best]), float(steps[best]), by_direction)


def _steps_ct(tables: TableSet, motor: int, places: FloatArray) -> FloatArray:
    """Largest correction of any motor by a motor's place: the step when these are switched."""
    by_target: dict[int, FloatArray] = {}
    for table in tables:
        if isinstance(table, CompTable) and table.source == motor:
            before = by_target.get(table.target, np.zeros(places.size))
            by_target[table.target] = before + table.correction_ct(places)
    largest = np.zeros(places.size)
    for values in by_target.values():
        largest = np.maximum(largest, np.abs(values))
    return largest


def _goes_by(table: Table, motor: int) -> bool:
    return table.motor == motor or (isinstance(table, CompTable) and table.source == motor)


def _no_place(axis: Axis, limits: Limits, place: Place) -> MotorNotSafe:
    return MotorNotSafe(
        f"The zero of motor #{axis.motor} is outside its travel, and inside it tables step by "
        f"{limits.text_um(place.step_ct)} at least, at {_mm(axis, place.place_ct)}; the limit is "
        f"{limits.text_um(limits.max_step_ct)}.",
        code="PC-MOT-041",
        hint=f"Kill the motor (`pmac-comp terminal URL -c '#{axis.motor}K'`) and run the command "
        "again: a killed motor does not jump, and enabled again it stays where it is.",
        context={"step_ct": place.step_ct, "place_ct": place.place_ct},
    )
