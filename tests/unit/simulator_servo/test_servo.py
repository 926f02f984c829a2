"""Motors of the simulated card: states, moves, corrections, protections."""

import numpy as np
import pytest

from pmac_comp.simulator.memory import registers as reg
from pmac_comp.simulator.memory.memory import write_float48, write_long
from pmac_comp.simulator.plant import make_plant
from pmac_comp.simulator.servo import kernel_servo as ks
from pmac_comp.simulator.servo.compensation import TableKind

UNIT = 3072


def status1(servo, motor=1):
    return int(servo.memory.x[reg.motor_base(motor) + reg.M_STATUS1])


def status2(servo, motor=1):
    return int(servo.memory.y[reg.motor_base(motor) + reg.M_STATUS2])


def words(servo, motor=1):
    return f"{status1(servo, motor):06X}{status2(servo, motor):06X}"


def encoder_ct(servo):
    word = int(servo.memory.x[reg.channel_base(1) + 1])
    return word - 0x1000000 if word >= 0x800000 else word


def define(servo, kind, motor, text, values):
    assert servo.tables.define(kind, motor, text) == 0
    for value in values:
        assert servo.tables.store(value) == 0


def factory_killed_word(servo):
    servo.variables.write_i(134, 1)
    servo.variables.write_i(124, 1)
    servo.run(1)
    return words(servo)


def test_killed_motor_shows_the_word_of_a_real_unit(servo):
    # Activated, open loop, integration mode: the answer of a real unit to ?.
    assert factory_killed_word(servo) == "850000000000"


def test_enable_holds_without_a_jump(servo):
    servo.plant.reset(0.01)
    servo.run(50)
    before = servo.plant.state[2]
    servo.enable(1)
    servo.run(300)
    # Holding, in position: 892000000001 less the integration-mode bit (I134 = 0 here).
    assert words(servo) == "882000000001"
    assert abs(servo.plant.state[2] - before) * servo.plant.lead_m_per_rad < 0.5e-6
    assert servo.following_error(1) == 0.0


def test_jog_moves_motor_and_scale_and_reports(enabled):
    enabled.jog_to(1, "=", 30000.0)
    enabled.run(500)
    assert status1(enabled) & reg.S1_MOVE_TIMER
    assert not status1(enabled) & reg.S1_DESIRED_VELOCITY_ZERO
    assert not enabled.in_position(1)
    # 100 counts/ms = 44.2 counts per servo interrupt.
    assert enabled.velocity(1) == pytest.approx(44.2, abs=0.5)
    # Friction holds the motor short of the end until the integrator has wound up against it.
    enabled.run(12000)
    assert enabled.commanded(1) == 30000.0
    assert enabled.position(1) == pytest.approx(30000.0, abs=1.0)
    # The scale has 8 counts per encoder count; lead error and deformation stay below 30 um.
    assert enabled.position(2) == pytest.approx(240000.0, abs=8 * 30)
    assert enabled.in_position(1)
    assert not status1(enabled) & reg.S1_MOVE_TIMER


def test_jog_forms(enabled):
    enabled.jog_to(1, "==", 500.0)
    enabled.run(800)
    enabled.jog_to(1, ":", 250.0)
    enabled.run(800)
    assert enabled.commanded(1) == 750.0
    enabled.jog_to(1, "^", -100.25)
    enabled.run(800)
    assert enabled.commanded(1) == pytest.approx(750.0 - 100.25, abs=1.01)
    enabled.jog_to(1, "=", None)
    enabled.run(800)
    assert enabled.commanded(1) == 500.0
    enabled.jog(1, -1)
    enabled.run(500)
    assert enabled.commanded(1) < -5000.0
    assert not status1(enabled) & reg.S1_MOVE_TIMER  # J- has no defined end
    enabled.jog_stop(1)
    enabled.run(800)
    here = enabled.commanded(1)
    enabled.jog_round(1)
    enabled.run(1)
    assert enabled.commanded(1) == round(here)


def test_kill_opens_the_loop_at_once(enabled):
    enabled.jog(1, 1)
    enabled.run(300)
    enabled.kill(1)
    enabled.run(1)
    assert enabled.is_killed(1)
    assert enabled.is_open_loop(1)
    assert int(enabled.memory.x[reg.motor_base(1) + reg.M_COMMAND]) == 0
    enabled.run(2000)
    assert enabled.following_error(1) == 0.0
    assert enabled.commanded(1) == enabled.position(1)


