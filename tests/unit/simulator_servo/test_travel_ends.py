"""What happens at the ends of the travel: switches, software limits, and the mechanical stop."""

import numpy as np
import pytest

from pmac_comp.simulator.card.card import Card
from pmac_comp.simulator.memory import registers as reg
from pmac_comp.simulator.plant import kernel_ballscrew as pk
from pmac_comp.simulator.plant import make_plant
from pmac_comp.simulator.servo import encoder
from pmac_comp.simulator.servo import kernel_servo as ks

from .conftest import BENCH

TRAVEL_m = BENCH.travel.max_mm / 1e3
STOP_m = TRAVEL_m + 0.010
COUNTS_PER_m = BENCH.encoder.counts_per_rev / (BENCH.screw.pitch_mm / 1e3)


def free_of_software_limits(servo):
    servo.variables.write_i(113, 0)
    servo.variables.write_i(114, 0)
    return servo


def test_stop_is_a_spring_that_only_pushes_back():
    plant = make_plant(BENCH)
    plant.reset(STOP_m)
    torque_Nm, lead = 3.0, plant.lead_m_per_rad
    for _ in range(8000):
        _, table_m = plant.step(torque_Nm)
    # At rest the push of the screw, less what friction may hold, is the force of the spring.
    force_N = plant.par[pk.P_STOP_K] * (plant.state[pk.S_TABLE] - STOP_m)
    holds_N = plant.truth.guide_coulomb_N * 1.5 + 0.75 / lead
    assert force_N == pytest.approx(torque_Nm / lead, abs=holds_N)
    assert abs(plant.state[pk.S_V_TABLE]) < 1e-6
    # Full torque backwards frees the table; the stop does not hold it.
    for _ in range(400):
        _, table_m = plant.step(-torque_Nm)
    assert table_m < STOP_m - 1e-3


def test_a_crash_takes_energy_and_leaves_the_table_between_the_stops():
    plant = make_plant(BENCH)
    plant.reset(STOP_m - 0.002)
    speed = 0.3
    plant.state[pk.S_V_TABLE] = speed
    plant.state[pk.S_W_SCREW] = plant.state[pk.S_W_MOTOR] = speed / plant.lead_m_per_rad
    trace = np.array([plant.step(0.0)[1] for _ in range(200)])
    # Table and rotating parts reflected to it stop within a few millimetres.
    inertia = BENCH.nominal.motor_inertia_kgm2 + BENCH.nominal.screw_inertia_kgm2
    mass = BENCH.nominal.table_mass_kg + inertia / plant.lead_m_per_rad**2
    deepest = speed * np.sqrt(mass / plant.par[pk.P_STOP_K])
    assert 0.3 * deepest < trace.max() - STOP_m < deepest
    rebound = np.diff(trace[-20:]).mean() / BENCH.servo_period_s
    assert -speed < rebound <= 0.0


def test_running_into_the_stop_trips_the_fatal_following_error(enabled):
    servo = free_of_software_limits(enabled)
    heard = []
    servo.on_event = heard.append
    servo.variables.write_i(124, 0x20001)  # end switches ignored
    servo.variables.write_i(122, 100.0)  # 100 mm/s
    servo.jog(1, 1)
    most = round((TRAVEL_m / 0.1 + 2.0) / BENCH.servo_period_s)
    while not servo.is_killed(1) and most > 0:
        most -= servo.run(20)
    assert [e.kind for e in heard if e.kind == ks.EV_FATAL] == [ks.EV_FATAL]
    assert servo.is_killed(1)
    status2 = int(servo.memory.y[reg.motor_base(1) + reg.M_STATUS2])
    assert status2 & reg.S2_FATAL_ERROR
    # The stop gives way by what the motor can push, 12 kN over 5 kN/mm.
    assert STOP_m < servo.position(1) / COUNTS_PER_m < STOP_m + 3e-3


def test_end_switch_stops_before_the_mechanical_stop(enabled):
    servo = free_of_software_limits(enabled)
    servo.variables.write_i(124, 1)
    servo.variables.write_i(115, 1.0)  # 1 count/ms2 is 1 m/s2
    servo.variables.write_i(122, 50.0)
    servo.jog(1, 1)
    servo.run(round((TRAVEL_m / 0.05 + 1.0) / BENCH.servo_period_s))
    assert not servo.is_killed(1)
    assert TRAVEL_m + 0.005 <= servo.position(1) / COUNTS_PER_m < STOP_m


