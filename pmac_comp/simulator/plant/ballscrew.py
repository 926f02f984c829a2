"""The simulated ball-screw drive: parameters, hidden truth and the plug-in door.

What lives here: how a bench file becomes the true drive behind the simulated card (which differs
from the bench within its tolerances, and holds friction and effects the bench does not mention).
What may not: anything of the model that is fitted. Imports ``files``, ``base`` and the kernel.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.errors import ConfigError
from pmac_comp.base.units import MM_PER_M, UM_PER_M, US_PER_S
from pmac_comp.files.bench import Bench, STEEL_DENSITY_kg_per_m3
from pmac_comp.simulator.plant import kernel_ballscrew as k
from pmac_comp.simulator.plant.effects import PlantEffects, apply_effects

# Figures of the paper's drive that a bench file does not carry: chosen so that its first resonance
# lies at the 130.6 Hz that the paper measured.
_TABLE_REFERENCE_kg = 122.86
_TORQUE_REFERENCE_Nm = 19.11
_GUIDE_COULOMB_N = 45.0
_GUIDE_VISCOUS_Ns_per_m = 200.0
_MOTOR_COULOMB_Nm = 0.20
_NUT_COULOMB_Nm = 0.25
_ROTARY_VISCOUS_Nms_per_rad = 1e-3
_COUPLING_SHARE = 1.0e-4 / 5.45e-4
_BEARING_OVER_NUT = 211.0 / 180.0
_DAMPING_s = 7.3e-5
# Width of the stick zone where no presliding was asked for: far below any sensor.
_SHARP_GUIDE_m = 4e-8
_SHARP_ROTARY_rad = 2e-5
# Mechanical stops: a rubber buffer a little behind the end switches.
_STOP_BEHIND_TRAVEL_m = 10e-3
_STOP_STIFFNESS_N_per_m = 5e6
_STOP_DAMPING = 0.3  # of critical, with the table on it
_STEP_TIMES_OMEGA = 0.45  # largest elastic phase per fine step; leapfrog is stable below 2
_STEP_TIMES_DECAY = 1.0  # the same for structural damping, beta omega^2 dt; stable below 2
_FRICTION_SPREAD = 0.15


def hidden_effects() -> dict[str, dict[str, float | str]]:
    """Effects of the default drive that a bench file's base model does not hold."""
    return {
        "stribeck": {"excess_N": 15.0, "speed_m_per_s": 0.005},
        "presliding": {"distance_um": 10.0, "place": "guide"},
        "post_reversal_dip": {"fraction": 0.25, "length_mm": 1.5},
        "friction_per_rev": {"amplitude_Nm": 0.03, "order_per_rev": 1.0, "phase_rad": 0.7},
        "cogging": {"amplitude_Nm": 0.04, "order_per_rev": 20.0, "phase_rad": 0.3},
        "bias_force": {"force_N": 5.0},
        "lead_linear": {"slope_um_per_m": 35.0},
        "lead_cyclic": {"amplitude_um": 2.0, "order_per_rev": 1.0, "phase_rad": 1.1},
    }


@dataclass(frozen=True)
class DriveTruth:
    """True quantities of the drive under the names of the bench file, and its hidden ones."""

    motor_inertia_kgm2: float
    screw_inertia_kgm2: float
    table_mass_kg: float
    torsional_stiffness_Nm_per_rad: float
    axial_stiffness_N_per_um: float
    screw_rigidity_N: float
    efficiency: float
    current_bandwidth_Hz: float
    actuator_delay_us: float
    guide_coulomb_N: float
    guide_viscous_Ns_per_m: float
    motor_coulomb_Nm: float
    nut_coulomb_Nm: float
    motor_viscous_Nms_per_rad: float
    nut_viscous_Nms_per_rad: float
    damping_time_us: float
    resonance_Hz: float


