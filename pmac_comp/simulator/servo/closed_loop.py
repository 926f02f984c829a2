"""A light closed loop: plant and control law without the card around it.

What lives here: ``run_closed_loop``, which gives captures quickly where the card itself is not the
subject. What may not: anything of the language, tables or gather. Imports ``files``, ``base``, the
plant and the control laws of this package.

Timing as on the card: at cycle ``k`` both sensors are latched, the law computes the torque of
cycle ``k``, the plant holds it over ``[k, k+1)``.
"""

import math
from typing import Literal

import numpy as np
from numba import njit

from pmac_comp.base.arrays import FloatArray, finite_array
from pmac_comp.base.errors import ConfigError
from pmac_comp.base.units import MM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.files.capture import Capture
from pmac_comp.simulator.plant import kernel_ballscrew as k
from pmac_comp.simulator.plant.ballscrew import BallscrewPlant
from pmac_comp.simulator.plant.door import Plant
from pmac_comp.simulator.servo import servo_law as law
from pmac_comp.simulator.servo.compiled import keep_fresh

_PMAC, _SI, _CASCADE = 0, 1, 2
_KINDS = {"pmac": _PMAC, "si": _SI, "cascade": _CASCADE}

# One vector of settings for all laws.
(
    C_KIND,
    C_PERIOD,
    C_LEAD,
    C_MOTOR_STEP,  # m per encoder step that the law sees
    C_COUNT,  # m per count
    C_TABLE_STEP,  # m, 0 = no scale
    C_TORQUE,  # N m per DAC unit
    C_LIMIT,
    C_KP,
    C_KI,
    C_KD,
    C_KVFF,
    C_KAFF,
    C_ALPHA,
    N_SETTINGS,
) = range(15)

# Law memory: that of the PID, then ours.
(
    M_COMMAND,  # previous net desired position
    M_VELOCITY,  # previous command velocity
    M_ACTUAL,
    M_ACTUAL2,
    M_FILTERED,
    M_INTEGRAL,
    N_MEMORY,
) = range(law.N_LAW, law.N_LAW + 7)

(R_MOTOR, R_TABLE, R_TORQUE, R_TRUE_MOTOR, R_TRUE_TABLE, N_RESULTS) = range(6)
_FULL_SCALE_DAC = 32768.0
_EXTENSION_STEPS = 32.0  # 1/T extension resolves 1/32 count


@njit(cache=True)
def _quantised(value: float, step: float) -> float:
    return math.floor(value / step + 0.5) * step if step > 0.0 else value


@njit(cache=True)
def law_torque(
    setting: FloatArray, gains: FloatArray, memory: FloatArray, desired: float, motor: float
) -> float:
    """Torque command in N m of one cycle, before feed-forward and limit."""
    kind = setting[C_KIND]
    if kind == 0.0:
        unit = 32.0 * gains[law.G_SCALE] / setting[C_COUNT]
        command = math.floor(desired * unit + 0.5)
        actual = motor * unit
        velocity = command - memory[M_COMMAND]
        acceleration = velocity - memory[M_VELOCITY]
        feedback = (actual - memory[M_ACTUAL]) * gains[law.G_VSCALE] / gains[law.G_SCALE]
        memory[M_COMMAND] = command
        memory[M_VELOCITY] = velocity
        memory[M_ACTUAL] = actual
        out = law.pid_output(
            gains, memory, command - actual, velocity, acceleration, feedback, velocity != 0.0
        )
        top = 32767.0 * 256.0
        out = min(max(out + 256.0 * gains[law.G_OFFSET], -top), top)
        return float(math.floor(out / 256.0) * setting[C_TORQUE])
    period = setting[C_PERIOD]
    if kind == 1.0:
        velocity = (desired - memory[M_COMMAND]) / period
        acceleration = (velocity - memory[M_VELOCITY]) / period
        speed = (motor - memory[M_ACTUAL]) / period
        memory[M_FILTERED] += setting[C_ALPHA] * (speed - memory[M_FILTERED])
        memory[M_COMMAND] = desired
        memory[M_VELOCITY] = velocity
        memory[M_ACTUAL] = motor
        error = desired - motor
        step = setting[C_KI] * period * error
        rest = (
            setting[C_KP] * error
            - setting[C_KD] * memory[M_FILTERED]
            + setting[C_KVFF] * velocity
            + setting[C_KAFF] * acceleration
        )
        total = rest + memory[M_INTEGRAL] + step
        # The integrator stands still while the output is clipped in the direction of the error.
        if not (
            (total > setting[C_LIMIT] and error > 0.0)
            or (total < -setting[C_LIMIT] and error < 0.0)
        ):
            memory[M_INTEGRAL] += step
        return float(rest + memory[M_INTEGRAL])
    # Velocity: backward difference of a two-point average (EMPS record).
    speed = (motor - memory[M_ACTUAL2]) / (2.0 * period)
    memory[M_ACTUAL2] = memory[M_ACTUAL]
    memory[M_ACTUAL] = motor
    return float(setting[C_KD] * (setting[C_KP] * (desired - motor) - speed) * setting[C_KAFF])


