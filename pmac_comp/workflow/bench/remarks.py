"""Where figures of a bench file do not fit each other, or fit no ball-screw axis at all.

What lives here: remarks, no refusals; an axis may be out of the ordinary, but nearly always a value
is in another unit. What may not: whether keys and values are allowed (``files.bench``).
"""

import math
from typing import TYPE_CHECKING

from pmac_comp.base.units import MM_PER_M, UM_PER_M, US_PER_S
from pmac_comp.files.bench import Bench, Drive, STEEL_DENSITY_kg_per_m3, STEEL_YOUNG_Pa
from pmac_comp.machine.controller.contents.law_bank import BLOCK_SIZE
from pmac_comp.physics.compensate.motions import reached_speed_m_per_s
from pmac_comp.physics.model.chain import velocity_gains
from pmac_comp.workflow.bench.view import resonance_Hz, tuned_motors

if TYPE_CHECKING:
    from pmac_comp.physics.model.drive import DriveModel

_RESONANCE_MARGIN = 0.25
# Wide enough for every catalogue axis: what lies outside differs by a power of ten, as units do.
_PITCH_mm = (0.5, 80.0)
_COUNT_um = (1e-4, 50.0)
_SCALE_um = (5e-4, 50.0)  # the finest scales of such axes are read to a nanometre
_DELAY_us = (5.0, 20_000.0)
_CLOCK_MHz = (10.0, 1000.0)
_CORRECTION_um = (0.5, 2000.0)
_ENABLE_STEP_um = (0.05, 500.0)
_SPEED_mm_per_s = (1.0, 5000.0)
_RESONANCE_Hz = (5.0, 3000.0)
_GEOMETRY = 4.0  # stated over what a steel screw of these dimensions has, either way
_DAC_SHARE = (0.2, 20.0)  # torque of the full output over the peak torque of the drive
_FULL_DAC = 32768.0
_PEAK_OF_SENSITIVITY = 2.5  # 1.3 to 2 is usual (Aastroem and Murray, Feedback Systems, 10.3)


def remarks(bench: Bench) -> list[str]:
    """Where the figures of a bench file do not fit each other."""
    out: list[str] = []
    computed, stated = resonance_Hz(bench), bench.known.resonance_Hz
    if computed and stated and abs(computed / stated - 1.0) > _RESONANCE_MARGIN:
        out.append(
            f"mass and stiffness give a resonance of {computed:.0f} Hz, [known] resonance_Hz says "
            f"{stated:.0f} Hz"
        )
    rounded_us = bench.controller.servo_period_us
    if rounded_us is not None and abs(bench.servo_period_s * US_PER_S / rounded_us - 1.0) > 1e-3:
        out.append(
            f"I10 gives a servo period of {bench.servo_period_s * US_PER_S:.3f} us, "
            f"servo_period_us says {rounded_us:g} us; I10 is used"
        )
    ends = [bench.screw_position_m(end_m) for end_m in bench.travel_m]
    if min(ends) < 0.0 or max(ends) > bench.screw.length_mm / MM_PER_M:
        out.append(
            f"the travel puts the nut at {min(ends) * MM_PER_M:.0f} to "
            f"{max(ends) * MM_PER_M:.0f} mm of a {bench.screw.length_mm:g} mm screw; "
            "check bearing_to_table_zero_mm"
        )
    tuned = tuned_motors(bench)
    if tuned and bench.encoder.motor_number not in tuned:
        out.append(
            f"[controller.ivariables] holds gains of motor #{tuned[0]}, [encoder] motor_number is "
            f"{bench.encoder.motor_number}: are encoder and scale swapped?"
        )
    if bench.scale is None:
        out.append("there is no [scale]: compensation at the table cannot be identified or checked")
    return out + _pace(bench) + lag_remarks(bench) + implausible(bench)


def _pace(bench: Bench) -> list[str]:
    """What the bench file says of how often PLC 0 runs; the upload of a law sets that itself."""
    stated = bench.controller.ivariables.get("I8")
    if bench.controller.kind != "pmac" or stated == 0.0:
        return []
    said = "is not stated (a card without settings has 2)" if stated is None else f"= {stated:g}"
    return [
        f"I8 {said}, so PLC 0 does not run every servo cycle; the upload of a law sets I8 to what "
        "`compensate --every` asks for"
    ]


def lag_remarks(bench: Bench) -> list[str]:
    """Whether the loop's damping holds the motor back by more torque than a law can send.

    A law takes that lag away as long as its torque reaches, and is fitted as far as that.
    """
    gains, speed_m_per_s = velocity_gains(bench), bench.usable_speed_m_per_s
    limit_Nm, reached_m_per_s = bench.drive.torque_limit_Nm, reached_speed_m_per_s(bench)
    if reached_m_per_s >= speed_m_per_s or gains.proportional_Nm_per_m == 0.0:
        return []
    lacking_Nm = gains.lacking_Nm_s_per_m * speed_m_per_s
    lag_mm = lacking_Nm / gains.proportional_Nm_per_m * MM_PER_M
    way = "behind" if lag_mm > 0.0 else "ahead of"
    return [
        f"velocity feed-forward and damping of the loop differ by {abs(lacking_Nm):.3g} N m at "
        f"{speed_m_per_s * MM_PER_M:.0f} mm/s, the drive has {limit_Nm:g}: the motor runs up to "
        f"{abs(lag_mm):.2g} mm {way} its command, and no law can send that torque. Laws are "
        f"fitted up to {reached_m_per_s * MM_PER_M:.0f} mm/s, where three quarters of the drive's "
        f"torque make up for it, and do little beyond. {_feedforward_text(bench)}, on the card "
        "too, before runs are captured"
    ]