class BallscrewPlant:
    """Ball-screw drive behind the plug-in door, with a compiled door beside it.

    Parameters
    ----------
    par : ndarray, shape (N_PARAMETERS,)
        Kernel parameters, see ``kernel_ballscrew``.
    truth : DriveTruth
        What the parameters mean, for reports and tests.
    effects : Mapping
        Effects that were switched on.
    """

    def __init__(self, par: FloatArray, truth: DriveTruth, effects: PlantEffects) -> None:
        self.par = par
        self.truth = truth
        self.effects: Mapping[str, Mapping[str, float | str]] = dict(effects)
        self.state: FloatArray = np.zeros(k.N_STATES)
        self.log: FloatArray = k.empty_log()
        self.reset()

    @property
    def lead_m_per_rad(self) -> float:
        """Screw lead in m/rad."""
        return float(self.par[k.P_LEAD])

    def reset(self, table_position_m: float = 0.0) -> None:
        """Put the relaxed drive at rest with the nut at a table position in m."""
        k.ballscrew_reset(self.state, self.par, table_position_m)

    def step(self, torque_command_Nm: float) -> tuple[float, float]:
        """Motor angle in rad and table position in m latched after one period of this torque."""
        k.ballscrew_step(self.state, self.par, self.log, float(torque_command_Nm))
        return float(self.state[k.S_ANGLE_READ]), float(self.state[k.S_TABLE_READ])

    def reading(self) -> tuple[float, float]:
        """Present sensor readings: motor angle in rad, table position in m."""
        return float(self.state[k.S_ANGLE_READ]), float(self.state[k.S_TABLE_READ])

    def set_external_force(self, force_N: float) -> None:
        """Force on the table in N; positive pushes against positive motion."""
        self.state[k.S_EXTERNAL] = force_N

    def record(self, n_cycles: int) -> None:
        """Start a ring of true values for the latest ``n_cycles`` servo periods; 0 stops it."""
        self.log = np.zeros((n_cycles, 4))
        self.state[k.S_RECORDED] = 0.0

    def recorded(self) -> dict[str, FloatArray]:
        """True values since ``record``, oldest first.

        Returns
        -------
        dict
            ``cycle`` (periods since reset), ``motor_position_m``, ``table_position_m`` and
            ``torque_Nm`` (at the shaft), each shape (n,).
        """
        count = int(self.state[k.S_RECORDED])
        capacity = self.log.shape[0]
        rows = np.arange(max(0, count - capacity), count) % max(capacity, 1)
        table = self.log[rows] if capacity else np.zeros((0, 4))
        names = ("cycle", "motor_position_m", "table_position_m", "torque_Nm")
        return {name: table[:, i].copy() for i, name in enumerate(names)}

    def run(self, torque_command_Nm: FloatArray) -> FloatArray:
        """Sensor readings of an open-loop run, shape (n, 2): angle in rad, table in m."""
        out = np.zeros((torque_command_Nm.size, 2))
        torque = np.ascontiguousarray(torque_command_Nm, dtype=np.float64)
        k.ballscrew_run(self.state, self.par, self.log, torque, out)
        return out


def make_plant(
    bench: Bench, *, effects: PlantEffects | None = None, seed: int = 0, spread: float = 1.0
) -> BallscrewPlant:
    """The true drive of a bench.

    Parameters
    ----------
    bench : Bench
        What the user knows.
    effects : mapping of effect name to parameters, or None
        Effects on top of the elastic chain with Coulomb and viscous friction; None gives the
        default set (``hidden_effects``), an empty mapping none.
    seed : int
        Draws the true quantities within the tolerances of the bench.
    spread : float
        Share of the tolerances that is used; 0 makes the truth nominal.

    Raises
    ------
    ConfigError
        A quantity that the drive needs is missing in the bench file.
    """
    truth = _draw_truth(bench, seed, spread)
    par = _kernel_parameters(bench, truth)
    chosen = hidden_effects() if effects is None else effects
    apply_effects(par, chosen)
    _choose_steps(par)
    return BallscrewPlant(par, truth, chosen)