@njit(cache=True)
def _start_law(
    setting: FloatArray, gains: FloatArray, memory: FloatArray, m: float, d: float
) -> None:
    """Law at rest at motor position ``m`` with the desired position ``d``, both in m."""
    memory[:] = 0.0
    if setting[C_KIND] == 0.0:
        unit = 32.0 * gains[law.G_SCALE] / setting[C_COUNT]
        memory[M_COMMAND] = math.floor(d * unit + 0.5)
        memory[M_ACTUAL] = m * unit
    else:
        memory[M_COMMAND] = d
        memory[M_ACTUAL] = m
        memory[M_ACTUAL2] = m


@njit(cache=True, nogil=True)
def _run_ballscrew(
    setting: FloatArray,
    gains: FloatArray,
    state: FloatArray,
    par: FloatArray,
    log: FloatArray,
    desired: FloatArray,
    forward: FloatArray,
    force: FloatArray,
    out: FloatArray,
) -> None:
    memory = np.zeros(N_MEMORY)
    lead = setting[C_LEAD]
    limit = setting[C_LIMIT]
    motor = _quantised(state[k.S_ANGLE_READ] * lead, setting[C_MOTOR_STEP])
    _start_law(setting, gains, memory, motor, desired[0])
    for i in range(desired.size):
        if force.size > 0:
            state[k.S_EXTERNAL] = force[i]
        motor = _quantised(state[k.S_ANGLE_READ] * lead, setting[C_MOTOR_STEP])
        torque = law_torque(setting, gains, memory, desired[i], motor) + forward[i]
        torque = min(max(torque, -limit), limit)
        out[i, 0] = motor
        out[i, 1] = _quantised(state[k.S_TABLE_READ], setting[C_TABLE_STEP])
        out[i, 2] = torque
        out[i, 3] = lead * state[k.S_TH_MOTOR]
        out[i, 4] = state[k.S_TABLE]
        k.ballscrew_step(state, par, log, torque)


keep_fresh(_run_ballscrew, law, k)
keep_fresh(law_torque, law)


