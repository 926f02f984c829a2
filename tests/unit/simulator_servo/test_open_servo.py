"""The open servo: translation rules, and the shipped algorithm against the card's own PID."""

import numpy as np
import pytest

from pmac_comp.base.errors import ConfigError
from pmac_comp.files.resources import firmware_path
from pmac_comp.machine.controller.contents.law_bank import BANK_SIZE, SEAL, BankIndex
from pmac_comp.simulator.memory import registers as reg
from pmac_comp.simulator.servo import kernel_servo as ks
from pmac_comp.simulator.servo.open_servo import read_open_servo, translate_open_servo

SHIPPED = translate_open_servo(read_open_servo(firmware_path("feedforward_servo.txt")))


def source(*lines):
    return "\n".join(["OPEN SERVO CLEAR", *lines, "CLOSE"])


def with_servo(make_servo, program):
    servo = make_servo()
    servo.set_open_servo(program)
    servo.variables.write_i(159, 1)
    return servo


def run_once(make_servo, *lines, head=()):
    """P-variables after one pass of a user servo on motor 1."""
    text = "\n".join([*head, source(*lines)])
    servo = with_servo(make_servo, translate_open_servo(text))
    servo.enable(1)
    servo.run(1)
    return servo


def p(servo, number):
    return servo.variables.read("P", number)


@pytest.mark.parametrize(
    ("expression", "value"),
    [
        ("7/2", 3.5),
        ("P0+2*3", 6.0),
        ("MTRNUM+1", 2.0),
        ("ITOF(L1)*1.5", 12 * 1.5),
        ("ITOF(L1/8)", 2.0),  # 12/8 = 1.5 rounds up
        ("ITOF(-15/2)", -7.0),  # -7.5 rounds to -7
        ("ITOF(8388607+2)", -8388607.0),
        ("ITOF(L2[1])", 77.0),
        ("ITOF(L2[3])", 77.0),  # the index wraps at the length 2
    ],
)
def test_float_and_integer_arithmetic(make_servo, expression, value):
    head = ("L1->X:$10F0", "L2->X:$10F2[2]", "L3->X:$10F3")
    servo = run_once(make_servo, "L1=12", "L3=77", f"P10={expression}", head=head)
    assert p(servo, 10) == pytest.approx(value)


def test_pointers_reach_the_registers_of_the_motor(make_servo):
    head = ("L1->Y:(R1-$27)", "F1->D:(R1-$25)", "L2->X:(R1),19,1", "F2->L:$10F4")
    servo = run_once(make_servo, "P11=ITOF(L1)", "P12=F1", "P13=ITOF(L2)", "F2=2.5", "P14=F2",
                     head=head)  # fmt: skip
    assert p(servo, 11) == 96
    assert p(servo, 12) == servo._long(1, reg.M_ACTUAL)
    assert (p(servo, 13), p(servo, 14)) == (1.0, 2.5)


def test_conditions_loops_and_return(make_servo):
    servo = run_once(
        make_servo, "P1=0", "P2=0", "WHILE(P1<10)", "P1=P1+1", "IF(P1>3 AND P1!>5)", "P2=P2+P1",
        "ELSE", "P3=P1", "ENDIF", "ENDWHILE", "RETURN(P2*1000)", "P9=1",
    )  # fmt: skip
    assert (p(servo, 1), p(servo, 2), p(servo, 3), p(servo, 9)) == (10.0, 9.0, 10.0, 0.0)
    assert int(servo.memory.x[0x80 + reg.M_FILTER_RESULT]) == 9000


def test_hand_over_registers(make_servo):
    servo = run_once(make_servo, "COPYREG P20")
    servo.jog(1, 1)
    servo.run(60)
    assert p(servo, 24) == servo._long(1, reg.M_COMMANDED)
    assert p(servo, 23) == servo._long(1, reg.M_ACTUAL)
    assert p(servo, 22) == p(servo, 24) - p(servo, 23)
    assert p(servo, 21) > 0


@pytest.mark.parametrize(
    "lines",
    [
        ("P1=L1",), ("L1=P1",), ("P1=L1+P2",), ("IF(0=L1)", "ENDIF", "P1=+2"), ("P1=F9",),
        ("IF(P1=1)",), ("ENDIF",), ("ELSE",), ("CMD\"K\"",), ("X100",), ("P9999=1",),
        ("RETURN P1",),
    ],
)  # fmt: skip
def test_wrong_sources_are_refused_with_their_line(lines):
    with pytest.raises(ConfigError, match=r"line \d+"):
        translate_open_servo("L1->X:$10F0\n" + source(*lines))


@pytest.mark.parametrize("text", ["P1=1\n", "OPEN SERVO CLEAR\nP1=1\n", "L1->L:$10\n", ""])
def test_sources_without_frame_are_refused(text):
    with pytest.raises(ConfigError):
        translate_open_servo(text)


def test_a_file_that_is_no_text_is_refused_by_name(tmp_path):
    binary = tmp_path / "servo.bin"
    binary.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match=r"servo\.bin cannot be read"):
        read_open_servo(binary)


def test_runaway_algorithm_kills_its_motor(make_servo):
    servo = with_servo(
        make_servo, translate_open_servo(source("WHILE(1=1)", "P1=P1+1", "ENDWHILE"))
    )
    heard = []
    servo.on_event = heard.append
    servo.enable(1)
    servo.run(3)
    assert servo.is_killed(1)
    assert heard[0].kind == ks.EV_SERVO_FAULT