def test_homing_on_the_end_switch(enabled):
    servo = free_of_software_limits(enabled)
    servo.variables.write_i(124, 0x20001)  # the switch is the home flag, not a limit
    servo.variables.write_i(7012, 2)  # capture on flag high
    servo.variables.write_i(7013, 2)  # MLIM
    servo.variables.write_i(123, -40.0)
    servo.variables.write_i(126, 16.0 * 1000.0)  # end 1000 counts from the trigger
    servo.home(1)
    servo.run(round((TRAVEL_m / 0.04 + 2.0) / BENCH.servo_period_s))
    status2 = int(servo.memory.y[reg.motor_base(1) + reg.M_STATUS2])
    assert status2 & reg.S2_HOME_COMPLETE
    assert servo.position(1) == pytest.approx(0.0, abs=2.0)
    # The zero lies 1000 counts inside of the switch, 5 mm beyond the travel.
    table_m = servo.plant.reading()[1]
    step_m = 40.0 * servo.cycle_ms / COUNTS_PER_m
    assert table_m == pytest.approx(-TRAVEL_m - 0.005 + 1000 / COUNTS_PER_m, abs=step_m + 5e-5)


@pytest.mark.parametrize("hold", [False, True], ids=["stop", "hold"])
def test_desired_position_limit(enabled, hold):
    # SRM p. 102-104: bit 15 watches the desired position, bit 14 holds it at the limit.
    servo = enabled
    servo.variables.write_i(113, 3000)
    servo.variables.write_i(124, 0x1 | 1 << 15 | (1 << 14 if hold else 0))
    heard = []
    servo.on_event = heard.append
    servo.jog_to(1, "=", 4000.0)
    servo.run(4000)
    status2 = int(servo.memory.y[reg.motor_base(1) + reg.M_STATUS2])
    assert status2 & reg.S2_DESIRED_LIMIT_STOP
    assert not servo.is_killed(1)
    if hold:
        assert servo.commanded(1) == 3000.0
        assert servo.position(1) == pytest.approx(3000.0, abs=2.0)
    else:
        assert ks.EV_DESIRED_LIMIT in [e.kind for e in heard]
        assert 3000.0 < servo.commanded(1) < 4000.0


def test_error_beyond_ixx67_goes_into_the_master_register(enabled):
    servo = enabled
    servo.variables.write_i(124, 1 << 13 | 0x20001)
    servo.variables.write_i(167, 16 * 50)  # 50 counts
    servo.variables.write_i(111, 0)
    servo.run(10)
    servo.queue.place(1, servo.queue.state(1)[0] + 200.0 * servo.unit(1))
    servo.run(1)
    assert servo.following_error(1) == pytest.approx(50.0, abs=1.0)
    assert servo._long(1, reg.M_MASTER) / servo.unit(1) == pytest.approx(-150.0, abs=2.0)
    servo.run(3000)
    # The axis ends short of the command by what was given up.
    assert servo._long(1, reg.M_ACTUAL) / servo.unit(1) == pytest.approx(50.0, abs=3.0)


def test_low_index_triggers_at_once_outside_the_mark(enabled):
    servo = enabled
    servo.variables.write_i(7012, 13)
    servo.jog_to(1, "=", 3000.0)
    servo.run(1500)
    servo.jog_to(1, ":", 9000.0, trigger_ct=200.0)
    servo.run(2500)
    # Half a turn off the mark the index is low: the trigger comes where the move starts.
    assert servo.position(1) == pytest.approx(3200.0, abs=3.0)


def test_trigger_captures_the_counter_of_its_channel(enabled):
    servo = enabled
    x = servo.memory.x
    x[0x78000] &= ~encoder.CAPTURED
    servo.run(5)
    assert not x[0x78000] & encoder.CAPTURED
    servo.jog_to(1, "=", 1.4 * BENCH.encoder.counts_per_rev)
    servo.run(4000)
    assert x[0x78000] & encoder.CAPTURED
    assert x[0x78003] == BENCH.encoder.counts_per_rev  # the index (I7012 = 1)


@pytest.mark.parametrize(("low_mm", "high_mm", "start_mm"), [(20, 380, 200), (-90, -10, -50)])
def test_an_axis_whose_travel_lacks_zero_starts_in_the_middle_and_says_so(
    low_mm: float, high_mm: float, start_mm: float
) -> None:
    travel = BENCH.travel.model_copy(update={"min_mm": low_mm, "max_mm": high_mm})
    card = Card(BENCH.model_copy(update={"travel": travel}))
    card.run_cycles(500)
    servo = card.servo
    assert servo.position(1) == pytest.approx(start_mm / 1e3 * COUNTS_PER_m, abs=2)
    scale_counts = start_mm * 1e3 / BENCH.scale.resolution_um
    assert servo.position(2) == pytest.approx(scale_counts, abs=20)
    assert abs(servo.plant.state[pk.S_V_TABLE]) < 1e-6


def test_an_axis_starts_at_zero_where_that_lies_in_its_travel() -> None:
    card = Card(BENCH)
    assert card.servo.cycles == 0
    assert card.servo.start_m == 0.0