def run_closed_loop(
    bench: Bench,
    plant: Plant,
    commanded_position_m: FloatArray,
    *,
    desired_position_m: FloatArray | None = None,
    torque_feedforward_Nm: FloatArray | None = None,
    external_force_N: FloatArray | None = None,
    start: Literal["rest", "continue"] = "rest",
) -> dict[str, FloatArray]:
    """Signals of a closed-loop run of a plant under the bench's control law.

    Parameters
    ----------
    bench : Bench
        Control law, sensors, servo period.
    plant : Plant
        ``make_plant(bench)`` runs compiled; any other plug-in plant runs cycle by cycle.
    commanded_position_m : ndarray, shape (n,)
        Trajectory at the servo period, table coordinates.
    desired_position_m : ndarray, shape (n,), or None
        Trajectory with compensation; None means no compensation.
    torque_feedforward_Nm, external_force_N : ndarray, shape (n,), or None
        Added to the torque; load on the table (positive pushes against positive motion).
    start : "rest" or "continue"
        ``rest`` resets the plant onto the first command; ``continue`` goes on where it is.

    Returns
    -------
    dict
        ``time_s, commanded_position_m, desired_position_m, motor_position_m, torque_command_Nm``,
        ``table_position_m`` if the bench has a scale, and the unquantised truth
        ``true_motor_position_m, true_table_position_m``; each shape (n,), sampled at the latch.
    """
    commanded = finite_array("commanded_position_m", commanded_position_m)
    desired = _same_size("desired_position_m", desired_position_m, commanded, commanded)
    zero = np.zeros_like(commanded)
    forward = _same_size("torque_feedforward_Nm", torque_feedforward_Nm, commanded, zero)
    force = _same_size("external_force_N", external_force_N, commanded, zero)
    setting = _settings(bench)
    gains = _gains(bench)
    if start == "rest":
        plant.reset(float(commanded[0]))
    out = np.zeros((commanded.size, N_RESULTS))
    if isinstance(plant, BallscrewPlant):
        # Also without a load: that of an earlier run is over.
        _run_ballscrew(
            setting, gains, plant.state, plant.par, plant.log, desired, forward, force, out
        )
    else:
        _run_python(setting, gains, plant, desired, forward, force, out)
    return _signals(bench, commanded, desired, out)


def closed_loop_capture(
    bench: Bench,
    plant: Plant,
    commanded_position_m: FloatArray,
    *,
    desired_position_m: FloatArray | None = None,
    torque_feedforward_Nm: FloatArray | None = None,
    external_force_N: FloatArray | None = None,
    start: Literal["rest", "continue"] = "rest",
) -> Capture:
    """Capture of ``run_closed_loop``; the truth is in ``extra`` under its own names."""
    run = run_closed_loop(
        bench,
        plant,
        commanded_position_m,
        desired_position_m=desired_position_m,
        torque_feedforward_Nm=torque_feedforward_Nm,
        external_force_N=external_force_N,
        start=start,
    )
    return Capture(
        time_s=run["time_s"],
        commanded_position_m=run["commanded_position_m"],
        desired_position_m=run["desired_position_m"],
        motor_position_m=run["motor_position_m"],
        table_position_m=run.get("table_position_m"),
        torque_command_Nm=run["torque_command_Nm"],
        valid=np.ones(run["time_s"].size, dtype=np.bool_),
        extra={name: run[name] for name in run if name.startswith("true_")},
        attributes={
            "source": "simulated closed loop",
            "servo_period_s": bench.servo_period_s,
            "bench_text": bench.text,
        },
    )


def _same_size(
    name: str, value: FloatArray | None, like: FloatArray, default: FloatArray
) -> FloatArray:
    if value is None:
        return default
    array = finite_array(name, value)
    if array.size != like.size:
        raise ConfigError(
            f"{name} has {array.size} samples, the command has {like.size}.",
            code="PC-SIM-001",
            hint="Give both at the servo period and of the same length.",
        )
    return array


