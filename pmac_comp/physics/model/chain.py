"""The part of the model that a bench file states: chain, actuator, controller, sensors.

Parameters ``chain.*`` and their place in the kernel vector. Imports ``files.bench`` and layout.
"""

import math
from dataclasses import dataclass, replace

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.errors import ConfigError
from pmac_comp.base.units import MM_PER_M, UM_PER_M, US_PER_S
from pmac_comp.files.bench import Bench, STEEL_DENSITY_kg_per_m3
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.effect import Values
from pmac_comp.physics.model.parameters import ParameterSpec

_DAMPING_RATIO = 7.3e-5 * math.pi * 130.6  # usual: 0.03, of 73 us at 130.6 Hz
USUAL_ONLY = "chain.damping_time_s"  # no bench file states it: its nominal value is what is usual
_STIFF_COUPLING_Nm_per_rad = 2.0e4  # where the bench states none: stiffer than any in the catalogue
_MASS_GUESS_kg = 50.0


@dataclass(frozen=True)
class Shares:
    """How a drive divides what its bench file states as one figure, as the paper's drive does.

    Parameters
    ----------
    coupling_of_motor : float
        Share of the coupling in the inertia of motor with coupling.
    bearing_over_nut : float
        Stiffness of the bearing over that of the nut, which are in series.
    torsion_of_core : float
        Torsional rigidity of the screw over that of a round core of its rigidity and diameter.

    Source
    ------
    Chosen with the paper's drive so that its first resonance is the 130.6 Hz of its bench.
    """

    coupling_of_motor: float = 1.0e-4 / 5.45e-4
    bearing_over_nut: float = 211.0 / 180.0
    torsion_of_core: float = 1.0


USUAL_SHARES = Shares()


def is_rigid(bench: Bench) -> bool:
    """Whether the bench is described as one mass: no axial stiffness or no table mass is known."""
    nominal = bench.nominal
    return nominal.axial_stiffness_N_per_um is None or nominal.table_mass_kg is None


def chain_specs(bench: Bench) -> tuple[ParameterSpec, ...]:
    """Parameters of the chain under their full names."""
    if is_rigid(bench):
        return _rigid_specs(bench)
    nominal = bench.nominal
    screw_kgm2 = nominal.screw_inertia_kgm2 or _solid_screw_inertia_kgm2(bench)
    torsion = nominal.torsional_stiffness_Nm_per_rad or _STIFF_COUPLING_Nm_per_rad
    motor_kgm2 = nominal.motor_inertia_kgm2 or screw_kgm2
    axial = (nominal.axial_stiffness_N_per_um or 0.0) * UM_PER_M
    mass = nominal.table_mass_kg or 0.0
    efficiency = nominal.efficiency or 0.96
    usual_s = (
        2.0 * _DAMPING_RATIO / _mode_rad_per_s(bench, motor_kgm2 + screw_kgm2, mass, axial, torsion)
    )
    damping = ParameterSpec(
        USUAL_ONLY, "s", usual_s, 0.0, max(2e-3, 10.0 * usual_s), usual_s, "known", 0.6,
        "damping_time_us", "us", US_PER_S, "structural damping over stiffness",
    )  # fmt: skip
    return (
        _known(bench, "motor_inertia_kgm2", "kg m2", motor_kgm2),
        _known(bench, "screw_inertia_kgm2", "kg m2", screw_kgm2),
        _known(bench, "table_mass_kg", "kg", mass),
        _known(bench, "torsional_stiffness_Nm_per_rad", "N m/rad", torsion),
        _known(bench, "axial_stiffness_N_per_um", "N/m", axial, factor=1 / UM_PER_M),
        _known(bench, "screw_rigidity_N", "N", bench.screw_rigidity_N),
        _known(bench, "efficiency", "1", efficiency, upper=1.0),
        *_actuator_specs(bench),
        damping,
    )


def compliance_at_mid_travel_m_per_N(
    bench: Bench, axial_N_per_m: float, torsion_Nm_per_rad: float
) -> float:
    """Axial compliance from motor to table with the nut at mid travel: 1/k + x/EA + rho^2/k_th."""
    x_m = max(bench.screw_position_m(bench.mid_travel_m), 0.0)
    torsion = 1.0 / torsion_Nm_per_rad + x_m / bench.torsional_rigidity_Nm2
    axial = 1.0 / axial_N_per_m + x_m / bench.screw_rigidity_N
    return axial + bench.lead_m_per_rad**2 * torsion


