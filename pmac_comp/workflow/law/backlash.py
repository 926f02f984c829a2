"""The direction-dependent part of the lead error as a backlash table, and its set-up on the card.

What lives here: whether there is a part worth a table, its entries, the take-up variables. What may
not: the map itself (``physics.compensate.lead``), the transaction (``machine.controller``).

The card subtracts the backlash while the last motion was negative (Software Reference Manual p.
301). So the position table holds the error of the forward direction and the backlash table the
difference of both: forward error less backward error, sign reversed. The table value at position
zero is not zero, so it is loaded with I30 = 1 (p. 53), and Ixx86 stays zero.
"""

import math
from dataclasses import replace

import numpy as np

from pmac_comp.base.units import UM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.machine.controller.contents.comp_table import CT16_PER_CT, BacklashTable
from pmac_comp.physics.compensate.lead import LeadMap
from pmac_comp.workflow.law.rendering import RenderedTable, entries_over_travel
from pmac_comp.workflow.law.routes import TORQUE_ROUTES

_LEAST_um = 0.25  # rms of the difference of both directions; less is not worth a table
# Beside a law that turns friction over in time, a table that takes up after each turn rings the
# first mode: of 0.27 um it made e_r 0.52 um where 0.45 um stood without it.
_LEAST_BESIDE_TORQUE_um = 0.5
_NOISES = 3.0
_HYSTERESIS_um = 1.0  # a reversal of the command less than this does not turn the backlash
_TAKE_UP_s = 9e-3  # two background cycles of a card with little else to do


def has_backlash(lead: LeadMap, route: str) -> bool:
    """Whether the two directions differ by more than their noise and than is worth a table."""
    rms_m = float(np.sqrt(np.mean(np.square(lead.reversal_m))))
    least_um = _LEAST_BESIDE_TORQUE_um if route in TORQUE_ROUTES else _LEAST_um
    return rms_m > max(least_um / UM_PER_M, _NOISES * lead.noise_m)


def forward_part(lead: LeadMap) -> LeadMap:
    """Map of the forward direction alone: what the position table takes away beside a backlash."""
    return replace(lead, error_m=lead.error_m + 0.5 * lead.reversal_m)


def backlash_table(lead: LeadMap, bench: Bench) -> RenderedTable[BacklashTable]:
    """Backlash table of a map; entries in 1/16 count, over the travel."""

    def backlash_m(position_m: np.ndarray) -> np.ndarray:
        return -np.asarray(np.interp(position_m, lead.position_m, lead.reversal_m))

    exact, span_ct = entries_over_travel(backlash_m, lead.spacing_m, bench)
    entries = np.round(exact).astype(np.int64)
    table = BacklashTable(
        bench.encoder.motor_number, tuple(int(e) for e in entries), span_ct, wrap=True
    )
    rounding_ct = float(np.max(np.abs(entries - exact))) / CT16_PER_CT
    return RenderedTable(table, rounding_ct * bench.motor_resolution_m * UM_PER_M)


def take_up_variables(table: BacklashTable, bench: Bench) -> dict[str, float]:
    """Ixx85-87: taken up within two background cycles, but never faster than the enable step."""
    motor = bench.encoder.motor_number
    per_um = CT16_PER_CT / (bench.motor_resolution_m * UM_PER_M)
    fastest = math.floor(bench.safety.max_enable_step_um * per_um)
    return {
        f"I{motor}85": float(max(1, min(math.ceil(table.largest_entry / 2), fastest))),
        f"I{motor}86": 0.0,
        f"I{motor}87": float(math.ceil(_HYSTERESIS_um * per_um)),
    }


def backlash_side(command_m: np.ndarray, bench: Bench) -> np.ndarray:
    """Side of the backlash along a command: 1 after positive motion, -1 after negative motion."""
    turn_m = _HYSTERESIS_um / UM_PER_M
    step = 2.0 * bench.servo_period_s / _TAKE_UP_s
    sides = np.empty(command_m.size)
    goal, value, extreme = 1.0, 1.0, float(command_m[0])
    for k, place in enumerate(command_m.tolist()):
        extreme = max(extreme, place) if goal > 0.0 else min(extreme, place)
        if goal * (extreme - place) > turn_m:
            goal, extreme = -goal, place
        value = min(value + step, goal) if value < goal else max(value - step, goal)
        sides[k] = value
    return sides