def run_jogs(servo):
    servo.enable(1)
    servo.run(300)
    positions = []
    for target in (8000.0, -3000.0, 500.0):
        servo.jog_to(1, "=", target)
        for _ in range(30):
            servo.run(25)
            positions.append(servo.position(1))
    return np.array(positions)


def test_shipped_algorithm_is_the_pid_when_its_law_is_off(make_servo):
    plain = run_jogs(make_servo())
    user = run_jogs(with_servo(make_servo, SHIPPED))
    assert np.max(np.abs(plain - user)) <= 1.0


@pytest.mark.parametrize(
    ("settings", "allowed_ct"),
    [
        ({36: -1.6, 37: 0.9, 38: -1.2, 39: 0.5}, 1.0),
        ({64: 8, 65: 16 * 3}, 1.0),
        ({67: 16 * 5}, 1.0),
        ({36: -1.6, 37: 0.9, 38: -1.2, 39: 0.5, 64: -8, 65: 16, 67: 16 * 20, 68: 200}, 1.0),
    ],
    ids=["notch", "dead band", "error limit", "all"],
)
def test_shipped_algorithm_carries_the_rest_of_the_pid(make_servo, settings, allowed_ct):
    moved = []
    for one in (make_servo(), with_servo(make_servo, SHIPPED), make_servo()):
        if len(moved) < 2:
            for tail, value in settings.items():
                one.variables.write_i(100 + tail, value)
        moved.append(run_jogs(one))
    # It does make a difference, and the same one in both.
    assert np.max(np.abs(moved[0] - moved[2])) > 1.0
    assert np.max(np.abs(moved[0] - moved[1])) <= allowed_ct


def load_bank(servo, values, *, bank=0, sealed=True):
    values = {BankIndex.RF: 0.01, **values}
    for offset in range(BANK_SIZE):
        servo.variables.write("P", 7010 + 30 * bank + offset, values.get(offset, 0.0))
    servo.variables.write("P", 7010 + 30 * bank + BankIndex.SEALED, SEAL if sealed else 0.0)
    head = {1: bank, 2: 1.0, 4: 60.0, 5: -1.0, 6: 0.002, 7: 1.0, 114: 442.0}
    for offset, value in head.items():
        servo.variables.write("P", 7000 + offset, value)


def test_shipped_law_offsets_the_command_by_its_terms(make_servo):
    servo = with_servo(make_servo, SHIPPED)
    load_bank(servo, {BankIndex.V0: 0.2, BankIndex.T_LIMIT: 3000.0})  # 0.2 counts per (count/SC)
    servo.enable(1)
    servo.run(2000)
    assert p(servo, 7000) == 20262
    assert p(servo, 7003) == 1.0
    plain = with_servo(make_servo, SHIPPED)
    plain.enable(1)
    plain.run(2000)
    difference = []
    for one in (servo, plain):
        one.jog(1, 1)
        one.run(1500)
        one.memory.touch()
        difference.append(one.position(1) - one.commanded(1))
    # What a capture takes for the desired position carries the correction.
    seen = servo._long(1, reg.M_FOLLOWING_ERROR) / 3072 + servo.position(1) - servo.commanded(1)
    assert seen == pytest.approx(p(servo, 7139), abs=0.01)
    # 44.2 counts per cycle times 0.2.
    assert p(servo, 7139) == pytest.approx(8.85, abs=0.05)
    assert difference[0] - difference[1] == pytest.approx(8.85, abs=2.0)


def test_unsealed_bank_is_not_used(make_servo):
    servo = with_servo(make_servo, SHIPPED)
    load_bank(servo, {BankIndex.V0: 0.2, BankIndex.T_LIMIT: 3000.0}, sealed=False)
    servo.enable(1)
    servo.jog(1, 1)
    servo.run(500)
    assert p(servo, 7139) == 0.0
    assert p(servo, 7143) == -1.0
    assert p(servo, 7002) == 0.0


def test_task_time_grows_with_the_algorithm(make_servo):
    plain = make_servo()
    plain.enable(1)
    plain.run(5)
    user = with_servo(make_servo, SHIPPED)
    user.enable(1)
    user.run(5)
    extra = int(user.memory.y[reg.TASK_TIME]) - int(plain.memory.y[reg.TASK_TIME])
    # Half CPU cycles at 80 MHz: the shipped algorithm takes tens of microseconds.
    assert 10.0 < extra * 2 / 80.0 < 200.0


def test_law_clamps_and_survives_kill_and_enable(make_servo):
    servo = with_servo(make_servo, SHIPPED)
    load_bank(servo, {BankIndex.V0: 50.0, BankIndex.T_LIMIT: 3000.0})
    servo.variables.write("P", 7004, 5.0)
    servo.enable(1)
    servo.run(1000)
    servo.jog(1, 1)
    servo.run(600)
    assert p(servo, 7139) == 5.0
    assert p(servo, 7141) > 0
    servo.kill(1)
    servo.run(500)
    servo.enable(1)
    servo.run(1)
    assert abs(p(servo, 7139)) < 0.1
    servo.run(1500)
    assert not servo.is_killed(1)
