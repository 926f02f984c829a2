"""What forbids to switch the tables of a card on or off (I51) with its motors where they stand.

What lives here: the questions that the rules of ``safety`` need answered by the card. Nothing is
written here.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Final

from pmac_comp.base.errors import SafetyRefusal
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.card.numbers import parse_integer
from pmac_comp.machine.controller.card.registers import COMPENSATION, motor_register
from pmac_comp.machine.controller.card.variables import read_many
from pmac_comp.machine.controller.contents.comp_table import TorqueTable
from pmac_comp.machine.controller.contents.safety import (
    Limits,
    check_offsets,
    check_step,
    check_torque_step,
)
from pmac_comp.machine.controller.contents.settings import MOTORS
from pmac_comp.machine.controller.contents.table_set import TableSet
from pmac_comp.machine.controller.motors.motors import MotorReading, read_motors
from pmac_comp.machine.controller.tables.upload_checks import motion_refusals

_UNITS_PER_CT: Final = 32.0  # of the register, times Ixx08
_GAIN_UNIT: Final = 2.0**-19  # of Ixx30 * Ixx08: 16-bit DAC units per count
_MOTORS: Final = range(1, MOTORS + 1)
_OFFSETS_TEXT: Final = "".join(f"RL${motor_register(m, COMPENSATION):X}" for m in _MOTORS)


def step_refusals(
    link: Link, limits: Limits, readings: Mapping[int, MotorReading], old: TableSet, new: TableSet
) -> list[SafetyRefusal]:
    """Refusals because a motor in closed loop would jump where it stands.

    ``old`` are the tables that act now, ``new`` those that are to act: empty for none.
    """
    position = {m: r.position_ct for m, r in readings.items()}
    closed = _closed(readings.values())
    refusals = check_step(old.tables, new.tables, position, closed, limits)
    torques = (t for t in dict.fromkeys((*old, *new)) if isinstance(t, TorqueTable))
    pushed = [t for t in torques if closed.get(t.motor)]
    if pushed:
        gains = _gains(link, sorted({t.motor for t in pushed}))
        refusals += check_torque_step(pushed, position, gains, limits)
    return refusals


def offset_refusals(link: Link, limits: Limits) -> list[SafetyRefusal]:
    """Refusals to switch on because of what stands in the compensation registers of a card.

    While tables are off (I51 = 0) a register keeps what it had when they were switched off, or
    what somebody wrote, and that goes on moving the motor; with I51 = 1 it is written anew every
    servo cycle.
    """
    values = map(parse_integer, link.query(_OFFSETS_TEXT))
    raw = {m: value for m, value in zip(_MOTORS, values, strict=True) if value}
    if not raw:
        return []
    readings, scales = read_motors(link, list(raw)), _variables(link, raw, "08")
    offset_ct = {m: v / (_UNITS_PER_CT * max(scales[m], 1.0)) for m, v in raw.items()}
    return check_offsets(offset_ct, _closed(readings.values()), limits)


def switch_refusals(
    link: Link, limits: Limits, tables: TableSet, *, on: bool
) -> list[SafetyRefusal]:
    """What forbids to switch all tables of a card as they stand: motion of a motor, or a step."""
    refusals = motion_refusals(link, tables.motors)
    old, new = (TableSet(), tables) if on else (tables, TableSet())
    refusals += step_refusals(link, limits, read_motors(link, tables.motors), old, new)
    return refusals + (offset_refusals(link, limits) if on else [])


def _closed(readings: Iterable[MotorReading]) -> dict[int, bool]:
    return {r.motor: r.status.is_closed_loop for r in readings}


def _gains(link: Link, motors: Sequence[int]) -> dict[int, float]:
    """Proportional gains of motors, 16-bit DAC units per count (p. 111)."""
    scales, gains = _variables(link, motors, "08"), _variables(link, motors, "30")
    return {m: gains[m] * scales[m] * _GAIN_UNIT for m in motors}


def _variables(link: Link, motors: Iterable[int], tail: str) -> dict[int, float]:
    """Ixx of one number for motors."""
    names = {m: f"I{m}{tail}" for m in motors}
    found = read_many(link, list(names.values()))
    return {m: found[name] for m, name in names.items()}