def _run_python(
    setting: FloatArray,
    gains: FloatArray,
    plant: Plant,
    desired: FloatArray,
    forward: FloatArray,
    force: FloatArray,
    out: FloatArray,
) -> None:
    """The same loop for a plant that is a Python object; truth is what its sensors would see."""
    memory = np.zeros(N_MEMORY)
    lead = float(setting[C_LEAD])
    limit = float(setting[C_LIMIT])
    push = getattr(plant, "set_external_force", None)
    angle = float(desired[0]) / lead
    table = float(desired[0])
    reading = getattr(plant, "reading", None)
    if reading is not None:
        angle, table = reading()
    motor = float(_quantised(angle * lead, setting[C_MOTOR_STEP]))
    _start_law(setting, gains, memory, motor, desired[0])
    for i in range(desired.size):
        if push is not None:
            push(float(force[i]))
        motor = float(_quantised(angle * lead, setting[C_MOTOR_STEP]))
        torque = law_torque(setting, gains, memory, desired[i], motor) + float(forward[i])
        torque = min(max(torque, -limit), limit)
        seen = _quantised(table, setting[C_TABLE_STEP])
        out[i] = (motor, seen, torque, angle * lead, table)
        angle, table = plant.step(torque)


def _signals(
    bench: Bench, commanded: FloatArray, desired: FloatArray, out: FloatArray
) -> dict[str, FloatArray]:
    signals: dict[str, FloatArray] = {
        "time_s": np.arange(commanded.size, dtype=np.float64) * bench.servo_period_s,
        "commanded_position_m": commanded.copy(),
        "desired_position_m": desired.copy(),
        "motor_position_m": out[:, R_MOTOR].copy(),
        "torque_command_Nm": out[:, R_TORQUE].copy(),
        "true_motor_position_m": out[:, R_TRUE_MOTOR].copy(),
        "true_table_position_m": out[:, R_TRUE_TABLE].copy(),
    }
    if bench.scale is not None:
        signals["table_position_m"] = out[:, R_TABLE].copy()
    return signals


def _settings(bench: Bench) -> FloatArray:
    setting = np.zeros(N_SETTINGS)
    setting[C_KIND] = _KINDS[bench.controller.kind]
    setting[C_PERIOD] = bench.servo_period_s
    setting[C_LEAD] = bench.lead_m_per_rad
    setting[C_COUNT] = bench.motor_resolution_m
    steps = _EXTENSION_STEPS if bench.encoder.extension == "1/T" else 1.0
    setting[C_MOTOR_STEP] = bench.motor_resolution_m / steps
    setting[C_TABLE_STEP] = bench.scale_resolution_m or 0.0
    setting[C_TORQUE] = bench.drive.torque_per_dac_Nm
    setting[C_LIMIT] = bench.drive.torque_limit_Nm
    if setting[C_KIND] == _PMAC:  # Ixx69 limits what a card sends; the drive's limit is the plant's
        setting[C_LIMIT] = _FULL_SCALE_DAC * bench.drive.torque_per_dac_Nm
    if bench.controller.si is not None:
        _si_settings(bench, setting)
    if bench.controller.cascade is not None and setting[C_KIND] == _CASCADE:
        cascade = bench.controller.cascade
        setting[C_KP] = cascade.kp_per_s
        setting[C_KD] = cascade.kv_V_per_m_per_s
        setting[C_KAFF] = cascade.gain_N_per_V * bench.lead_m_per_rad
    return setting


def _si_settings(bench: Bench, setting: FloatArray) -> None:
    si = bench.controller.si
    if si is None:
        return
    setting[C_KP] = si.Kp_Nm_per_mm * MM_PER_M
    setting[C_KI] = si.Ki_Nm_per_mm_s * MM_PER_M
    setting[C_KD] = si.Kd_Nm_s_per_mm * MM_PER_M
    setting[C_KVFF] = si.Kvff_Nm_s_per_mm * MM_PER_M
    setting[C_KAFF] = si.Kaff_Nm_s2_per_mm * MM_PER_M
    setting[C_ALPHA] = si.velocity_filter_alpha


def _gains(bench: Bench) -> FloatArray:
    gains = law.default_gains()
    motor = bench.encoder.motor_number
    for tail, index in law.GAIN_VARIABLES.items():
        value = bench.controller.ivariables.get(f"I{motor * 100 + tail}")
        if value is not None:
            gains[index] = value
    return gains