def _feedforward_text(bench: Bench) -> str:
    """The gain of velocity feed-forward that makes up for the damping, for people."""
    if bench.controller.kind != "pmac":
        return "Set Kvff_Nm_s_per_mm to Kd_Nm_s_per_mm"
    motor, controller = bench.encoder.motor_number, bench.controller
    of_one = controller.model_copy(
        update={"ivariables": {**controller.ivariables, f"I{motor}32": 1.0}}
    )
    per_unit = velocity_gains(bench.model_copy(update={"controller": of_one}))
    wanted = per_unit.damping_Nm_s_per_m / per_unit.feedforward_Nm_s_per_m
    return f"Set I{motor}32 = {wanted:.0f}, which makes up for I{motor}31"


def loop_remarks(bench: Bench, model: "DriveModel | None" = None) -> list[str]:
    """Whether the gains of a bench file ring with its drive, or with one that was identified.

    At the ends of the travel and in the middle. Compiles the drive's model at the first use.
    """
    from pmac_comp.physics.model.drive import DriveModel
    from pmac_comp.physics.model.margin import sensitivity_peak

    drive = DriveModel.base(bench) if model is None else model
    low_m, high_m = bench.travel_m
    places_m = (low_m, bench.mid_travel_m, high_m)
    peaks = [(sensitivity_peak(drive, place_m), place_m) for place_m in places_m]
    peak, place_m = max(peaks, key=lambda pair: pair[0].value)
    if peak.value <= _PEAK_OF_SENSITIVITY:
        return []
    where = f"{peak.frequency_Hz:.0f} Hz, at {place_m * MM_PER_M:g} mm of the travel"
    check = "lower the gains"
    if model is None:
        check += ", or check stiffnesses, inertias, mass and actuator_delay_us"
    if math.isinf(peak.value):
        return [f"with these gains the loop of this drive is unstable ({where}): {check}"]
    stays = "" if model is None else ", and compensation adds no damping"
    return [
        f"with these gains the loop of this drive rings: what disturbs it comes through "
        f"{peak.value:.1f} times ({where}; 2 is usual){stays}: {check}"
    ]


def implausible(bench: Bench) -> list[str]:
    """Remarks on figures that lie far outside what ball-screw axes have, with the unit to check."""
    out = _sizes(bench)
    out += _times_and_limits(bench)
    out += _on_the_card(bench)
    out += _screw(bench)
    out += _core(bench)
    out += _output(bench)
    out += _acceleration(bench)
    return out


def _outside(value: float, bounds: tuple[float, float]) -> bool:
    return not bounds[0] <= value <= bounds[1]


def _sizes(bench: Bench) -> list[str]:
    out = []
    screw, scale_m = bench.screw, bench.scale_resolution_m
    if _outside(screw.pitch_mm, _PITCH_mm):
        out.append(f"pitch_mm = {screw.pitch_mm:g} is no ball screw's; it is mm per revolution")
    count_um = bench.motor_resolution_m * UM_PER_M
    if _outside(count_um, _COUNT_um):
        out.append(f"one encoder count is {count_um:.3g} um: check pitch_mm and counts_per_rev")
    if scale_m is not None and _outside(scale_m * UM_PER_M, _SCALE_um):
        out.append(f"resolution_um = {scale_m * UM_PER_M:g} is no linear scale's; one count in um")
    if screw.root_diameter_mm is not None and screw.root_diameter_mm > screw.diameter_mm:
        out.append(
            f"root_diameter_mm = {screw.root_diameter_mm:g} is larger than diameter_mm = "
            f"{screw.diameter_mm:g}"
        )
    computed = resonance_Hz(bench)
    if computed is not None and _outside(computed, _RESONANCE_Hz):
        out.append(
            f"mass, inertias and stiffnesses give a first resonance of {computed:.3g} Hz: check "
            "their units in [nominal]"
        )
    return out


def _times_and_limits(bench: Bench) -> list[str]:
    """Figures that are held against bounds alone, with the unit that is meant."""
    safety, delay_us = bench.safety, bench.nominal.actuator_delay_us
    stated = (
        ("max_correction_um", safety.max_correction_um, _CORRECTION_um, "um"),
        ("max_enable_step_um", safety.max_enable_step_um, _ENABLE_STEP_um, "um"),
        ("max_speed_mm_per_s", safety.max_speed_mm_per_s, _SPEED_mm_per_s, "mm/s"),
        ("actuator_delay_us", delay_us or None, _DELAY_us, "us"),
        ("cpu_clock_MHz", bench.controller.cpu_clock_MHz, _CLOCK_MHz, "MHz"),
    )
    return [
        f"{key} = {value:g} is outside what ball-screw axes have, {bounds[0]:g} to {bounds[1]:g} "
        f"{unit}"
        for key, value, bounds, unit in stated
        if value is not None and _outside(value, bounds)
    ]