def first_mode_rad_per_s(
    bench: Bench, rotary_kgm2: float, mass_kg: float, compliance_m_per_N: float
) -> float:
    """First resonance with the motor free, two masses: omega^2 = (1/M + rho^2/J) / C."""
    inertias = 1.0 / mass_kg + bench.lead_m_per_rad**2 / rotary_kgm2
    return math.sqrt(inertias / compliance_m_per_N)


def _mode_rad_per_s(
    bench: Bench, rotary_kgm2: float, mass_kg: float, axial_N_per_m: float, torsion: float
) -> float:
    """First mode of a drive, as measured or, where it was not, of two masses.

    Structural damping over stiffness is 2 zeta over it: a soft drive has more of that than a stiff
    one of the same damping ratio.
    """
    if bench.known.resonance_Hz is not None:
        return 2.0 * math.pi * bench.known.resonance_Hz
    compliance = compliance_at_mid_travel_m_per_N(bench, axial_N_per_m, torsion)
    return first_mode_rad_per_s(bench, rotary_kgm2, mass_kg, compliance)


def _rigid_specs(bench: Bench) -> tuple[ParameterSpec, ...]:
    mass = bench.nominal.table_mass_kg
    if mass is not None:
        rotary = (bench.nominal.motor_inertia_kgm2 or 0.0) + (
            bench.nominal.screw_inertia_kgm2 or 0.0
        )
        mass += rotary / bench.lead_m_per_rad**2
    known = mass is not None
    spec = ParameterSpec(
        "chain.mass_kg", "kg", mass or _MASS_GUESS_kg, 1e-3, 1e6, mass or _MASS_GUESS_kg,
        "known" if known else "free", bench.tolerance.table_mass_kg if known else None,
        "mass_kg", "kg", 1.0, "all that moves, expressed at the table",
    )  # fmt: skip
    return (spec, *_actuator_specs(bench))


def _actuator_specs(bench: Bench) -> tuple[ParameterSpec, ...]:
    specs = []
    if bench.nominal.current_bandwidth_Hz is not None:
        value = bench.nominal.current_bandwidth_Hz
        specs.append(_known(bench, "current_bandwidth_Hz", "Hz", value))
    if bench.nominal.actuator_delay_us is not None:
        value = bench.nominal.actuator_delay_us / US_PER_S
        specs.append(_known(bench, "actuator_delay_us", "s", value, factor=US_PER_S, lower=0.0))
    elif not is_rigid(bench):
        specs.append(_usual_delay(bench))
    return tuple(specs)


def _usual_delay(bench: Bench) -> ParameterSpec:
    """Dead time where a bench file states none: no controller's output acts at once.

    A servo period until the next interrupt, about as much again where the current loop is not
    stated either, and nothing known of both.
    """
    periods = 1.0 if bench.nominal.current_bandwidth_Hz is not None else 2.0
    value = periods * bench.servo_period_s
    usual = _known(bench, "actuator_delay_us", "s", value, factor=US_PER_S, lower=0.0)
    return replace(usual, tolerance_frac=1.0)


def _known(
    bench: Bench,
    key: str,
    unit: str,
    value: float,
    *,
    factor: float = 1.0,
    lower: float | None = None,
    upper: float | None = None,
) -> ParameterSpec:
    name = {"axial_stiffness_N_per_um": "axial_stiffness_N_per_m", "actuator_delay_us":
            "actuator_delay_s"}.get(key, key)  # fmt: skip
    return ParameterSpec(
        name=f"chain.{name}",
        unit=unit,
        nominal=value,
        lower=0.02 * value if lower is None else lower,
        upper=50.0 * value + 1e-2 * (unit == "s") if upper is None else upper,
        scale=value or 1e-4,
        kind="known",
        tolerance_frac=float(getattr(bench.tolerance, key)),
        file_name=key,
        file_unit={"axial_stiffness_N_per_um": "N/um", "actuator_delay_us": "us"}.get(key, unit),
        file_factor=factor,
    )