def _draw_truth(bench: Bench, seed: int, spread: float) -> DriveTruth:
    rng = np.random.default_rng(seed)

    def drawn(value: float, width: float) -> float:
        return value * (1.0 + spread * width * float(np.clip(rng.normal(0.0, 0.5), -0.9, 0.9)))

    tolerance = bench.tolerance
    values = {
        name: drawn(_nominal(bench, name), getattr(tolerance, name))
        for name in type(tolerance).model_fields
    }
    values["efficiency"] = min(values["efficiency"], 0.999)
    mass = values["table_mass_kg"] / _TABLE_REFERENCE_kg
    torque = min(bench.drive.torque_limit_Nm, 10.0 * _TORQUE_REFERENCE_Nm) / _TORQUE_REFERENCE_Nm
    truth = DriveTruth(
        **values,
        guide_coulomb_N=drawn(_GUIDE_COULOMB_N * mass, _FRICTION_SPREAD),
        guide_viscous_Ns_per_m=drawn(_GUIDE_VISCOUS_Ns_per_m * mass, _FRICTION_SPREAD),
        motor_coulomb_Nm=drawn(_MOTOR_COULOMB_Nm * torque, _FRICTION_SPREAD),
        nut_coulomb_Nm=drawn(_NUT_COULOMB_Nm * torque, _FRICTION_SPREAD),
        motor_viscous_Nms_per_rad=drawn(_ROTARY_VISCOUS_Nms_per_rad * torque, _FRICTION_SPREAD),
        nut_viscous_Nms_per_rad=drawn(_ROTARY_VISCOUS_Nms_per_rad * torque, _FRICTION_SPREAD),
        damping_time_us=drawn(_DAMPING_s * US_PER_S, _FRICTION_SPREAD),
        resonance_Hz=0.0,
    )
    return _match_resonance(bench, truth)


def _nominal(bench: Bench, name: str) -> float:
    value = getattr(bench.nominal, name)
    if value is not None:
        return float(value)
    assumed = {
        "efficiency": 0.96,
        "current_bandwidth_Hz": 300.0,
        "actuator_delay_us": bench.servo_period_s * US_PER_S,
        "screw_rigidity_N": bench.screw_rigidity_N,
        "screw_inertia_kgm2": _solid_inertia_kgm2(bench),
    }
    if name not in assumed:
        raise ConfigError(
            f"The simulated drive needs [nominal] {name}, which this bench file does not state.",
            code="PC-PLT-004",
            hint="State it, or give a plant of your own with --plant.",
        )
    return assumed[name]


def _solid_inertia_kgm2(bench: Bench) -> float:
    diameter_m = 0.96 * bench.screw.diameter_mm / MM_PER_M
    mass = STEEL_DENSITY_kg_per_m3 * math.pi / 4.0 * diameter_m**2
    return mass * bench.screw.length_mm / MM_PER_M * diameter_m**2 / 8.0


def _match_resonance(bench: Bench, truth: DriveTruth) -> DriveTruth:
    """A measured resonance is a fact: scale the axial stiffness of the drawn drive to it."""
    target = bench.known.resonance_Hz
    at_m = (bench.known.resonance_at_mm or 0.0) / MM_PER_M
    if target is None:
        found = resonance_Hz(_kernel_parameters(bench, truth), at_m)
        return DriveTruth(**{**truth.__dict__, "resonance_Hz": found})
    low, high = 0.3, 3.0
    scaled = truth
    for _ in range(50):
        factor = math.sqrt(low * high)
        axial = truth.axial_stiffness_N_per_um * factor
        scaled = DriveTruth(
            **{**truth.__dict__, "axial_stiffness_N_per_um": axial, "resonance_Hz": target}
        )
        found = resonance_Hz(_kernel_parameters(bench, scaled), at_m)
        low, high = (factor, high) if found < target else (low, factor)
    if abs(found - target) > 0.01 * target:
        return DriveTruth(**{**truth.__dict__, "resonance_Hz": found})
    return scaled


