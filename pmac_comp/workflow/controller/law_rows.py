"""Coefficients of two laws side by side, in units that a person knows: the rows of ``diff``.

A bank holds them in counts and servo cycles, at the motor's zero, which may lie outside the
travel; they are told for the middle of the travel, as ``compensate`` tells them. What a bank holds
by the pass (the damping and stiffness of a bed, the speed at which Stribeck friction fades) is not
told: a bank does not say how many servo cycles a pass of its law takes.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from pmac_comp.base.units import MM_PER_M, UM_PER_M, US_PER_S
from pmac_comp.machine.controller.contents.law_bank import LawParameters
from pmac_comp.workflow.bench.scales import Scales
from pmac_comp.workflow.capture.axis import Axis

Row = tuple[str, Any, Any, str]
Value = Callable[[LawParameters], float]


@dataclass(frozen=True)
class _Quantity:
    """One row: its name, what it is of a law, and in which unit."""

    name: str
    value: Value
    unit: str


def law_rows(axis: Axis, old: LawParameters | None, new: LawParameters) -> list[Row]:
    """Coefficients of two laws; None acts as no law. What neither has is left out."""
    middle_m = axis.bench.mid_travel_m
    middle_mm = middle_m * MM_PER_M
    place_ct = middle_m / axis.scales.motor_m_per_ct
    rows: list[Row] = [
        ("law, told for the axis at", None if old is None else middle_mm, middle_mm, "mm")
    ]
    for quantity in _of_table(axis.scales, place_ct) + _of_torque(axis.scales, place_ct):
        before = None if old is None else quantity.value(old)
        after = quantity.value(new)
        if before or after:
            rows.append((quantity.name, before, after, quantity.unit))
    return rows


def _of_table(scales: Scales, place_ct: float) -> list[_Quantity]:
    """What the law adds to the command."""
    period, um = scales.period_s, scales.motor_m_per_ct * UM_PER_M

    def elastic(key: str, factor: float) -> Value:
        """Changes along the travel with the screw."""
        return lambda law: getattr(law, key) * (1.0 + law.C1 * place_ct) * factor

    return [
        _Quantity("law, per acceleration", elastic("A0", period**2 * UM_PER_M), "um/(m/s2)"),
        _Quantity("law, per speed", elastic("V0", period * UM_PER_M), "um/(m/s)"),
        _Quantity("law, friction (each side)", elastic("S0", um), "um"),
        _Quantity("law, look-ahead", lambda law: law.L1 * period * US_PER_S, "us"),
        _Quantity("law, per speed more one way", elastic("VU", period * UM_PER_M), "um/(m/s)"),
        _Quantity("law, friction at rest beyond that", elastic("SX", um), "um"),
        _Quantity("law, drag (each side)", lambda law: _drag_ct(law) * um, "um"),
        _Quantity("law, that drag turns over within", lambda law: max(-law.BS, 0.0) * um, "um"),
        _Quantity("law, share of a bed that swings", _bed_percent, "%"),
        _Quantity("law, clearance of the nut", lambda law: 2.0 * law.GH * um, "um"),
        _Quantity("law, taken up over (each side)", elastic("GW", um), "um"),
        _Quantity("law, load on the nut", elastic("GB", um), "um"),
    ]


def _of_torque(scales: Scales, place_ct: float) -> list[_Quantity]:
    """What the law adds to the torque command."""
    torque, m = scales.torque_Nm_per_dac, scales.motor_m_per_ct
    per_speed, per_acceleration = torque / m * scales.period_s, torque / m * scales.period_s**2

    def times(key: str, factor: float) -> Value:
        return lambda law: getattr(law, key) * factor

    def wave(kind: Callable[[LawParameters], bool], factor: float) -> Value:
        """TR has three meanings; of the others there is none then."""
        return lambda law: abs(law.TR) * factor if kind(law) else 0.0

    return [
        _Quantity("torque, per acceleration", times("TJ", per_acceleration), "Nm/(m/s2)"),
        _Quantity("torque, per speed", times("TB", per_speed), "Nm/(m/s)"),
        _Quantity("torque, friction", times("TC", torque), "Nm"),
        _Quantity("torque, constant", lambda law: (law.T0 + law.TP * place_ct) * torque, "Nm"),
        _Quantity("torque, rising along the travel", times("TP", torque / m), "Nm/m"),
        _Quantity("torque, per speed more one way", times("TU", per_speed), "Nm/(m/s)"),
        _Quantity("torque, friction at rest beyond that", times("TX", torque), "Nm"),
        _Quantity("torque, friction by load", times("TE", per_acceleration), "Nm/(m/s2)"),
        _Quantity("torque, drag", lambda law: law.BT * _drag_ct(law) * torque, "Nm"),
        _Quantity("torque, friction per turn", wave(_is_friction_wave, torque), "Nm"),
        _Quantity("torque, second cogging", wave(lambda law: law.is_second_cogging, torque), "Nm"),
        # Only this one grows with the cube of the speed.
        _Quantity(
            "torque, against the lead's wobble",
            wave(lambda law: law.is_wobble, torque * (scales.period_s / m) ** 3),
            "Nm/(m/s)3",
        ),
        _Quantity("torque, share that ripples", times("RS", 100.0), "%"),
        _Quantity("torque, while the nut crosses", times("TG", torque), "Nm"),
        _Quantity("torque, cogging", times("TH", torque), "Nm"),
    ]


def _is_friction_wave(law: LawParameters) -> bool:
    return not law.is_wobble and not law.is_second_cogging


def _drag_ct(law: LawParameters) -> float:
    """What drags at the table, which has the places of a bed, with a BS below zero."""
    return law.BD if law.BS < 0.0 else 0.0


def _bed_percent(law: LawParameters) -> float:
    """Share of the acceleration's correction that a bed has in it."""
    return 100.0 * law.BS / law.A0 if law.BS > 0.0 and law.A0 != 0.0 else 0.0
