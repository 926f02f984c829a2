"""Rules that no table, law or motion may break; all refusals of a check are reported together.

Figures come from the bench file by way of ``workflow``, in counts. Nothing here talks to a
controller.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from pmac_comp.base.arrays import FloatArray, finite_array
from pmac_comp.base.errors import AmplitudeExceeded, MotorNotSafe, SafetyRefusal, SlopeExceeded
from pmac_comp.base.units import UM_PER_MM
from pmac_comp.machine.controller.card.numbers import MANTISSA_LIMIT
from pmac_comp.machine.controller.contents.comp_table import (
    CT16_PER_CT,
    CompTable,
    Table,
    TorqueTable,
)
from pmac_comp.machine.controller.contents.law_bank import LawParameters, evaluate


@dataclass(frozen=True)
class Limits:
    """Limits in counts.

    Parameters
    ----------
    max_correction_ct : float
        Largest correction.
    max_slope : float
        Largest change of the correction per count of travel.
    max_step_ct : float
        Largest step when compensation is switched.
    min_position_ct, max_position_ct : float
        Travel in counts of the source motor.
    um_per_ct : float
        For the texts.
    hardest_ct_per_s2 : float
        Largest acceleration of the axis.
    """

    max_correction_ct: float
    max_slope: float
    max_step_ct: float
    min_position_ct: float
    max_position_ct: float
    um_per_ct: float
    hardest_ct_per_s2: float

    def text_um(self, value_ct: float) -> str:
        """A value in um for a person."""
        return f"{value_ct * self.um_per_ct:.3g} um"


_OF_SCREW = "Smooth the table, or raise max_slope_um_per_mm if the screw really is so."
_OF_CAM = (
    "Its source is another motor. If that counts time (--route cam), a slower motion or --aim "
    "mechanical asks for less, --route program has no such limit, and max_slope_um_per_mm times "
    "max_speed_mm_per_s is how fast a cam may change the correction."
)


def raise_all(refusals: Sequence[SafetyRefusal], what: str) -> None:
    """Raise one refusal that holds all of them; nothing if there are none."""
    if not refusals:
        return
    if len(refusals) == 1:
        raise refusals[0]
    raise SafetyRefusal(
        f"{what} is refused for {len(refusals)} reasons:",
        code="PC-SAF-000",
        refusals=tuple(refusals),
    )


def check_table(table: Table, limits: Limits) -> list[SafetyRefusal]:
    """What forbids a table: amplitude, slope, span shorter than the travel.

    Each refusal names the position and the value.
    """
    refusals = _check_span(table, limits) + _check_end(table)
    if isinstance(table, TorqueTable):
        return refusals
    values_ct = np.array([table.entries[-1] if table.wrap else 0, *table.entries]) / CT16_PER_CT
    position_ct = np.arange(len(values_ct)) * table.spacing_ct
    worst = int(np.argmax(np.abs(values_ct)))
    if abs(values_ct[worst]) > limits.max_correction_ct:
        refusals.append(
            AmplitudeExceeded(
                f"Entry {worst} at {position_ct[worst]:.0f} counts corrects by "
                f"{limits.text_um(values_ct[worst])}; the limit is "
                f"{limits.text_um(limits.max_correction_ct)}.",
                code="PC-SAF-001",
                hint="Check the table, or cut it with --limit.",
                context={"entry": worst, "correction_ct": float(values_ct[worst])},
            )
        )
    slopes = np.diff(values_ct) / table.spacing_ct
    steep = int(np.argmax(np.abs(slopes)))
    if abs(slopes[steep]) > limits.max_slope:
        refusals.append(
            SlopeExceeded(
                f"Between entries {steep} and {steep + 1} ({position_ct[steep]:.0f} counts) the "
                f"correction changes by {slopes[steep] * UM_PER_MM:.3g} um per mm; the limit is "
                f"{limits.max_slope * UM_PER_MM:.3g}.",
                code="PC-SAF-002",
                hint=_OF_CAM if _is_cam(table) else _OF_SCREW,
                context={"entry": steep, "slope": float(slopes[steep])},
            )
        )
    return refusals


def _is_cam(table: Table) -> bool:
    return isinstance(table, CompTable) and table.source != table.target


def _check_end(table: Table) -> list[SafetyRefusal]:
    if not table.jumps:
        return []
    return [
        SafetyRefusal(
            f"The last entry is {table.entries[-1]}, but the correction at position 0 is zero: "
            "the table would jump where it repeats.",
            code="PC-TBL-005",
            hint="End the table with 0, or load it with wrap (I30 = 1).",
        )
    ]


def _check_span(table: Table, limits: Limits) -> list[SafetyRefusal]:
    travel_ct = limits.max_position_ct - limits.min_position_ct
    if table.span_ct >= travel_ct:
        return []
    return [
        SafetyRefusal(
            f"The table spans {table.span_ct} counts, the travel is {travel_ct:.0f}: it would "
            "repeat inside the travel.",
            code="PC-SAF-003",
            hint="Make the table at least as long as the travel.",
        )
    ]


def check_sums(
    tables: Iterable[Table], changed: Iterable[Table], limits: Limits
) -> list[SafetyRefusal]:
    """What forbids several tables that correct one motor: together they exceed the amplitude.

    ``tables`` are all that will stand; only motors that a ``changed`` one corrects are looked at.
    Tables of one source and span add up place by place, others by what each corrects at most.
    """
    refusals: list[SafetyRefusal] = []
    comps = [t for t in tables if isinstance(t, CompTable)]
    for target in sorted({t.target for t in changed if isinstance(t, CompTable)}):
        aimed = [t for t in comps if t.target == target]
        groups = {(t.source, t.span_ct) for t in aimed}
        most_ct = sum(
            _most_ct([t for t in aimed if (t.source, t.span_ct) == group]) for group in groups
        )
        if len(aimed) > 1 and most_ct > limits.max_correction_ct:
            names = " and ".join(f"#{t.motor}" for t in aimed)
            refusals.append(
                AmplitudeExceeded(
                    f"The COMP tables of {names} all correct motor #{target}, together by up to "
                    f"{limits.text_um(most_ct)}; the limit is "
                    f"{limits.text_um(limits.max_correction_ct)}.",
                    code="PC-SAF-042",
                    hint="Take off the one that is not needed any more (`pmac-comp remove` with "
                    "its bench file), cut the new one with --limit, or raise [safety] "
                    "max_correction_um if the axis may be moved so far.",
                    context={"motor": target, "correction_ct": most_ct},
                )
            )
    return refusals


def _most_ct(tables: Sequence[CompTable]) -> float:
    """Largest correction of tables of one source and span together; it is at one of their knots."""
    # At the span itself a table begins again: what it has there is that of position 0, too.
    knots = [np.arange(len(t.entries) + 1) * t.spacing_ct for t in tables]
    places = np.unique(np.concatenate(knots))
    values = sum((t.correction_ct(places) for t in tables), np.zeros(places.size))
    return float(np.max(np.abs(values)))


def check_step(
    old: Iterable[Table],
    new: Iterable[Table],
    position_ct: dict[int, float],
    closed_loop: dict[int, bool],
    limits: Limits,
) -> list[SafetyRefusal]:
    """What forbids to switch where the axes stand: a jump of a closed-loop motor.

    Both the disappearance of the old correction and the appearance of the new one are steps.
    Parameters are keyed by motor; motors that are killed follow without a jump.
    """
    sets = {"off": _moving(old, closed_loop), "on": _moving(new, closed_loop)}
    refusals: list[SafetyRefusal] = []
    for name, tables in sets.items():
        for motor in dict.fromkeys(table.target for table in tables):
            value_ct = float(_sum_ct(tables, motor, position_ct, position_ct[motor]))
            if abs(value_ct) > limits.max_step_ct:
                where = quiet_place(sets.values(), motor, position_ct, limits)
                refusals.append(_step_refusal(motor, name, value_ct, where, limits))
    return refusals


def _moving(tables: Iterable[Table], closed_loop: Mapping[int, bool]) -> list[CompTable]:
    """Tables that move a motor in closed loop."""
    return [t for t in tables if isinstance(t, CompTable) and closed_loop.get(t.target, False)]


def _sum_ct(
    tables: Iterable[CompTable],
    motor: int,
    position_ct: Mapping[int, float],
    at_ct: float | FloatArray,
) -> FloatArray:
    """What all tables together add to a motor, were it at ``at_ct`` and the others as they are."""
    return sum(
        (
            t.correction_ct(at_ct if t.source == motor else position_ct[t.source])
            for t in tables
            if t.target == motor
        ),
        start=np.zeros(np.shape(at_ct)),
    )


def quiet_place(
    sets: Iterable[Sequence[CompTable]],
    motor: int,
    position_ct: Mapping[int, float],
    limits: Limits,
) -> float | None:
    """Position of a motor inside its travel at which no set of tables moves it; None for none."""
    grid = np.linspace(limits.min_position_ct, limits.max_position_ct, 2001)
    largest = np.max([np.abs(_sum_ct(s, motor, position_ct, grid)) for s in sets], axis=0)
    best = int(np.argmin(largest))
    return float(grid[best]) if largest[best] <= limits.max_step_ct else None


def _step_refusal(
    motor: int, name: str, value_ct: float, where_ct: float | None, limits: Limits
) -> SafetyRefusal:
    hint = _kill_hint(motor)
    if where_ct is not None:
        hint += f", or let it stand where it is small (`-c '#{motor}J={where_ct:.0f}'`)"
    return MotorNotSafe(
        f"Switching compensation {name} would move motor #{motor} by "
        f"{limits.text_um(value_ct)} at once; the limit is {limits.text_um(limits.max_step_ct)}.",
        code="PC-SAF-004",
        hint=hint + ".",
        context={"motor": motor, "step_ct": value_ct, "stand_at_ct": where_ct},
    )


def _kill_hint(motor: int) -> str:
    return f"Kill the motor first (`pmac-comp terminal URL -c '#{motor}K'`)"


def check_torque_step(
    tables: Iterable[TorqueTable],
    position_ct: Mapping[int, float],
    dac_per_ct: Mapping[int, float],
    limits: Limits,
) -> list[SafetyRefusal]:
    """What forbids to switch torque tables of closed loops: a torque that gives way at once.

    The loop takes it up with a following error, until its integrator has: as large as the
    proportional gain alone (16-bit DAC units per count, keyed by motor) needs for it.
    """
    refusals: list[SafetyRefusal] = []
    for table in tables:
        torque_dac = float(table.torque_dac(position_ct[table.motor]))
        gain = abs(dac_per_ct[table.motor])
        if abs(torque_dac) <= gain * limits.max_step_ct:
            continue
        moves = f" by about {limits.text_um(torque_dac / gain)}" if gain else ""
        refusals.append(
            MotorNotSafe(
                f"The torque table of motor #{table.motor} gives {torque_dac:.0f} DAC units where "
                f"it stands: switching it would push the motor aside{moves}; the limit is "
                f"{limits.text_um(limits.max_step_ct)}.",
                code="PC-SAF-041",
                hint=f"{_kill_hint(table.motor)}, or let it stand where that table gives little.",
                context={"motor": table.motor, "torque_dac": torque_dac},
            )
        )
    return refusals


def check_offsets(
    offset_ct: Mapping[int, float], closed_loop: Mapping[int, bool], limits: Limits
) -> list[SafetyRefusal]:
    """What forbids to switch tables on: a closed loop that stands by what its register holds.

    ``offset_ct`` is what the compensation registers hold while tables are off, keyed by motor, of
    either sign: whether a register is added or taken away is not the same in all of the manual.
    """
    return [
        MotorNotSafe(
            f"The compensation register of motor #{motor} holds {limits.text_um(value)} though "
            "tables are off (I51 = 0), and the motor stands by as much beside its position: "
            "switching tables on would take that away at once; the limit is "
            f"{limits.text_um(limits.max_step_ct)}.",
            code="PC-SAF-040",
            hint="It is left from where tables were switched off, or a program writes it. "
            f"{_kill_hint(motor)}; it may be enabled again afterwards.",
            context={"motor": motor, "offset_ct": value},
        )
        for motor, value in offset_ct.items()
        if closed_loop[motor] and abs(value) > limits.max_step_ct
    ]


def _register_refusals(parameters: LawParameters) -> list[SafetyRefusal]:
    wide = [
        f"{name} = {value:.6g}"
        for name, value in asdict(parameters).items()
        if abs(value) >= MANTISSA_LIMIT
    ]
    if not wide:
        return []
    return [
        SafetyRefusal(
            f"The law has coefficients that no register holds: {', '.join(wide)} (counts and servo "
            "cycles).",
            code="PC-SAF-009",
            hint="No drive has such a law: look at what was changed in the compensation file, or "
            "run `pmac-comp compensate` again.",
        )
    ]


def check_law(
    parameters: LawParameters,
    clamp_ct: float,
    limits: Limits,
    position_ct: FloatArray | None = None,
) -> list[SafetyRefusal]:
    """What forbids a law: clamp above the amplitude limit, or a motion that meets the clamp.

    Or a coefficient that no register takes, which would show only as the bank is written.

    Parameters
    ----------
    parameters, clamp_ct
        The bank and the clamp in counts.
    limits : Limits
        Limits of the bench.
    position_ct : FloatArray, optional
        A commanded motion at every servo cycle: its correction is checked against the clamp.
    """
    refusals = _register_refusals(parameters)
    if not 0.0 < clamp_ct <= limits.max_correction_ct:
        refusals.append(
            AmplitudeExceeded(
                f"A clamp of {limits.text_um(clamp_ct)} is outside 0 .. "
                f"{limits.text_um(limits.max_correction_ct)}.",
                code="PC-SAF-005",
                hint="Compute the compensation again with this bench file: its clamp is [safety] "
                "max_correction_um.",
            )
        )
    if position_ct is not None:
        out = evaluate(parameters, finite_array("position_ct", position_ct), clamp_ct=clamp_ct)
        if out.n_clamped:
            refusals.append(
                AmplitudeExceeded(
                    f"The clamp would act in {out.n_clamped} servo cycles of this motion.",
                    code="PC-SAF-007",
                    hint="Slow the motion down, or check the law.",
                )
            )
    return refusals