def _kernel_parameters(bench: Bench, truth: DriveTruth) -> FloatArray:
    length_m = bench.screw.length_mm / MM_PER_M
    per_length = truth.screw_inertia_kgm2 / length_m
    diameter_m = (32.0 * per_length / (math.pi * STEEL_DENSITY_kg_per_m3)) ** 0.25
    axial = truth.axial_stiffness_N_per_um * UM_PER_M
    coupling = _COUPLING_SHARE * truth.motor_inertia_kgm2
    lead = bench.lead_m_per_rad
    par = np.zeros(k.N_PARAMETERS)
    values = {
        k.P_PERIOD: bench.servo_period_s,
        k.P_LEAD: lead,
        k.P_ORIGIN: bench.bearing_to_table_zero_m,
        k.P_LENGTH: length_m,
        k.P_J_MOTOR: truth.motor_inertia_kgm2 - 0.5 * coupling,
        k.P_J_COUPLING: 0.5 * coupling,
        k.P_J_SCREW: truth.screw_inertia_kgm2,
        k.P_M_SCREW: STEEL_DENSITY_kg_per_m3 * math.pi / 4.0 * diameter_m**2 * length_m,
        k.P_M_TABLE: truth.table_mass_kg,
        k.P_K_COUPLING: truth.torsional_stiffness_Nm_per_rad,
        k.P_GJ: bench.torsional_rigidity_Nm2 * truth.screw_rigidity_N / bench.screw_rigidity_N,
        # Two springs in series with the given quotient.
        k.P_K_BEARING: axial * (1.0 + _BEARING_OVER_NUT),
        k.P_K_NUT: axial * (1.0 + 1.0 / _BEARING_OVER_NUT),
        k.P_EA: truth.screw_rigidity_N,
        k.P_BETA: truth.damping_time_us / US_PER_S,
        k.P_BANDWIDTH: 2.0 * math.pi * truth.current_bandwidth_Hz,
        k.P_DELAY: truth.actuator_delay_us / US_PER_S,
        k.P_LIMIT: bench.drive.torque_limit_Nm,
        k.P_MOTOR_LEVEL: truth.motor_coulomb_Nm,
        k.P_MOTOR_BREAK: _SHARP_ROTARY_rad,
        k.P_MOTOR_VISCOUS: truth.motor_viscous_Nms_per_rad,
        k.P_NUT_LEVEL: truth.nut_coulomb_Nm,
        k.P_NUT_BREAK: _SHARP_ROTARY_rad,
        k.P_NUT_VISCOUS: truth.nut_viscous_Nms_per_rad,
        k.P_NUT_LOAD: (1.0 / truth.efficiency - 1.0) * lead,
        k.P_GUIDE_LEVEL: truth.guide_coulomb_N,
        k.P_GUIDE_BREAK: _SHARP_GUIDE_m,
        k.P_GUIDE_VISCOUS: truth.guide_viscous_Ns_per_m,
        k.P_STRIBECK_SPEED: 0.005,
        k.P_SQRT_EXPONENT: 0.5,
        k.P_DIP_LENGTH: 1e-3,
        k.P_WARM_TAU: 1.0,
        k.P_GROWTH_TAU: 1.0,
        k.P_SDE_PERIOD: 20e-6,
        k.P_N_COARSE: 4.0,
        k.P_N_FINE: 3.0,
    }
    for index, value in values.items():
        par[index] = value
    _set_stops(par, bench)
    # Damping of the sharp stick zone, a third of critical, so that a stuck axis does not ring.
    par[k.P_GUIDE_DAMPING] = 0.6 * math.sqrt(
        truth.guide_coulomb_N / _SHARP_GUIDE_m * truth.table_mass_kg
    )
    par[k.P_MOTOR_DAMPING] = 0.6 * math.sqrt(
        truth.motor_coulomb_Nm / _SHARP_ROTARY_rad * truth.motor_inertia_kgm2
    )
    par[k.P_NUT_DAMPING] = 0.6 * math.sqrt(
        truth.nut_coulomb_Nm / _SHARP_ROTARY_rad * truth.screw_inertia_kgm2
    )
    return par