def _solid_screw_inertia_kgm2(bench: Bench) -> float:
    diameter_m = 0.96 * bench.screw.diameter_mm / MM_PER_M
    length_m = bench.screw.length_mm / MM_PER_M
    return STEEL_DENSITY_kg_per_m3 * math.pi / 32.0 * diameter_m**4 * length_m


def apply_chain(
    vector: FloatArray, values: Values, bench: Bench, shares: Shares = USUAL_SHARES
) -> None:
    """Set chain, actuator, sensors and controller in a kernel vector, shape (N_SLOTS,).

    ``values`` holds the ``chain.*`` parameters without the prefix.
    """
    vector[s.PERIOD] = bench.servo_period_s
    vector[s.LEAD] = bench.lead_m_per_rad
    vector[s.X_ORIGIN] = bench.bearing_to_table_zero_m
    vector[s.LENGTH] = bench.screw.length_mm / MM_PER_M
    vector[s.CURRENT_RATE] = 2.0 * math.pi * values.get("current_bandwidth_Hz", 0.0)
    vector[s.DELAY] = values.get("actuator_delay_s", 0.0)
    vector[s.LIMIT] = bench.drive.torque_limit_Nm
    vector[s.ACTUATOR_LIMIT] = bench.drive.torque_limit_Nm
    if is_rigid(bench):
        vector[s.RIGID] = 1.0
        vector[s.RIGID_MASS] = values["mass_kg"]
        vector[s.M_TABLE] = values["mass_kg"]
        vector[s.K_NUT] = 0.0
    else:
        _apply_elastic(vector, values, bench, shares)
    _apply_controller(vector, bench)


def _apply_elastic(vector: FloatArray, values: Values, bench: Bench, shares: Shares) -> None:
    coupling = shares.coupling_of_motor * values["motor_inertia_kgm2"]
    axial = values["axial_stiffness_N_per_m"]
    vector[s.J_MOTOR] = values["motor_inertia_kgm2"] - 0.5 * coupling
    vector[s.J_COUPLING] = 0.5 * coupling
    vector[s.J_SCREW] = values["screw_inertia_kgm2"]
    vector[s.M_SCREW] = _screw_mass_kg(values["screw_inertia_kgm2"], vector[s.LENGTH])
    vector[s.M_TABLE] = values["table_mass_kg"]
    vector[s.K_COUPLING] = values["torsional_stiffness_Nm_per_rad"]
    vector[s.EA] = values["screw_rigidity_N"]
    ratio = values["screw_rigidity_N"] / bench.screw_rigidity_N
    vector[s.GJ] = bench.torsional_rigidity_Nm2 * ratio * shares.torsion_of_core
    # Bearing and nut in series.
    vector[s.K_BEARING] = axial * (1.0 + shares.bearing_over_nut)
    vector[s.K_NUT] = axial * (1.0 + 1.0 / shares.bearing_over_nut)
    vector[s.BETA] = values["damping_time_s"]
    vector[s.NUT_LOAD] = 1.0 / values["efficiency"] - 1.0


def _screw_mass_kg(inertia_kgm2: float, length_m: float) -> float:
    """Mass of the solid steel cylinder that has this inertia over this length."""
    diameter4 = 32.0 * inertia_kgm2 / (STEEL_DENSITY_kg_per_m3 * math.pi * length_m)
    return STEEL_DENSITY_kg_per_m3 * math.pi / 4.0 * math.sqrt(diameter4) * length_m


def _apply_controller(vector: FloatArray, bench: Bench) -> None:
    control = bench.controller
    if control.kind == "pmac":
        _apply_pmac(vector, bench)
    elif control.si is not None and control.kind == "si":
        law = control.si
        for slot, value in (
            (s.KP, law.Kp_Nm_per_mm),
            (s.KI, law.Ki_Nm_per_mm_s),
            (s.KD, law.Kd_Nm_s_per_mm),
            (s.KVFF, law.Kvff_Nm_s_per_mm),
            (s.KAFF, law.Kaff_Nm_s2_per_mm),
        ):
            vector[slot] = value * MM_PER_M
        vector[s.FILTER] = law.velocity_filter_alpha
    elif control.cascade is not None:
        cascade = control.cascade
        vector[s.LAW] = 1.0
        vector[s.CASCADE_KP] = cascade.kp_per_s
        force = cascade.kv_V_per_m_per_s * cascade.gain_N_per_V
        vector[s.CASCADE_GAIN] = force * bench.lead_m_per_rad