def test_fatal_following_error_kills_and_tells(enabled):
    heard = []
    enabled.on_event = heard.append
    enabled.variables.write_i(169, 10)  # no torque to speak of
    enabled.jog(1, 1)
    enabled.run(3000)
    assert enabled.is_killed(1)
    assert status2(enabled) & reg.S2_FATAL_ERROR
    assert [(e.kind, e.motor) for e in heard] == [(ks.EV_FATAL, 1)]
    enabled.variables.write_i(169, 32767)
    enabled.enable(1)
    enabled.run(10)
    assert not status2(enabled) & reg.S2_FATAL_ERROR


@pytest.mark.parametrize(("bits", "other_killed"), [(0, True), (1 << 22, False)])
def test_fault_takes_the_motors_that_ixx24_names(enabled, bits, other_killed):
    enabled.variables.write_i(111, 16 * 50)
    enabled.variables.write_i(211, 0)
    enabled.variables.write_i(124, 0x20001 | bits)
    enabled.enable(2)
    enabled.run(10)
    enabled.variables.write_i(169, 10)
    enabled.jog(1, 1)
    enabled.run(2000)
    assert enabled.is_killed(1)
    assert enabled.is_killed(2) is other_killed


def test_warning_error_sets_and_clears(enabled):
    enabled.variables.write_i(112, 16)
    enabled.jog(1, 1)
    enabled.run(60)
    assert status2(enabled) & reg.S2_WARNING_ERROR
    enabled.jog_stop(1)
    enabled.run(2000)
    assert not status2(enabled) & reg.S2_WARNING_ERROR


def test_software_limit_stops_and_only_lets_back(enabled):
    heard = []
    enabled.on_event = heard.append
    enabled.variables.write_i(113, 3000)
    enabled.jog(1, 1)
    enabled.run(3000)
    assert [(e.kind, e.value) for e in heard] == [(ks.EV_LIMIT, 1)]
    assert status1(enabled) & reg.S1_POSITIVE_LIMIT
    assert status2(enabled) & reg.S2_LIMIT_STOP
    stopped = enabled.commanded(1)
    assert 3000.0 < stopped < 4500.0
    assert not enabled.is_killed(1)
    enabled.jog(1, 1)
    enabled.run(500)
    assert enabled.commanded(1) == stopped
    assert enabled.open_loop(1, 5.0) == 3
    enabled.jog_to(1, "=", 0.0)
    enabled.run(2000)
    assert enabled.commanded(1) == 0.0
    assert not status1(enabled) & reg.S1_POSITIVE_LIMIT
    assert not status2(enabled) & reg.S2_LIMIT_STOP


def test_hardware_limit_stops_unless_ignored(make_servo):
    servo = make_servo()
    servo.variables.write_i(124, 1)
    servo.variables.write_i(113, 0)
    servo.plant.reset(0.303)
    servo.run(10)
    servo.enable(1)
    heard = []
    servo.on_event = heard.append
    servo.jog(1, 1)
    servo.run(3000)
    assert [e.kind for e in heard] == [ks.EV_HARD_LIMIT]
    assert servo.plant.state[8] < 0.310


def test_abort_decelerates_with_ixx15_and_closes_open_loops(enabled):
    enabled.jog(1, 1)
    enabled.run(400)
    enabled.abort(1)
    enabled.run(20)
    assert status1(enabled) & reg.S1_ABORT_DECELERATION
    enabled.run(60)
    assert enabled.queue.pending(1) == 0
    enabled.open_loop(1, 0.0)
    enabled.run(10)
    enabled.abort(1)
    assert not enabled.is_open_loop(1)
    enabled.kill(1)
    enabled.memory.x[reg.INTERNAL_GLOBAL + 36] = 1
    enabled.abort(1)
    assert enabled.is_killed(1)
    enabled.memory.x[reg.INTERNAL_GLOBAL + 36] = 0
    enabled.abort(1)
    assert not enabled.is_killed(1)


def test_open_loop_output_is_a_share_of_ixx69(servo):
    servo.open_loop(1, 10.0)
    servo.run(3)
    word = int(servo.memory.x[reg.motor_base(1) + reg.M_COMMAND])
    assert word / 256 == pytest.approx(3276.7, abs=1.0)
    assert status1(servo) & reg.S1_AMPLIFIER_ENABLED
    servo.run(200)
    assert servo.position(1) > 10.0


def test_open_loop_beyond_a_limit_is_closed_and_stopped(servo):
    servo.variables.write_i(113, 2000)
    servo.open_loop(1, 8.0)
    servo.run(6000)
    assert not servo.is_open_loop(1)
    assert not servo.is_killed(1)
    assert 2000.0 < servo.position(1) < 6000.0


