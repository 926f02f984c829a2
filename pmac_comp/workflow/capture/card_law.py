"""Does the card close the loop that the bench file describes.

What lives here: the card's own PID in the units of ``[controller.si]`` and
``[controller.cascade]``, what a bench file takes for granted by leaving an I-variable out, and the
software limits against the travel. What may not: I-variables that the bench file states
(``commissioning``). Nothing here moves or writes.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from pmac_comp.base.errors import SafetyRefusal
from pmac_comp.base.units import MM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.card.numbers import plain
from pmac_comp.machine.controller.card.variables import read_many, read_one, same_value

# What the model takes where a bench file of kind pmac is silent: factory values (Software Reference
# Manual p. 96-127). Ixx29 belongs to compensation.
_ASSUMED: Final[Mapping[int, float]] = {
    8: 96.0, 9: 96.0, 30: 2000.0, 31: 1280.0, 32: 1280.0, 33: 1280.0, 34: 0.0, 35: 0.0,
    36: 0.0, 37: 0.0, 38: 0.0, 39: 0.0, 60: 0.0, 63: 4194304.0, 68: 0.0, 69: 20480.0,
}  # fmt: skip
_PID: Final = (8, 9, 30, 31, 32, 33, 35)
_USER_SERVO: Final = 1  # bit of Ixx59
_NEAR: Final = 0.02  # gains are rounded to integers on the card and to a few digits in files


@dataclass(frozen=True)
class _Gain:
    """One gain: on the card, in the bench file, and what one unit of its I-variable makes."""

    name: str
    card: float
    stated: float
    step: float

    @property
    def differs(self) -> bool:
        """Whether more than rounding lies between them."""
        return abs(self.card - self.stated) > _NEAR * abs(self.stated) + self.step


def law_refusals(link: Link, bench: Bench) -> list[SafetyRefusal]:
    """Refusals where the card's control law or units are not those of the bench file."""
    return [*_unstated(link, bench), *_other_law(link, bench)]


def _unstated(link: Link, bench: Bench) -> list[SafetyRefusal]:
    """Refusal where the file leaves out what counts and model need, and the card has no default."""
    motor = bench.encoder.motor_number
    tails = _ASSUMED if bench.controller.kind == "pmac" else (8,)
    assumed = {f"I{motor}{tail:02d}": _ASSUMED[tail] for tail in tails}
    if bench.scale is not None:
        assumed[f"I{bench.scale.motor_number}08"] = _ASSUMED[8]
    silent = {k: v for k, v in assumed.items() if k not in bench.controller.ivariables}
    found = read_many(link, list(silent)) if silent else {}
    differing = [
        f"{name} = {plain(found[name])} ({plain(value)})"
        for name, value in silent.items()
        if not same_value(found[name], value)
    ]
    if not differing:
        return []
    return [
        SafetyRefusal(
            "The bench file leaves out I-variables of position and control law that are not at "
            f"their factory values (in brackets), which it would take: {', '.join(differing)}.",
            code="PC-COM-008",
            hint="State them under [controller.ivariables]; nothing was moved.",
        )
    ]


def _other_law(link: Link, bench: Bench) -> list[SafetyRefusal]:
    """Refusal where the card's PID is not the law that the file states in other units.

    A user-written servo (Ixx59) may be any law; its gains cannot be asked for.
    """
    motor = bench.encoder.motor_number
    if bench.controller.kind == "pmac" or int(read_one(link, f"I{motor}59")) & _USER_SERVO:
        return []
    differing = [gain for gain in _gains(link, bench) if gain.differs]
    if not differing:
        return []
    told = ", ".join(f"{g.name} {g.card:.4g} ({g.stated:.4g})" for g in differing)
    kind = bench.controller.kind
    return [
        SafetyRefusal(
            f"The card's control law is not the one of the bench file (kind = '{kind}', its value "
            f"in brackets): {told}.",
            code="PC-COM-009",
            hint=f"Name the bench file of this axis with --bench, or correct [controller.{kind}], "
            "pitch_mm, counts_per_rev and torque_per_dac_Nm; a Turbo PMAC's own law is stated "
            'with kind = "pmac" and its I-variables. Nothing was moved.',
        )
    ]


def _gains(link: Link, bench: Bench) -> list[_Gain]:
    """The card's PID in N m and mm (Software Reference Manual p. 111-114) beside what is stated."""
    motor = bench.encoder.motor_number
    found = read_many(link, [f"I{motor}{tail:02d}" for tail in _PID])
    scale, velocity_scale, *values = found.values()
    kp, *rest = values
    per_mm = bench.drive.torque_per_dac_Nm / (bench.motor_resolution_m * MM_PER_M)
    period_s = bench.servo_period_s
    unit = scale / 2.0**19 * per_mm
    units = (
        kp * velocity_scale / 2.0**26 * per_mm * period_s,
        kp * scale / 2.0**26 * per_mm * period_s,
        kp * scale / 2.0**42 * per_mm / period_s,
        kp * scale / 2.0**26 * per_mm * period_s**2,
    )
    card = (kp * unit, *(value * step for value, step in zip(rest, units, strict=True)))
    steps = (abs(step) for step in (unit, *units))
    stated = _stated(bench)
    return list(map(_Gain, stated, card, stated.values(), steps))


def _stated(bench: Bench) -> dict[str, float]:
    """Gains of the bench file as a PID: Kp, Kd, Kvff, Ki, Kaff in the order of Ixx30-33 and 35."""
    cascade, si = bench.controller.cascade, bench.controller.si
    values = (0.0,) * 5
    if bench.controller.kind == "si" and si is not None:
        values = (
            si.Kp_Nm_per_mm,
            si.Kd_Nm_s_per_mm,
            si.Kvff_Nm_s_per_mm,
            si.Ki_Nm_per_mm_s,
            si.Kaff_Nm_s2_per_mm,
        )
    elif cascade is not None:
        # V = kv (kp e - v): a velocity loop inside a position loop is a PD controller.
        kd = cascade.kv_V_per_m_per_s * cascade.gain_N_per_V * bench.lead_m_per_rad / MM_PER_M
        values = (cascade.kp_per_s * kd, kd, 0.0, 0.0, 0.0)
    names = ("Kp_Nm_per_mm", "Kd_Nm_s_per_mm", "Kvff_Nm_s_per_mm", "Ki_Nm_per_mm_s")
    return dict(zip((*names, "Kaff_Nm_s2_per_mm"), values, strict=True))


def limit_remarks(link: Link, bench: Bench) -> tuple[str, ...]:
    """Where the travel of the file goes beyond the card's software limits (Ixx13, Ixx14).

    Motions within the limits run all the same; a wrong count per mm shows here as well.
    """
    motor = bench.encoder.motor_number
    count_mm = bench.motor_resolution_m * MM_PER_M
    names = (f"I{motor}13", f"I{motor}14")
    upper, lower = read_many(link, list(names)).values()
    ends_mm = (bench.travel.max_mm, bench.travel.min_mm)
    outside = (
        bool(upper) and upper * count_mm < ends_mm[0],
        bool(lower) and lower * count_mm > ends_mm[1],
    )
    told = [
        f"{name} = {plain(value)} counts are {value * count_mm:.1f} mm, {key} is {end_mm:g} mm"
        for name, value, key, end_mm, is_out in zip(
            names, (upper, lower), ("max_mm", "min_mm"), ends_mm, outside, strict=True
        )
        if is_out
    ]
    if not told:
        return ()
    return (
        f"the travel of the bench file goes beyond the software limits of the card: "
        f"{'; '.join(told)}; check counts_per_rev and pitch_mm, or shorten [travel]",
    )
