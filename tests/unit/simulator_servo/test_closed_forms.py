"""Whole servo cycles against numbers worked out by hand: notch, torque table, 2-D table.

The drive is one that does not move unless told to, so that every input of the loop is known.
"""

import itertools

import numpy as np
import pytest

from pmac_comp.simulator.memory import registers as reg
from pmac_comp.simulator.memory.memory import Memory
from pmac_comp.simulator.servo.compensation import CompensationTables, TableKind

from .conftest import BENCH, new_servo

UNIT = 32 * 96
COUNT_m = BENCH.screw.pitch_mm / 1e3 / BENCH.encoder.counts_per_rev


class Placed:
    """Axis that stands where it is put."""

    def __init__(self):
        self.counts = 0.0

    def reset(self, table_position_m=0.0):
        self.counts = table_position_m / COUNT_m

    def step(self, torque_command_Nm):
        del torque_command_Nm
        angle = self.counts / BENCH.encoder.counts_per_rev * 2.0 * np.pi
        return angle, self.counts * COUNT_m


@pytest.fixture
def still():
    """Motor 1 closed on a drive that stands at zero; proportional gain of 1 bit per count."""
    servo = new_servo(Placed())
    for tail, value in {
        8: 96, 9: 96, 30: 5461, 31: 0, 32: 0, 33: 0, 35: 0, 11: 0, 12: 0, 13: 0, 14: 0, 29: 0,
        68: 0, 69: 32767,
    }.items():  # fmt: skip
        servo.variables.write_i(100 + tail, value)
    servo.enable(1)
    servo.run(5)
    return servo


def output(servo):
    """Servo command of motor 1 in 16-bit output bits."""
    word = int(servo.memory.x[0xBF])
    return (word - 0x1000000 if word & 0x800000 else word) / 256.0


def test_notch_answers_a_step_as_worked_out_by_hand(still):
    # With N1 = -1, N2 = 0.5, D1 = -0.5, D2 = 0.25 a unit step gives 1, then 1 - 1 + 0.5 * 1, then
    # 1 - 1 + 0.5 + 0.5 * 0.5 - 0.25 * 1, then 0.5 + 0.5 * 0.5 - 0.25 * 0.5 and so on.
    by_hand = [1.0, 0.5, 0.5, 0.625, 0.6875, 0.6875]
    for tail, value in {36: -1.0, 37: 0.5, 38: -0.5, 39: 0.25}.items():
        still.variables.write_i(100 + tail, value)
    step_ct = 4000.0
    still.queue.place(1, step_ct * UNIT)
    gain = 5461 * 96 / 2**19  # Ixx30 Ixx08 / 2^19
    found = []
    for _ in by_hand:
        still.run(1)
        found.append(output(still) / (gain * step_ct))
    assert found == pytest.approx(by_hand, abs=1e-5)
    # Steady state: (1 + N1 + N2) / (1 + D1 + D2) = 0.5 / 0.75.
    still.run(200)
    assert output(still) / (gain * step_ct) == pytest.approx(0.5 / 0.75, abs=1e-5)


def test_notch_on_the_unit_circle_lets_its_frequency_not_pass(still):
    # Zeros at 130.6 Hz on the circle, poles on the same ray at 0.8: gain 0 there.
    ray = 2.0 * np.pi * 130.6 * still.cycle_ms / 1e3
    for tail, value in {
        36: -2.0 * np.cos(ray), 37: 1.0, 38: -1.6 * np.cos(ray), 39: 0.64,
    }.items():  # fmt: skip
        still.variables.write_i(100 + tail, value)
    amplitude, found = 3000.0, []
    for k in range(400):
        still.queue.place(1, round(amplitude * np.sin(ray * k) * UNIT))
        still.run(1)
        found.append(output(still))
    gain = 5461 * 96 / 2**19
    assert np.max(np.abs(found[300:])) < 1e-3 * gain * amplitude


def test_torque_table_is_added_where_the_motor_stands(still):
    # Entries are 1/256 bit at multiples of 250 counts; the last, zero, is also that of position 0.
    entries = [256 * 40, -256 * 10, 256 * 100, 0]
    assert still.tables.define(TableKind.TCOMP, 1, "4,1000") == 0
    for entry in entries:
        assert still.tables.store(entry) == 0
    still.variables.write_i(51, 1)
    knots = np.array([0, *entries]) / 256.0
    for counts in (0.0, 125.0, 250.0, 300.0, 500.0, 990.0, 1125.0, -125.0, -750.0, 7300.0):
        still.plant.counts = counts
        still.queue.place(1, counts * UNIT)
        still.run(4)
        wanted = np.interp(counts % 1000.0, [0, 250, 500, 750, 1000], knots)
        assert output(still) == pytest.approx(wanted, abs=0.01), counts
        shown = int(still.memory.y[0x80 + reg.M_COMMAND])
        shown -= 0x1000000 if shown & 0x800000 else 0
        assert shown == pytest.approx(wanted * 256, abs=1)
    # Signed, and independent of the sign of the command.
    still.variables.write_i(51, 0)
    still.run(2)
    assert output(still) == 0.0