@pytest.mark.parametrize(("ixx24", "tripped"), [(0x20001, True), (0x120001, False)])
def test_amplifier_fault_trips_unless_ignored(enabled, ixx24, tripped):
    enabled.variables.write_i(124, ixx24)
    enabled.amplifier_fault(1)
    enabled.run(5)
    assert enabled.is_killed(1) is tripped
    assert bool(status2(enabled) & reg.S2_AMPLIFIER_FAULT) is tripped
    enabled.enable(1)
    enabled.run(5)
    assert not status2(enabled) & reg.S2_AMPLIFIER_FAULT


def test_homing_ends_at_the_trigger_plus_offset(enabled):
    # Index of the encoder: every 10 000 counts; I7012 = 1 by default.
    write_float48(enabled.memory.x, enabled.memory.y, 0x80 + reg.M_IXX23, 20.0)
    enabled.jog_to(1, "=", 3000.0)
    enabled.run(1500)
    enabled.variables.write_i(126, 16 * 200)
    enabled.home(1)
    enabled.run(5)
    assert status1(enabled) & reg.S1_HOME_SEARCH
    assert not status2(enabled) & reg.S2_HOME_COMPLETE
    enabled.run(4000)
    assert status2(enabled) & reg.S2_HOME_COMPLETE
    assert not status1(enabled) & reg.S1_HOME_SEARCH
    assert enabled.commanded(1) == 0.0
    assert enabled.position(1) == pytest.approx(0.0, abs=1.0)
    assert encoder_ct(enabled) == pytest.approx(10000 + 200, abs=1.0)


def test_homing_on_the_flag_and_jog_until_trigger(enabled):
    # The home switch closes 10 mm before the negative end of the travel.
    enabled.variables.write_i(7012, 2)
    write_float48(enabled.memory.x, enabled.memory.y, 0x80 + reg.M_IXX23, -100.0)
    enabled.home(1)
    enabled.run(9000)
    assert status2(enabled) & reg.S2_HOME_COMPLETE
    assert encoder_ct(enabled) == pytest.approx(-290_000, abs=60)
    enabled.variables.write_i(7012, 1)
    enabled.jog_to(1, "=", 40000.0, trigger_ct=-500.0)
    enabled.run(10)
    assert status2(enabled) & reg.S2_TRIGGER_MOVE
    enabled.run(3000)
    assert not status2(enabled) & reg.S2_TRIGGER_MOVE
    assert encoder_ct(enabled) % 10000 == pytest.approx(9500, abs=1)


def test_zero_move_home_and_absolute_read(enabled):
    enabled.jog_to(1, "=", 1234.0)
    enabled.run(1000)
    enabled.home_zero(1)
    enabled.run(300)
    assert enabled.commanded(1) == 0.0
    assert enabled.position(1) == pytest.approx(0.0, abs=1.0)
    assert status2(enabled) & reg.S2_HOMEZ
    assert not enabled.is_killed(1)
    enabled.reset_position(1)
    enabled.run(5)
    assert enabled.is_killed(1)
    assert enabled.position(1) == pytest.approx(0.0, abs=1.0)  # the screw springs back


def test_following_in_offset_mode_is_hidden_from_p(enabled):
    servo = enabled
    servo.variables.write_i(105, 0x10F8)
    servo.variables.write_i(107, 96)
    servo.variables.write_i(106, 3)
    servo.run(5)
    start = encoder_ct(servo)
    for step in range(1, 41):
        servo.memory.x[0x10F8] = 32 * step  # 1/32 count
        servo.run(5)
    servo.run(800)
    assert encoder_ct(servo) - start == pytest.approx(40, abs=1)
    assert servo.position(1) == pytest.approx(0.0, abs=1.0)
    assert servo._long(1, reg.M_MASTER) == 40 * UNIT
    servo.variables.write_i(106, 1)
    servo.run(2)
    assert servo.position(1) == pytest.approx(40.0, abs=1.0)
    servo.memory.x[0x10F8] = (-100) & 0xFFFFFF
    servo.run(1500)
    assert servo._long(1, reg.M_MASTER) == -100 * 96


def test_position_table_moves_the_motor_by_its_entry(enabled):
    # 48 = 3 counts at 1000 counts; the register holds minus the correction (fact sheet 5.5).
    define(enabled, TableKind.COMP, 1, "10,#1D,#1,10000", [48] + [0] * 9)
    enabled.jog_to(1, "=", 1000.0)
    enabled.run(1500)
    before = encoder_ct(enabled)
    enabled.variables.write_i(51, 1)
    enabled.run(5000)  # the axis sticks and slips its way to the new place
    assert encoder_ct(enabled) - before == pytest.approx(3, abs=1)
    assert enabled._long(1, reg.M_COMPENSATION) == -3 * UNIT
    assert enabled.position(1) == pytest.approx(1000.0, abs=1.0)
    enabled.variables.write_i(51, 0)
    enabled.run(10)
    # Off: the register keeps its value and the user may write it.
    assert enabled._long(1, reg.M_COMPENSATION) == -3 * UNIT
    write_long(enabled.memory.x, enabled.memory.y, 0x80 + reg.M_COMPENSATION, 0)
    enabled.run(5000)
    assert encoder_ct(enabled) == pytest.approx(before, abs=1)


