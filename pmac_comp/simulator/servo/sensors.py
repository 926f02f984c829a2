"""What the card sees of the world in every servo cycle: encoder, scale, switches, and their faults.

What lives here: the layout of the ``world`` vector between plant and card, and the latch that fills
the channel registers from it. What may not: motors, the servo law. Imports ``encoder``.

Faults of the sensors are commanded by tests (`commanded_faults`): a lost encoder and a stuck scale
keep their last value, a noisy scale adds noise of its own that repeats from run to run.
"""

import math

import numpy as np
from numba import njit

from pmac_comp.base.arrays import FloatArray
from pmac_comp.simulator.memory.memory import Space
from pmac_comp.simulator.servo import encoder

(
    W_KIND,  # 0 the plant runs outside, 1 compiled ball screw
    W_ANGLE,
    W_TABLE,
    W_COUNTS_PER_RAD,
    W_COUNTS_PER_M,
    W_ENCODER_MOTOR,
    W_SCALE_MOTOR,
    W_ENCODER_CHANNEL,
    W_SCALE_CHANNEL,
    W_TORQUE_PER_DAC,
    W_PLIM,
    W_MLIM,
    W_HOME,
    W_INPUT,  # MI2
    W_TORQUE,  # torque command of this cycle
    W_ENCODER_SIGN,
    W_COUNTS_PER_REV,
    W_CYCLE_MS,
    W_CAPTURE,  # I7mn2 of the encoder's channel
    W_FLAG_SELECT,  # I7mn3
    W_COUNT,  # what the encoder shows, counts with the sign of I7mn0
    W_ENCODER_LOST,  # 1: the counter stands still
    W_SCALE_STUCK,  # 1: the scale keeps its value
    W_SCALE_SHOWN,  # m
    W_SCALE_NOISE,  # m, standard deviation
    W_NOISE_STATE,
    W_FORCED_FLAGS,  # bits of the channel's status word that are on whatever the table does
    N_WORLD,
) = range(28)
INDEX_FLAG, HOME_FLAG = encoder.INDEX_FLAG, 1 << 16
POSITIVE_FLAG, NEGATIVE_FLAG = 1 << 17, 1 << 18
_FLAGS = INDEX_FLAG | HOME_FLAG | POSITIVE_FLAG | NEGATIVE_FLAG
# Minimal standard generator; a double holds its products exactly.
_GENERATOR, _MODULUS = 16807.0, 2147483647.0


@njit(cache=True)
def latch(x: Space, y: Space, world: FloatArray) -> None:
    """Latch what the plant shows into the channels of encoder and scale."""
    channel = int(world[W_ENCODER_CHANNEL])
    if channel > 0:
        _latch_encoder(x, y, world, channel)
    channel = int(world[W_SCALE_CHANNEL])
    if channel > 0:
        if world[W_SCALE_STUCK] == 0.0:
            world[W_SCALE_SHOWN] = world[W_TABLE]
        table = world[W_SCALE_SHOWN]
        if world[W_SCALE_NOISE] != 0.0:
            table += world[W_SCALE_NOISE] * _noise(world)
        encoder.latch_channel(x, y, channel, table * world[W_COUNTS_PER_M], 1)


@njit(cache=True)
def _latch_encoder(x: Space, y: Space, world: FloatArray, channel: int) -> None:
    sign = world[W_ENCODER_SIGN]
    before = world[W_COUNT]
    if world[W_ENCODER_LOST] == 0.0:
        world[W_COUNT] = world[W_ANGLE] * world[W_COUNTS_PER_RAD] * sign
    count = world[W_COUNT]
    encoder.latch_channel(x, y, channel, count, 1)
    per_rev = world[W_COUNTS_PER_REV]
    flags = int(world[W_FORCED_FLAGS])
    if abs(count - per_rev * math.floor(count / per_rev + 0.5)) < 0.5:
        flags |= INDEX_FLAG
    table = world[W_TABLE]
    if table < world[W_HOME]:
        flags |= HOME_FLAG
    if table > world[W_PLIM]:
        flags |= POSITIVE_FLAG
    if table < world[W_MLIM]:
        flags |= NEGATIVE_FLAG
    x[channel] = (int(x[channel]) & ~_FLAGS) | flags
    if not x[channel] & encoder.CAPTURED:
        control, select = int(world[W_CAPTURE]), int(world[W_FLAG_SELECT])
        encoder.capture_channel(x, channel, control, select, before, count, per_rev)


@njit(cache=True)
def _noise(world: FloatArray) -> float:
    """Next value of zero mean and unit variance (sum of twelve uniform values)."""
    total = -6.0
    state = world[W_NOISE_STATE]
    for _ in range(12):
        state = (state * _GENERATOR) % _MODULUS
        total += state / _MODULUS
    world[W_NOISE_STATE] = state
    return total


def new_world() -> FloatArray:
    """World without a plant, sound sensors."""
    world = np.zeros(N_WORLD)
    world[W_NOISE_STATE] = 20261.0
    return world