def surface(x_ct, y_ct):
    """A bilinear surface in 1/16 count: between knots a table of it has no error at all."""
    return 3.0 * x_ct / 100.0 - 5.0 * y_ct / 200.0 + 2.0 * (x_ct / 100.0) * (y_ct / 200.0)


@pytest.fixture
def with_surface(still):
    """Table of motor 1: 3 rows along motor 3, 5 columns along motor 1, both by desired position."""
    still.variables.write_i(300, 1)
    still.variables.write_i(311, 0)
    still.enable(3)
    assert still.tables.define(TableKind.COMP, 1, "3.5,#1D,#3D,#1,500,600") == 0
    # Row 0 columns 1 to 5, then each row columns 0 to 5 (the corner at 0, 0 is zero).
    places = [(c, r) for r in range(4) for c in range(6)][1:]
    for column, row in places:
        assert still.tables.store(round(surface(100.0 * column, 200.0 * row))) == 0
    assert not still.tables.wants_values()
    still.variables.write_i(51, 1)
    return still


@pytest.mark.parametrize("x_ct", [0.0, 50.0, 100.0, 333.25, 499.0])
@pytest.mark.parametrize("y_ct", [0.0, 30.0, 200.0, 455.5, 599.0])
def test_two_dimensional_table_is_its_surface(with_surface, x_ct, y_ct):
    servo = with_surface
    for turns in (0, 1, -1):  # both sources roll over by themselves
        servo.queue.place(1, (x_ct + 500.0 * turns) * UNIT)
        servo.queue.place(3, (y_ct - 600.0 * turns) * UNIT)
        servo.run(1)
        register = servo._long(1, reg.M_COMPENSATION)
        # The register holds minus the correction in 1/(32 Ixx08) count.
        assert -register * 16.0 / UNIT == pytest.approx(surface(x_ct, y_ct), abs=0.006)
        net = servo._long(1, reg.M_PREVIOUS_NET) / UNIT
        assert net == pytest.approx(x_ct + 500.0 * turns + surface(x_ct, y_ct) / 16.0, abs=1e-3)


# Fact sheet 5.1-5.3: what must not exist when a table is defined and deleted.
LATER = {"COMP": ("TCOMP", "BLCOMP"), "TCOMP": ("BLCOMP",), "BLCOMP": ()}
BUFFERS = {"TBUF": 0x3151, "ROTARY": 0x3141, "LOOKAHEAD": 0x3121, "GATHER": 0x3120}
FORMS = {"COMP": "2,1000", "TCOMP": "2,1000", "BLCOMP": "2,1000"}


@pytest.mark.parametrize(("kind", "other"), list(itertools.product(FORMS, FORMS)))
@pytest.mark.parametrize("motor", [4, 5, 6])
def test_order_of_tables(kind, other, motor):
    tables = empty_tables()[1]
    assert tables.define(TableKind[other], 5, FORMS[other]) == 0
    tables.store(1), tables.store(2)
    blocked = other in LATER[kind] or (other == kind and motor >= 5)
    wanted = 3 if blocked else 0
    assert tables.define(TableKind[kind], motor, FORMS[kind]) == wanted
    # Deleting the one that was there: blocked by later kinds and by lower motors of its own.
    new = not blocked
    stuck = new and (kind in LATER[other] or (kind == other and motor < 5))
    assert tables.delete(TableKind[other], 5) == (3 if stuck else 0)


@pytest.mark.parametrize(("kind", "buffer"), list(itertools.product(FORMS, BUFFERS)))
def test_buffers_behind_block_tables(kind, buffer):
    memory, tables = empty_tables()
    assert tables.define(TableKind[kind], 5, FORMS[kind]) == 0
    memory.x[BUFFERS[buffer]] = 0xF000
    assert tables.define(TableKind[kind], 4, FORMS[kind]) == 3
    # Of the temporary buffers a LOOKAHEAD does not keep a table from being deleted.
    assert tables.delete(TableKind[kind], 5) == (0 if buffer == "LOOKAHEAD" else 3)


def empty_tables():
    memory = Memory()
    memory.x[reg.MEMORY_END] = reg.USER_BUFFER_END_STANDARD
    memory.y[reg.PROGRAM_END] = reg.USER_BUFFER_START
    return memory, CompensationTables(memory)