def test_tables_of_several_motors_add_up_on_their_target(enabled):
    define(enabled, TableKind.COMP, 2, "2,#2,#1,100000000", [160, 160])
    define(enabled, TableKind.COMP, 1, "2,#1D,#1,20000", [32, 0])
    enabled.variables.write_i(51, 1)
    enabled.jog_to(1, "=", 10000.0)
    enabled.run(2000)
    scale = enabled.position(2)
    expected = 2.0 + 10.0 * scale / 50_000_000
    assert -enabled._long(1, reg.M_COMPENSATION) / UNIT == pytest.approx(expected, abs=0.01)


def test_torque_table_adds_to_the_output(enabled):
    enabled.run(2000)
    define(enabled, TableKind.TCOMP, 1, "2,1000", [256 * 40, 256 * 40])
    enabled.memory.x[reg.INTERNAL_GLOBAL + 30] = 0
    before = int(enabled.memory.x[0xBF])
    enabled.jog_to(1, "=", 500.0)
    enabled.run(1000)
    enabled.variables.write_i(51, 1)
    enabled.run(1)
    assert int(enabled.memory.y[reg.motor_base(1) + reg.M_COMMAND]) == pytest.approx(
        256 * 40, abs=600
    )
    assert before != int(enabled.memory.x[0xBF])


def test_backlash_is_taken_up_after_a_reversal(enabled):
    enabled.variables.write_i(185, 16)  # 1 count per background cycle
    enabled.variables.write_i(186, 16 * 20)
    enabled.variables.write_i(187, 16 * 4)
    enabled.jog_to(1, "=", 2000.0)
    enabled.run(1000)
    forward = encoder_ct(enabled)
    assert not status2(enabled) & reg.S2_BACKLASH_DIRECTION
    enabled.jog_to(1, "=", 1000.0)
    enabled.run(1500)
    assert status2(enabled) & reg.S2_BACKLASH_DIRECTION
    assert encoder_ct(enabled) == pytest.approx(forward - 1000 - 20, abs=1)
    assert int(enabled.memory.y[0x80 + reg.M_IXX86]) == 16 * 20
    # SRM p. 148: the reported position does not show it, nor does opening and closing the loop.
    assert enabled.position(1) == pytest.approx(1000, abs=1)
    enabled.kill(1)
    enabled.run(20)
    assert enabled.position(1) == pytest.approx(1000, abs=1)
    enabled.enable(1)
    enabled.run(500)
    assert enabled.position(1) == pytest.approx(1000, abs=1)
    assert encoder_ct(enabled) == pytest.approx(forward - 1000 - 20, abs=1)
    enabled.jog_to(1, "^", 0.0)
    enabled.run(500)
    assert enabled.position(1) == pytest.approx(1000, abs=1)
    enabled.jog_to(1, "=", 2000.0)
    enabled.run(1500)
    assert encoder_ct(enabled) == pytest.approx(forward, abs=1)
    enabled.jog_to(1, "=", 1000.0)
    enabled.run(1500)
    enabled.kill(1)
    enabled.reset_position(1)
    enabled.run(5)
    assert enabled.position(1) == pytest.approx(0, abs=1)
    assert enabled.position(1) == enabled.commanded(1)


def test_offset_and_friction_feedforward_reach_the_output(enabled):
    enabled.run(500)
    before = int(enabled.memory.x[0x80 + reg.M_COMMAND])
    enabled.variables.write_i(129, -300)
    enabled.run(1)
    change = int(enabled.memory.x[0x80 + reg.M_COMMAND]) - before
    change = (change + 0x800000) % 0x1000000 - 0x800000
    assert change == pytest.approx(-300 * 256, abs=300)
    enabled.variables.write_i(129, 0)
    enabled.variables.write_i(130, 1)
    enabled.variables.write_i(168, 500)
    enabled.jog_to(1, "=", -3000.0)
    enabled.run(100)
    word = int(enabled.memory.x[0x80 + reg.M_FILTER_RESULT])
    assert (word - 0x1000000) / 256 == pytest.approx(-500, abs=2)