def _on_the_card(bench: Bench) -> list[str]:
    """What a card would not close the loop or take a compensation with."""
    law, motor = bench.controller, bench.encoder.motor_number
    if law.kind != "pmac":
        return []
    out = []
    if law.ivariables.get(f"I{motor}30") == 0.0:
        out.append(f"I{motor}30 = 0: with no gain the loop of motor #{motor} holds nothing")
    size = law.p_block[1] - law.p_block[0] + 1
    if size < BLOCK_SIZE:
        out.append(f"p_block has {size} P-variables, a law needs {BLOCK_SIZE}")
    if law.cam_motor_number in bench.motor_numbers:
        whose = "axis" if law.cam_motor_number == motor else "scale"
        out.append(
            f"cam_motor_number = {law.cam_motor_number} is the motor of the {whose}; the route cam "
            "needs one that nothing uses"
        )
    return out


def _screw(bench: Bench) -> list[str]:
    """Inertia and rigidity that are stated against those of a steel screw of these dimensions."""
    screw, nominal = bench.screw, bench.nominal
    diameter_m, root_m = screw.diameter_mm / MM_PER_M, bench.root_diameter_m
    inertia = STEEL_DENSITY_kg_per_m3 * math.pi / 32.0 * root_m**2 * diameter_m**2
    inertia *= screw.length_mm / MM_PER_M
    rigidity = STEEL_YOUNG_Pa * math.pi / 4.0 * root_m**2
    return [
        f"{key} = {stated:g}, but a steel screw of {screw.diameter_mm:g} mm x "
        f"{screw.length_mm:g} mm has about {usual:.2g} {unit}"
        for key, stated, usual, unit in (
            ("screw_inertia_kgm2", nominal.screw_inertia_kgm2, inertia, "kg m2"),
            ("screw_rigidity_N", nominal.screw_rigidity_N, rigidity, "N"),
        )
        if stated is not None and _outside(stated / usual, (1.0 / _GEOMETRY, _GEOMETRY))
    ]


def _core(bench: Bench) -> list[str]:
    """Whether a stated rigidity has the stated core: the model takes the torsion from both.

    What they may differ by is the tolerance of the rigidity, to which `identify` takes the quotient
    of torsional and axial rigidity for known.
    """
    root_mm, stated = bench.screw.root_diameter_mm, bench.nominal.screw_rigidity_N
    if root_mm is None or stated is None:
        return []
    of_core = STEEL_YOUNG_Pa * math.pi / 4.0 * bench.root_diameter_m**2
    off, tolerance = stated / of_core - 1.0, bench.tolerance.screw_rigidity_N
    if abs(off) <= tolerance or _outside(stated / of_core, (1.0 / _GEOMETRY, _GEOMETRY)):
        return []
    return [
        f"screw_rigidity_N = {stated:.3g}, but a steel core of root_diameter_mm = {root_mm:g} has "
        f"{of_core:.3g} N ({100.0 * off:+.0f} %, its tolerance is {100.0 * tolerance:.0f} %): the "
        "torsion of the screw is computed from both, and runs would contradict either. Correct "
        "one, or widen [tolerance] screw_rigidity_N (a hollow screw)"
    ]


def _output(bench: Bench) -> list[str]:
    drive = bench.drive
    full_Nm = drive.torque_per_dac_Nm * _FULL_DAC
    no_limit_Nm = Drive.model_fields["torque_limit_Nm"].default
    known = bench.controller.kind == "pmac" and drive.torque_limit_Nm != no_limit_Nm
    if not known or not _outside(full_Nm / drive.torque_limit_Nm, _DAC_SHARE):
        return []
    return [
        f"the full output of 32768 DAC units gives {full_Nm:.3g} N m, torque_limit_Nm is "
        f"{drive.torque_limit_Nm:g}: check both; torque_per_dac_Nm is the torque of one unit"
    ]


def _acceleration(bench: Bench) -> list[str]:
    """Whether the peak torque can give the acceleration that is allowed."""
    nominal, lead, limit_Nm = bench.nominal, bench.lead_m_per_rad, bench.drive.torque_limit_Nm
    inertia = (
        (nominal.motor_inertia_kgm2 or 0.0)
        + (nominal.screw_inertia_kgm2 or 0.0)
        + (nominal.table_mass_kg or 0.0) * lead**2
    )
    wanted = bench.safety.max_acceleration_m_per_s2
    if inertia == 0.0 or limit_Nm * lead / inertia >= wanted:
        return []
    return [
        f"torque_limit_Nm = {limit_Nm:g} accelerates this axis at {limit_Nm * lead / inertia:.3g} "
        f"m/s2 at most, max_acceleration_m_per_s2 is {wanted:g}: check inertias, mass and torque, "
        "or lower the limit"
    ]