@dataclass(frozen=True)
class VelocityGains:
    """What a PID of a bench file makes of speed; zero for another law.

    Parameters
    ----------
    proportional_Nm_per_m : float
        On command less motor.
    damping_Nm_s_per_m, feedforward_Nm_s_per_m : float
        Torque against the motor's speed, and with that of the command.
    """

    proportional_Nm_per_m: float
    damping_Nm_s_per_m: float
    feedforward_Nm_s_per_m: float

    @property
    def lacking_Nm_s_per_m(self) -> float:
        """Torque per speed that the loop takes from a motor which is where its command is."""
        return self.damping_Nm_s_per_m - self.feedforward_Nm_s_per_m


def velocity_gains(bench: Bench) -> VelocityGains:
    """Gains of a bench file that act on speed, and the one that a lack of them stretches."""
    vector = s.neutral_vector()
    _apply_controller(vector, bench)
    return VelocityGains(float(vector[s.KP]), float(vector[s.KD]), float(vector[s.KVFF]))


def _apply_pmac(vector: FloatArray, bench: Bench) -> None:
    """PID of the motor's I-variables in N m per m at the table.

    Source: Turbo PMAC Software Reference Manual p. 111-114, 124-127 (Ixx30-39, 60, 63, 67-69).
    """
    motor = bench.encoder.motor_number
    given = bench.controller.ivariables

    def ivar(number: int, default: float) -> float:
        return float(given.get(f"I{motor}{number:02d}", default))

    if ivar(60, 0.0) != 0.0:
        raise ConfigError(
            f"I{motor}60 is {ivar(60, 0.0):g}; the model closes the loop each cycle.",
            code="PC-MOD-007",
            hint="Set it to 0 and the servo period to that of the loop.",
        )
    scale, velocity_scale = ivar(8, 96.0), ivar(9, 96.0)
    per_count = bench.drive.torque_per_dac_Nm / bench.motor_resolution_m
    Ts = bench.servo_period_s
    gain = ivar(30, 2000.0)
    vector[s.KP] = gain * scale / 2.0**19 * per_count
    vector[s.KD] = gain * velocity_scale * ivar(31, 1280.0) / 2.0**26 * per_count * Ts
    vector[s.KVFF] = gain * scale * ivar(32, 1280.0) / 2.0**26 * per_count * Ts
    vector[s.KAFF] = gain * scale * ivar(35, 0.0) / 2.0**26 * per_count * Ts**2
    vector[s.KI] = gain * scale * ivar(33, 1280.0) / 2.0**42 * per_count / Ts
    vector[s.INTEGRATE_AT_REST] = 1.0 if ivar(34, 0.0) else 0.0
    vector[s.FREEZE_ALWAYS] = 1.0
    dac = bench.drive.torque_per_dac_Nm
    clamp = abs(ivar(63, 4194304.0))
    vector[s.INTEGRATOR_LIMIT] = clamp * gain * scale / 2.0**23 * dac
    # The integrator of the card knows its own limit only, not that of the drive behind it.
    vector[s.LIMIT] = ivar(69, 20480.0) * dac
    vector[s.FRICTION_FF] = ivar(68, 0.0) * dac
    vector[s.OFFSET] = ivar(29, 0.0) * dac
    for i in range(4):
        vector[s.NOTCH + i] = ivar(36 + i, 0.0)


def apply_quantisation(vector: FloatArray, bench: Bench) -> None:
    """Switch on the steps of encoder, scale and torque in a kernel vector, shape (N_SLOTS,)."""
    vector[s.MOTOR_STEP] = bench.motor_resolution_m
    vector[s.TABLE_STEP] = bench.scale_resolution_m or 0.0
    if bench.controller.kind == "pmac":
        vector[s.TORQUE_STEP] = bench.drive.torque_per_dac_Nm