def test_integrator_modes(enabled):
    enabled.variables.write_i(134, 1)
    enabled.jog(1, 1)
    enabled.run(100)
    held = enabled.motor_memory[1, 0]
    enabled.run(100)
    assert enabled.motor_memory[1, 0] == held  # desired velocity is not zero
    enabled.variables.write_i(134, 0)
    enabled.run(50)
    assert enabled.motor_memory[1, 0] != held
    enabled.variables.write_i(163, 0)
    enabled.run(2)
    assert enabled.motor_memory[1, 0] == 0.0


def test_current_protection_trips(enabled):
    enabled.variables.write_i(157, 200)
    enabled.variables.write_i(158, 5)
    enabled.variables.write_i(124, 0x420001)
    heard = []
    enabled.on_event = heard.append
    enabled.set_external_force(3000.0)
    enabled.run(20000)
    assert enabled.is_killed(1)
    assert status2(enabled) & reg.S2_I2T
    assert heard[0].kind == ks.EV_OVERCURRENT


def test_time_base_stretches_jogs(enabled):
    enabled.jog(1, 1)
    enabled.run(600)
    start = enabled.commanded(1)
    enabled.run(100)
    full = enabled.commanded(1) - start
    i10 = int(enabled.memory.x[reg.I10_REGISTER])
    enabled.memory.x[0x2000] = i10 // 2
    enabled.run(3000)
    start = enabled.commanded(1)
    enabled.run(100)
    assert (enabled.commanded(1) - start) / full == pytest.approx(0.5, rel=1e-3)
    enabled.memory.y[0x2001] = 1  # feed hold
    enabled.run(3000)
    start = enabled.commanded(1)
    enabled.run(50)
    assert enabled.commanded(1) == start


def test_user_timers_and_counter(servo):
    servo.variables.write_i(5111, 100)
    servo.memory.x[0] = 0xFFFFF0
    servo.memory.y[0] = 0xFFFFF1
    servo.run(40)
    assert servo.variables.read_i(5111) == 60
    assert int(servo.memory.x[0]) == 24
    servo.run(200)
    assert servo.variables.read_i(5111) == -140


def test_servo_extension_closes_every_other_cycle(enabled):
    enabled.variables.write_i(160, 1)
    enabled.jog(1, 1)
    words_seen = []
    for _ in range(60):
        enabled.run(1)
        words_seen.append(int(enabled.memory.x[0x80 + reg.M_FILTER_RESULT]))
    changes = np.flatnonzero(np.diff(words_seen))
    assert set(np.diff(changes[5:]).tolist()) == {2}


def test_memory_does_not_depend_on_how_time_was_cut(make_servo):
    images = []
    for chunk in (1, 13, 500):
        servo = make_servo()
        servo.enable(1)
        servo.variables.write_i(113, 2500)
        servo.jog(1, 1)
        done = 0
        while done < 1000:
            done += servo.run(min(chunk, 1000 - done))
        images.append((servo.memory.x.tobytes(), servo.memory.y.tobytes()))
    assert images[0] == images[1] == images[2]


class Slow:
    """The bench's own drive behind the plain door."""

    def __init__(self, bench):
        self._plant = make_plant(bench)

    def reset(self, table_position_m=0.0):
        self._plant.reset(table_position_m)

    def step(self, torque_command_Nm):
        return self._plant.step(torque_command_Nm)

    def set_external_force(self, force_N):
        self._plant.set_external_force(force_N)


def test_plain_and_compiled_doors_give_the_same_card(make_servo):
    from tests.unit.simulator_servo.conftest import BENCH

    images = []
    for plant in (None, Slow(BENCH)):
        servo = make_servo(plant)
        servo.enable(1)
        servo.set_external_force(100.0)
        servo.jog_to(1, "=", 3000.0)
        servo.run(700)
        images.append((servo.memory.x.tobytes(), servo.memory.y.tobytes()))
    assert images[0] == images[1]


def test_force_schedule_pushes_the_axis(enabled):
    enabled.run(2000)
    before = int(enabled.memory.x[0xBF])
    period = enabled.bench.servo_period_s
    enabled.set_force_schedule(np.array([0.0, 100 * period]), np.array([0.0, 800.0]))
    enabled.run(4000)
    more = (int(enabled.memory.x[0xBF]) - before + 0x800000) % 0x1000000 - 0x800000
    torque_Nm = more / 256 * enabled.bench.drive.torque_per_dac_Nm
    # 800 N on a 10 mm screw is 1.27 N m; friction carries up to 0.52 N m of it.
    assert 0.7 < torque_Nm < 1.8