def _set_stops(par: FloatArray, bench: Bench) -> None:
    """Stops behind the travel of the bench, at the latest where the nut would leave the screw."""
    high_m = bench.travel.max_mm / MM_PER_M + _STOP_BEHIND_TRAVEL_m
    low_m = bench.travel.min_mm / MM_PER_M - _STOP_BEHIND_TRAVEL_m
    par[k.P_STOP_HIGH] = min(high_m, par[k.P_LENGTH] - par[k.P_ORIGIN])
    par[k.P_STOP_LOW] = max(low_m, -par[k.P_ORIGIN])
    par[k.P_STOP_K] = _STOP_STIFFNESS_N_per_m
    par[k.P_STOP_C] = 2.0 * _STOP_DAMPING * math.sqrt(_STOP_STIFFNESS_N_per_m * par[k.P_M_TABLE])


def modal_frequencies_Hz(par: FloatArray, table_position_m: float) -> FloatArray:
    """Natural frequencies of the elastic chain in Hz, ascending, the rigid mode first.

    Source: equations of motion of the four-degree-of-freedom drive, built as matrices here and
    as a recursion in the kernel.
    """
    from scipy.linalg import eigh

    x = par[k.P_ORIGIN] + table_position_m
    near = x / par[k.P_LENGTH]
    rho = par[k.P_LEAD]
    c_torsion = 1.0 / par[k.P_K_COUPLING] + x / par[k.P_GJ]
    a = 1.0 / par[k.P_K_COUPLING] / c_torsion
    c_axial = 1.0 / par[k.P_K_BEARING] + x / par[k.P_EA]
    b = 1.0 / par[k.P_K_BEARING] / c_axial
    mass = np.zeros((4, 4))
    mass[0, 0] = par[k.P_J_MOTOR]
    ends = np.array([[1.0 - a, a], [0.0, 1.0]])
    rod = par[k.P_J_SCREW] * near / 6.0 * np.array([[2.0, 1.0], [1.0, 2.0]])
    rod[0, 0] += par[k.P_J_COUPLING]
    mass[:2, :2] += ends.T @ rod @ ends
    mass[1, 1] += par[k.P_J_SCREW] * (1.0 - near)
    mass[2, 2] = par[k.P_M_SCREW] * (near / 3.0 * (b * b + b + 1.0) + 1.0 - near)
    mass[3, 3] = par[k.P_M_TABLE]
    joint = np.array([0.0, -rho, -1.0, 1.0])
    stiffness = par[k.P_K_NUT] * np.outer(joint, joint)
    stiffness[:2, :2] += np.array([[1.0, -1.0], [-1.0, 1.0]]) / c_torsion
    stiffness[2, 2] += 1.0 / c_axial
    squares = eigh(stiffness, mass, eigvals_only=True)
    return np.asarray(np.sqrt(np.clip(squares, 0.0, None)) / (2.0 * math.pi))


def resonance_Hz(par: FloatArray, table_position_m: float = 0.0) -> float:
    """First resonance with the motor free, in Hz."""
    return float(modal_frequencies_Hz(par, table_position_m)[1])


def _choose_steps(par: FloatArray) -> None:
    """Fine grid from the fastest elastic mode at either end of the screw.

    Forces are those at the start of a step: a heavily damped mode, which decays with
    ``beta omega^2``, asks for more steps than its frequency does.
    """
    ends = (-par[k.P_ORIGIN] + 0.02, par[k.P_LENGTH] - par[k.P_ORIGIN])
    fastest = max(float(modal_frequencies_Hz(par, end)[-1]) for end in ends)
    omega = 2.0 * math.pi * fastest
    rate = max(omega / _STEP_TIMES_OMEGA, par[k.P_BETA] * omega**2 / _STEP_TIMES_DECAY)
    needed = rate * par[k.P_PERIOD]
    fine = max(3, math.ceil(needed / par[k.P_N_COARSE]))
    if fine > 100:
        raise ConfigError(
            f"The fastest mode of this drive is {fastest:.0f} Hz; that needs {fine} fine steps.",
            code="PC-PLT-005",
            hint="Check stiffness and mass in [nominal] and chain damping, or give a plant of "
            "your own.",
        )
    par[k.P_N_FINE] = fine
