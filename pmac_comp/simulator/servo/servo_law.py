"""The control laws that the simulator closes its loops with.

What lives here: the card's PID law in its own integer units, and the two laws of benches that are
not a PMAC. What may not: memory, motors, plants. Imports numba only.

Source: Turbo PMAC Software Reference Manual p. 111-127 (gains, limits), Turbo PMAC User Manual
p. 179 (the law as a floating-point replica).
"""

import math

import numpy as np
from numba import njit

from pmac_comp.base.arrays import FloatArray

# Decoded gains of one motor.
(
    G_KP,  # Ixx30
    G_KD,  # Ixx31
    G_KVFF,  # Ixx32
    G_KI,  # Ixx33
    G_MODE,  # Ixx34
    G_KAFF,  # Ixx35
    G_SCALE,  # Ixx08
    G_VSCALE,  # Ixx09
    G_ILIMIT,  # Ixx63
    G_BANDGAIN,  # Ixx64
    G_BAND,  # Ixx65
    G_FELIMIT,  # Ixx67
    G_FRICTION,  # Ixx68
    G_OUTLIMIT,  # Ixx69
    G_OFFSET,  # Ixx29
    G_N1,
    G_N2,
    G_D1,
    G_D2,
    N_GAINS,
) = range(20)

# What the law remembers between servo cycles.
(
    L_INTEGRAL,  # IPOS, 1/(32 Ixx08) count
    L_U1,
    L_U2,
    L_Y1,
    L_Y2,
    L_SATURATED,
    L_FE,  # limited following error of this cycle
    N_LAW,
) = range(8)

_DAC24_PER_DAC16 = 256.0


@njit(cache=True)
def pid_output(
    gains: FloatArray,
    memory: FloatArray,
    fe: float,
    command_velocity: float,
    command_acceleration: float,
    actual_velocity: float,
    moving: bool,  # noqa: FBT001  a flag of the compiled law
) -> float:
    """Servo command of one cycle in 24-bit output units, before offset and torque table.

    Parameters
    ----------
    gains, memory : ndarray
        Layout of this module; ``memory`` is updated.
    fe : float
        Following error in 1/(32 Ixx08) count.
    command_velocity, command_acceleration : float
        First and second difference of the net desired position, same unit per cycle.
    actual_velocity : float
        First difference of the velocity feedback in 1/(32 Ixx09) count per cycle.
    moving : bool
        True while the desired velocity is not zero (Ixx34 = 1 then holds the integrator).
    """
    unit = gains[G_SCALE]
    limit = gains[G_FELIMIT] * 2.0 * unit  # 1/16 count
    fe = min(max(fe, -limit), limit)
    if gains[G_BANDGAIN] != 0.0:
        band = gains[G_BAND] * 2.0 * unit
        extra = gains[G_BANDGAIN] / 16.0
        fe += extra * min(max(fe, -band), band)
    memory[L_FE] = fe
    total = fe + memory[L_INTEGRAL]
    total += (
        gains[G_KVFF] * command_velocity
        + gains[G_KAFF] * command_acceleration
        - gains[G_KD] * actual_velocity
    ) / 128.0
    total *= gains[G_KP] / 65536.0
    out = (
        total
        + gains[G_N1] * memory[L_U1]
        + gains[G_N2] * memory[L_U2]
        - gains[G_D1] * memory[L_Y1]
        - gains[G_D2] * memory[L_Y2]
    )
    memory[L_U2] = memory[L_U1]
    memory[L_U1] = total
    memory[L_Y2] = memory[L_Y1]
    memory[L_Y1] = out
    if command_velocity > 0.0:
        out += gains[G_FRICTION] * _DAC24_PER_DAC16
    elif command_velocity < 0.0:
        out -= gains[G_FRICTION] * _DAC24_PER_DAC16
    top = min(gains[G_OUTLIMIT], 32767.0) * _DAC24_PER_DAC16
    memory[L_SATURATED] = 0.0
    if out > top or out < -top:
        memory[L_SATURATED] = 1.0
        out = min(max(out, -top), top)
        # A saturated law must not wind its filter up.
        memory[L_Y1] = min(max(memory[L_Y1], -2.0 * top), 2.0 * top)
    _integrate(gains, memory, moving)
    return float(math.floor(out + 0.5))


@njit(cache=True)
def _integrate(gains: FloatArray, memory: FloatArray, moving: bool) -> None:  # noqa: FBT001
    limit = abs(gains[G_ILIMIT]) * 2.0 * gains[G_SCALE]
    if limit == 0.0:
        memory[L_INTEGRAL] = 0.0
        return
    if memory[L_SATURATED] != 0.0 or (gains[G_MODE] != 0.0 and moving):
        return
    value = memory[L_INTEGRAL] + gains[G_KI] * memory[L_FE] / 8388608.0
    memory[L_INTEGRAL] = min(max(value, -limit), limit)


def default_gains() -> FloatArray:
    """Factory gains of a motor (Software Reference Manual p. 88-127)."""
    gains = np.zeros(N_GAINS)
    for index, value in {
        G_KP: 2000.0,
        G_KD: 1280.0,
        G_KVFF: 1280.0,
        G_KI: 1280.0,
        G_MODE: 1.0,
        G_SCALE: 96.0,
        G_VSCALE: 96.0,
        G_ILIMIT: 4194304.0,
        G_BAND: 16.0,
        G_FELIMIT: 4194304.0,
        G_OUTLIMIT: 20480.0,
    }.items():
        gains[index] = value
    return gains


GAIN_VARIABLES: dict[int, int] = {
    30: G_KP,
    31: G_KD,
    32: G_KVFF,
    33: G_KI,
    34: G_MODE,
    35: G_KAFF,
    8: G_SCALE,
    9: G_VSCALE,
    63: G_ILIMIT,
    64: G_BANDGAIN,
    65: G_BAND,
    67: G_FELIMIT,
    68: G_FRICTION,
    69: G_OUTLIMIT,
    29: G_OFFSET,
    36: G_N1,
    37: G_N2,
    38: G_D1,
    39: G_D2,
}
"""Last two digits of the I-variable -> index of the decoded gain."""
