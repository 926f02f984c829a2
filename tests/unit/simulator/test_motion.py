"""Motion programs: the commanded position of every servo cycle against closed forms."""

from itertools import pairwise

import numpy as np
import pytest

from pmac_comp.simulator.card.card import Card
from pmac_comp.simulator.memory.memory import read_long

from .conftest import Ask


def prepare(ask: Ask, *lines: str) -> None:
    """Motor 1 is axis X in counts, no limits that would slow a move."""
    ask("&1#1->X")
    ask("I116=1000 I117=1000 I113=0 I114=0 I111=0 I5190=1000")
    ask("OPEN PROG 1 CLEAR")
    for line in lines:
        assert ask(line) == "", line
    assert ask("CLOSE") == ""
    assert ask("#1J/") == ""


def record(card: Card, cycles: int) -> np.ndarray:
    """Commanded position of motor 1 in counts now and after each servo cycle."""
    m = card.memory
    out = np.empty(cycles + 1)
    out[0] = read_long(m.x, m.y, 0x88) / 3072.0
    for k in range(1, cycles + 1):
        card.run_cycles(1)
        out[k] = read_long(m.x, m.y, 0x88) / 3072.0
    return out


def run(card: Card, ask: Ask, cycles: int) -> np.ndarray:
    card.run_cycles(20)
    assert ask("&1B1R") == ""
    return record(card, cycles)


def test_single_linear_move_is_a_trapezoid(card: Card, ask: Ask) -> None:
    prepare(ask, "LINEAR INC TA100 TS0 F10000", "X5000")
    cycle_ms = card.servo.cycle_ms
    position = run(card, ask, 1500)
    velocity = np.diff(position) / cycle_ms
    moving = int(np.count_nonzero(np.abs(velocity) > 1e-6))
    assert position[-1] == pytest.approx(5000 + position[0], abs=0.01)
    assert velocity.max() == pytest.approx(10.0, rel=1e-3)
    assert moving * cycle_ms == pytest.approx(600, abs=2)  # D/F + TA
    quarter = round(50 / cycle_ms)
    assert velocity[quarter] == pytest.approx(5.0, rel=0.02)
    assert ask("&1??")[5] in "02468ACE"


def test_s_curve_halves_and_blending_keep_the_corner_time(card: Card, ask: Ask) -> None:
    prepare(ask, "LINEAR INC TA100 TS25 TM400", "X4000", "X2000", "X2000")
    position = run(card, ask, 3400)
    velocity = np.diff(position) / card.servo.cycle_ms
    assert position[-1] == pytest.approx(8000 + position[0], abs=0.01)
    # Blended: no stop between moves; the middle of each corner is one move time apart.
    moving = np.flatnonzero(np.abs(velocity) > 1e-6)
    assert (moving[-1] - moving[0]) * card.servo.cycle_ms == pytest.approx(1300, abs=2)
    assert np.all(np.abs(velocity[moving[0] : moving[-1]]) > 1e-9)
    acceleration = np.diff(velocity) / card.servo.cycle_ms
    jerk = np.abs(np.diff(acceleration))
    assert np.abs(acceleration).max() == pytest.approx(10 / 75, rel=0.05)
    assert jerk.max() < 0.02


def test_ixx16_and_ixx17_slow_a_move(card: Card, ask: Ask) -> None:
    prepare(ask, "LINEAR INC TA10 TS0 F1000000", "X20000")
    ask("I116=50 I117=0.2")
    position = run(card, ask, 2500)
    velocity = np.diff(position) / card.servo.cycle_ms
    acceleration = np.diff(velocity) / card.servo.cycle_ms
    assert velocity.max() <= 50.01
    assert np.abs(acceleration).max() <= 0.2 * 1.01
    assert position[-1] == pytest.approx(20000 + position[0], abs=0.01)


def test_pvt_is_the_cubic_through_its_end_values(card: Card, ask: Ask) -> None:
    prepare(ask, "PVT50 INC", "X100:5000", "X400:5000", "X100:0")
    position = run(card, ask, 500)
    t = np.arange(len(position)) * card.servo.cycle_ms
    expected = np.zeros_like(position)
    knots = [(0, 0, 0.0), (50, 100, 5.0), (100, 500, 5.0), (150, 600, 0.0)]
    for (t0, p0, v0), (t1, p1, v1) in pairwise(knots):
        inside = (t >= t0) & (t <= t1)
        u = (t[inside] - t0) / 50
        h = (2 * u**3 - 3 * u**2 + 1) * p0 + (u**3 - 2 * u**2 + u) * 50 * v0
        h += (3 * u**2 - 2 * u**3) * p1 + (u**3 - u**2) * 50 * v1
        expected[inside] = h
    expected[t > 150] = 600
    shift = position[0]
    assert np.abs(position - shift - expected).max() < 0.05


def test_spline1_is_the_uniform_cubic_b_spline(card: Card, ask: Ask) -> None:
    points = [100, 300, 350, 200]
    prepare(ask, "SPLINE1 TM40 ABS", *[f"X{p}" for p in points])
    ask("#1HMZ")
    card.run_cycles(20)
    position = run(card, ask, 700)
    velocity = np.diff(position)
    moving = np.flatnonzero(np.abs(velocity) > 1e-6)
    duration_ms = (moving[-1] - moving[0] + 1) * card.servo.cycle_ms
    # One extra segment before the first and after the last move.
    assert duration_ms == pytest.approx(40 * (len(points) + 2), abs=1.5)
    controls = [0, 0, 0, *points, points[-1], points[-1]]
    for k in range(1, len(points) + 2):
        at = k * 40 / card.servo.cycle_ms
        value = np.interp(at, np.arange(len(position)), position)
        c = controls[k : k + 3]
        assert value == pytest.approx((c[0] + 4 * c[1] + c[2]) / 6, abs=0.2)
    assert position[-1] == pytest.approx(points[-1], abs=0.01)


def test_dwell_does_not_follow_the_override_and_delay_does(card: Card, ask: Ask) -> None:
    prepare(ask, "LINEAR INC TA10 TS0 TM100", "X100", "DWELL200", "X100", "DELAY200", "X100")
    ask("%50")
    ask("I5194=8388607")
    position = run(card, ask, 3500)
    cycle_ms = card.servo.cycle_ms
    still = np.abs(np.diff(position)) < 1e-9
    moving = np.flatnonzero(~still)
    gaps = np.diff(moving)
    pauses = gaps[gaps > 100] * cycle_ms
    assert len(pauses) == 2
    assert pauses[0] == pytest.approx(200, abs=3)
    assert pauses[1] == pytest.approx((200 - 10) * 2, abs=6)


def test_rapid_ends_on_its_target_at_jog_speed(card: Card, ask: Ask) -> None:
    prepare(ask, "RAPID ABS X3000")
    ask("I190=0 I122=20")
    position = run(card, ask, 1200)
    velocity = np.diff(position) / card.servo.cycle_ms
    assert velocity.max() == pytest.approx(20, rel=0.01)
    assert position[-1] == pytest.approx(3000, abs=0.01)


def test_calls_loops_labels_and_inline_conditions(card: Card, ask: Ask) -> None:
    ask("OPEN PROG 100 CLEAR")
    for line in ("P20=P20+1 RETURN", "N500 P21=P21+1 RETURN"):
        ask(line)
    ask("CLOSE")
    prepare(
        ask,
        "P20=0 P21=0 P22=0 P23=0 P24=0",
        "WHILE(P22<5) P22=P22+1",
        "CALL100 CALL100.005",
        "GOSUB300",
        "IF(P22=5)P23=1",
        "ELSE P23=2",
        "IF(P22=4)P24=1",
        "ELSE P24=2",
        "GOTO400",
        "P25=99",
        "N300 P26=7 RETURN",
        "N400 DWELL10",
    )
    ask("P25=0 P26=0")
    run(card, ask, 200)
    assert ask("P20..26") == "1 1 5 1 2 0 7"
    assert ask("&1??")[5] == "0"


@pytest.mark.parametrize("line", ["CALL1", "GOSUB5 N5 GOSUB5"])
def test_calls_without_end_overflow_the_stack(card: Card, ask: Ask, line: str) -> None:
    prepare(ask, line)
    card.run_cycles(20)
    assert ask("&1B1R") == ""
    card.run_cycles(20)
    assert int(ask("&1??")[6:12], 16) >> 22 & 1  # run-time error
    assert ask("RY$2014") == "5"


def test_synchronous_assignment_acts_when_the_next_move_starts(card: Card, ask: Ask) -> None:
    ask("M500->Y:$10F0,0,8")
    prepare(ask, "LINEAR INC TA20 TS0 TM100", "M500=1", "X100", "M500==2", "X100", "P30=1", "X100")
    ask("M500=0 P30=0")
    card.run_cycles(20)
    ask("&1B1R")
    seen = []
    for _ in range(12):
        seen.append(ask("M500 P30"))
        card.run_cycles(60)
    assert seen[1] == "1 1"  # calculated ahead of the motion
    assert "2 1" in seen
    change = seen.index("2 1") * 60 * card.servo.cycle_ms
    assert 80 <= change <= 160


def test_feed_hold_and_resume(card: Card, ask: Ask) -> None:
    prepare(ask, "LINEAR INC TA20 TS0 TM500", "X5000")
    ask("I5195=200000")
    card.run_cycles(20)
    ask("&1B1R")
    card.run_cycles(500)
    assert ask("&1H") == ""
    card.run_cycles(200)
    held = float(ask("#1P"))
    card.run_cycles(500)
    assert float(ask("#1P")) == pytest.approx(held, abs=3)
    assert 100 < held < 4900
    assert ask("&1%") == "0"


def test_jog_in_feed_hold_must_come_back_before_resume(card: Card, ask: Ask) -> None:
    # SRM p. 325, 335: jogging is allowed in feed hold; J= goes back; away from it R is ERR017.
    prepare(ask, "LINEAR INC TA20 TS0 TM500", "X5000", "X1000")
    ask("I5195=200000")
    card.run_cycles(20)
    ask("&1B1R")
    card.run_cycles(500)
    ask("&1H")
    assert ask("#1J:100") == "ERR001"  # still slowing down
    card.run_cycles(300)
    held = read_long(card.memory.x, card.memory.y, 0x88)
    assert ask("#1J:300") == ""
    card.run_cycles(1500)
    assert read_long(card.memory.x, card.memory.y, 0x88) - held == 300 * 3072
    assert ask("&1R") == "ERR017"
    assert int(ask("&1??")[12:], 16) & 4  # program resume error
    assert ask("#1J=") == ""
    card.run_cycles(1500)
    assert read_long(card.memory.x, card.memory.y, 0x88) == held
    assert ask("&1R") == ""
    assert not int(ask("&1??")[12:], 16) & 4
    position = record(card, 3000)
    assert position[-1] == pytest.approx(6000, abs=1e-3)
    # The rest of the move goes on as it was, with the ramp of the time base.
    assert np.abs(np.diff(position, 2)).max() < 1.0


def test_resume_after_quit_needs_the_stopped_position(card: Card, ask: Ask) -> None:
    prepare(ask, "LINEAR INC TA20 TS0 TM100", "WHILE(P1<9)", "X100", "P1=P1+1", "ENDWHILE")
    card.run_cycles(20)
    ask("P1=0 &1B1R")
    card.run_cycles(400)
    ask("&1Q")
    card.run_cycles(2000)
    assert ask("#1J:500") == ""
    card.run_cycles(2000)
    assert ask("&1R") == "ERR017"
    assert ask("#1J=") == ""
    card.run_cycles(2000)
    assert ask("&1R") == ""
    card.run_cycles(4000)
    assert ask("P1") == "9"
    assert float(ask("#1P")) == pytest.approx(900, abs=2)


def test_first_move_waits_for_its_calculation_time(card: Card, ask: Ask) -> None:
    # I11 (SRM p. 43): after R and after a DWELL, not between blended moves.
    prepare(ask, "LINEAR INC TA20 TS0 TM100", "X100", "X100", "DWELL50", "X100")
    starts = {}
    for wait_ms in (0, 200):
        ask(f"I11={wait_ms} #1J=0")
        card.run_cycles(3000)
        position = run(card, ask, 2500)
        moving = np.flatnonzero(np.diff(position) > 1e-6)
        pause = np.flatnonzero(np.diff(moving) > 1)
        starts[wait_ms] = (moving[0], moving[pause + 1][0], pause.size)
    wait = 200 / card.servo.cycle_ms
    assert starts[200][0] - starts[0][0] == pytest.approx(wait, abs=1)
    assert starts[200][1] - starts[0][1] == pytest.approx(2 * wait, abs=2)
    assert starts[0][2] == starts[200][2] == 1


@pytest.mark.parametrize(
    ("range_ct", "moves", "ends"),
    [
        # The manual's example (p. 109): 36 000 counts a turn, 100 a degree.
        (36000, ["A270", "A0", "A190", "A350"], [-9000, 0, -17000, -1000]),
        (-36000, ["A-90", "A90", "A0.05", "A-0.0001"], [-9000, 9000, 36000, 36000]),
        (0, ["A270", "INC A-90"], [27000, 18000]),
        (36000, ["A170", "INC A270"], [17000, 44000]),
    ],
)
def test_rotary_axes_roll_over(
    card: Card, ask: Ask, range_ct: int, moves: list[str], ends: list[float]
) -> None:
    ask("&1#1->100A")
    ask(f"I127={range_ct} I116=1000 I117=1000 I113=0 I114=0 I111=0 I128=160")
    ask("OPEN PROG 1 CLEAR")
    for line in ("LINEAR ABS TA20 TS0 TM50", *(f"{move} DWELL10 P9=P9+1" for move in moves)):
        assert ask(line) == "", line
    ask("CLOSE #1J/ P9=0")
    position = run(card, ask, 300 * len(moves))
    rest = position[np.flatnonzero(np.diff(position) == 0.0)]
    stops = [rest[0], *rest[1:][np.abs(np.diff(rest)) > 20]]
    distinct = [e for before, e in pairwise([None, *ends]) if e != before]
    assert stops == pytest.approx(distinct, abs=6)


def test_program_start_errors(card: Card, ask: Ask) -> None:
    assert ask("&1R") == "ERR014"
    prepare(ask, "LINEAR INC TA20 TS0 TM500", "X5000")
    assert ask("&1R") == "ERR015"
    ask("&1B1")
    ask("#1K")
    assert ask("&1R") == "ERR012"
    ask("#1J/")
    ask("#1J+")
    card.run_cycles(50)
    assert ask("&1R") == "ERR011"
    ask("#1J/")
    card.run_cycles(2000)
    assert ask("&1R") == ""
    card.run_cycles(50)
    assert ask("#1J+") == "ERR001"
    assert ask("#1K") == "ERR001"
    assert ask("OPEN PROG 3") == "ERR001"
    assert ask("&1A") == ""
    card.run_cycles(3000)
    assert ask("#1J=0") == ""


def test_abort_decelerates_by_ixx15(card: Card, ask: Ask) -> None:
    prepare(ask, "LINEAR INC TA20 TS0 TM1000", "X20000")
    ask("I115=0.1")
    card.run_cycles(20)
    ask("&1B1R")
    card.run_cycles(1000)
    ask("&1A")
    position = record(card, 800)
    acceleration = np.diff(position, 2) / card.servo.cycle_ms**2
    assert acceleration[2:].min() == pytest.approx(-0.1, rel=0.02)
    assert np.abs(np.diff(position)[-10:]).max() < 1e-9


def test_homing_from_a_program(card: Card, ask: Ask) -> None:
    prepare(ask, "HOME1", "P40=1")
    ask("I123=-20 I7012=1 P40=0")
    card.run_cycles(20)
    ask("&1B1R")
    for _ in range(60):
        card.run_cycles(200)
        if ask("P40") == "1":
            break
    assert ask("P40") == "1"
    assert ask("M145") == "1"
    assert abs(float(ask("#1P"))) < 2


@pytest.mark.parametrize("search", ["HM", "HMZ"])
def test_homing_forgets_a_renamed_position(card: Card, ask: Ask, search: str) -> None:
    # Turbo PMAC User Manual, homing: reported positions are referenced to the new zero.
    prepare(ask, "PSET X500", "X300")
    run(card, ask, 2000)
    assert float(ask("#1P")) == pytest.approx(300, abs=1)
    ask(f"I123=5 I7012=1 #1{search}")
    card.run_cycles(6000)
    assert float(ask("#1P")) == pytest.approx(0, abs=1)
    prepare(ask, "LINEAR ABS TA20 TM200", "X100")
    run(card, ask, 2000)
    assert float(ask("#1P")) == pytest.approx(100, abs=1)


def test_rotary_buffer_runs_lines_as_they_come(card: Card, ask: Ask) -> None:
    ask("&1#1->X")
    ask("I116=1000 I117=1000 I113=0 I114=0 I111=0")
    ask("#1J/")
    card.run_cycles(20)
    assert ask("&1DEFINE ROT 200") == ""
    assert ask("&1B0") == ""
    assert ask("OPEN ROT") == ""
    for line in ("LINEAR INC TA20 TS0 TM100", "X100", "X100"):
        assert ask(line) == ""
    assert ask("PR") == "3"
    assert ask("&1R") == ""
    card.run_cycles(1000)
    assert float(ask("#1P")) == pytest.approx(200, abs=2)
    assert ask("PR") == "0"
    ask("X-50")
    card.run_cycles(1000)
    assert float(ask("#1P")) == pytest.approx(150, abs=2)
    assert int(ask("&1??")[:6], 16) & 1
    assert ask("CLOSE") == ""
    card.run_cycles(100)
    assert not int(ask("&1??")[:6], 16) & 1  # as though it had been closed before it ran empty
    assert ask("DELETE ROT") == ""


def test_full_rotary_buffer_is_told_by_its_bit(card: Card, ask: Ask) -> None:
    # SRM p. 45-46, 286: 1 from I17 lines on, 0 again below I16.
    def is_full() -> bool:
        return bool(int(ask("&1??")[6:12], 16) >> 16 & 1)

    prepare(ask, "X1")
    ask("I16=2 I17=4")
    ask("&1DEFINE ROT 200 B0")
    ask("OPEN ROT LINEAR INC TA20 TS0 TM200")
    for line, full in (("X100", False), ("X100", False), ("X100", True), ("X100", True)):
        assert ask(line) == ""
        assert is_full() == full
    assert ask("&1R") == ""  # the first line and two moves are calculated
    assert (ask("PR"), is_full()) == ("2", True)
    card.run_cycles(100)
    assert (ask("PR"), is_full()) == ("1", False)
    for _ in range(4):
        ask("X100")
    assert is_full()
    ask("CLEAR")
    assert not is_full()
    for _ in range(4):
        ask("X100")
    ask("CLOSE A")
    assert is_full()
    assert ask("DELETE ROT") == ""
    assert not is_full()


def test_rotary_buffers_go_from_the_highest_system_down(ask: Ask) -> None:
    # SRM p. 311, 316.
    assert ask("&2DEFINE ROT 10") == ""
    assert ask("&3DEFINE ROT 10") == "ERR003"
    assert ask("&1DEFINE ROT 10") == ""
    assert ask("&2DELETE ROT") == "ERR003"
    assert ask("&1DELETE ROT &2DELETE ROT") == ""


def test_conditions_of_a_rotary_program_stand_in_one_line(card: Card, ask: Ask) -> None:
    # SRM p. 441: only single-line IF and WHILE.
    prepare(ask, "X1")
    ask("P60..61=0")
    ask("&1DEFINE ROT 200 B0")
    ask("OPEN ROT")
    for line in ("IF(P60=0)", "WHILE(P60<3)", "ENDIF", "ENDWHILE"):
        assert ask(line) == "ERR009", line
    assert ask("PR") == "0"
    assert ask("IF(P60=0)P61=1") == ""
    assert ask("WHILE(P60<3)P60=P60+1") == ""
    assert ask("R") == ""
    card.run_cycles(100)
    assert ask("CLOSE P60 P61") == "3 1"


def test_position_rename_and_pmatch(card: Card, ask: Ask) -> None:
    ask("&1#1->100X")
    ask("#1J/")
    card.run_cycles(50)
    assert ask("&1X=5") == ""
    assert float(ask("#1P")) == pytest.approx(500, abs=2)
    ask("#1K")
    assert ask("Z") == ""
    assert float(ask("#1P")) == pytest.approx(0, abs=2)


def test_the_executing_move_is_named_by_its_own_line(card: Card, ask: Ask) -> None:
    """SRM p. 346, 387: PE and LIST PE tell the line with the move that is executed now."""
    prepare(ask, "LINEAR INC TA50 TS0 TM300", "X100 DWELL100", "N5 X200", "P77=1", "X300", "P78=1")
    run(card, ask, 30)
    lines = ["X100", "X200", "X300"]
    for line, cycles in zip(lines, (1100, 800, 700), strict=True):
        listed = ask("LIST PE")
        assert listed.split(":")[-1].replace(" ", "") == line
        assert ask("PE") == listed.rpartition(":")[0]
        card.run_cycles(cycles)
    card.run_cycles(2000)
    assert ask("PE") == ask("PC")
    assert ask("B1R") == ""
    assert ask("PE") == ask("PC"), "nothing of the run before"


@pytest.mark.parametrize(("stop", "go"), [("H", "R"), ("H", "S"), ("H", "B1R"), ("^O", "^R")])
def test_feed_hold_without_a_program_is_released(card: Card, ask: Ask, stop: str, go: str) -> None:
    # SRM p. 391: R restores operation after H even if no program was running.
    def give(command: str) -> None:
        if command.startswith("^"):
            card.interpreter.control_character(ord(command[1]) - 0x40)
        else:
            assert ask(command) == ""

    prepare(ask, "LINEAR INC TA20 TS0 TM100", "P60=P60+1", "X100")
    ask("I5195=200000 I5194=200000 P60=0")
    card.run_cycles(20)
    give(stop)
    assert ask("&1%") == "0"
    card.run_cycles(200)
    give(go)
    card.run_cycles(200)
    assert ask("&1%") == "100"
    assert ask("P60") == "0"  # nothing was started
    assert ask("&2%") == "100"
    assert ask("&1B1R") == ""
    card.run_cycles(2000)
    assert float(ask("#1P")) == pytest.approx(100, abs=2)


def test_feed_hold_stops_a_jog_and_lets_the_motor_be_jogged(card: Card, ask: Ask) -> None:
    prepare(ask, "X1")
    ask("I5195=200000 I5194=200000 I122=10")
    card.run_cycles(20)
    ask("#1J=5000")
    card.run_cycles(400)
    ask("&1H")
    card.run_cycles(200)
    held = read_long(card.memory.x, card.memory.y, 0x88)
    card.run_cycles(100)
    assert read_long(card.memory.x, card.memory.y, 0x88) == held
    assert ask("&1R") == ""
    card.run_cycles(2000)
    assert float(ask("#1P")) == pytest.approx(5000, abs=2)
    ask("#1J=0")
    card.run_cycles(400)
    ask("&1H")
    card.run_cycles(200)
    held = read_long(card.memory.x, card.memory.y, 0x88)
    assert ask("#1J:100") == ""
    position = record(card, 2000)
    assert position[-1] == pytest.approx(held / 3072 + 100, abs=0.01)
    assert np.abs(np.diff(position)).max() < 10 * card.servo.cycle_ms


@pytest.mark.parametrize("mode", ["LINEAR", "SPLINE1", "PVT500", "RAPID"])
@pytest.mark.parametrize("stop", ["Q", "S", "/"])
def test_quit_lets_one_move_follow_at_most(card: Card, ask: Ask, mode: str, stop: str) -> None:
    # SRM p. 388: at the end of the executing move, or of the one that is already calculated.
    moves = [f"X{k}000" + (":0" if mode == "PVT500" else "") for k in range(1, 9)]
    prepare(ask, f"{mode} ABS TA100 TS0 TM500", *(f"{x} P60=P60+1 M500=={x[1]}" for x in moves))
    ask("M500->Y:$10F0,0,8")
    ask("I190=1 I116=4 I122=4 P60=0 M500=0")
    run(card, ask, 500)
    assert 0 < float(ask("#1P")) < 1000
    assert ask(f"&1{stop}") == ""
    position = record(card, 4500)
    assert position[-1] == pytest.approx(2000, abs=0.01)
    assert ask("LIST PC").split(":", 2)[-1].startswith("X3000")
    assert np.abs(np.diff(position)).max() < 4.1 * card.servo.cycle_ms
    ask("#1J:300")
    card.run_cycles(2000)
    assert ask("&1R") == "ERR017"
    ask("#1J=")
    card.run_cycles(2000)
    assert ask("&1R") == ""
    position = record(card, 12000)
    assert position[-1] == pytest.approx(8000, abs=0.01)
    assert ask("P60 M500") == "8 7"


def test_quit_takes_a_dwell_back_that_is_no_more_to_come(card: Card, ask: Ask) -> None:
    prepare(ask, "LINEAR ABS TA100 TS0 TM500", "X1000", "X2000", "DWELL800", "P61=1", "X3000")
    ask("P61=0")
    run(card, ask, 500)
    ask("&1Q")
    position = record(card, 3000)
    assert position[-1] == pytest.approx(2000, abs=0.01)
    assert ask("P61 LIST PC").split(":")[-1] == "DWE800"
    assert not int(ask("&1??")[:6], 16) & 1
    assert ask("&1R") == ""
    card.run_cycles(1600)
    assert ask("P61") == "0"
    assert record(card, 3000)[-1] == pytest.approx(3000, abs=0.01)
    assert ask("P61") == "1"


def test_a_speed_of_zero_leads_nowhere(card: Card, ask: Ask) -> None:
    prepare(ask, "RAPID ABS X50000", "X1")
    card.run_cycles(20)
    ask("I122=0 #1J=50000")
    position = record(card, 3000)
    assert np.abs(position - position[0]).max() < 1
    ask("#1J/ I122=10 #1J+")
    card.run_cycles(500)
    ask("I122=0 #1J=50000")
    position = record(card, 2000)
    assert np.abs(np.diff(position)).max() < 10.1 * card.servo.cycle_ms
    assert position[-1] == position[-100]
    ask("#1J/")
    card.run_cycles(200)
    ask(f"#1J={position[-1]:.0f}")
    ask("#1J/ I190=1 I116=0 B1R")
    position = record(card, 3000)
    assert np.abs(position - position[0]).max() < 1
    assert ask("A") == ""
    card.run_cycles(100)
    assert not card.servo.is_moving(1)


def test_quit_in_feed_hold_waits_for_the_motor_that_was_jogged_away(card: Card, ask: Ask) -> None:
    prepare(ask, "LINEAR ABS TA100 TS0 TM500", "X1000", "X2000", "X3000", "X4000")
    ask("I5195=200000 I5194=200000 I122=10")
    run(card, ask, 500)
    ask("&1H")
    card.run_cycles(300)
    assert ask("#1J:300") == ""
    card.run_cycles(1500)
    assert ask("&1Q") == ""
    position = record(card, 300)
    assert position[-1] == position[0]
    assert ask("#1J=") == ""
    card.run_cycles(1500)
    assert ask("&1R") == ""
    position = record(card, 5000)
    assert np.abs(np.diff(position)).max() < 3
    assert position[-1] == pytest.approx(2000, abs=0.01)
    assert ask("&1R") == ""
    assert record(card, 5000)[-1] == pytest.approx(4000, abs=0.01)


@pytest.mark.parametrize("then", ["#1J/", "#1J=0", "#1J-"])
def test_a_jog_commanded_in_feed_hold_ends_without_a_step(card: Card, ask: Ask, then: str) -> None:
    """Its velocity fell to nothing within a cycle."""
    prepare(ask)
    ask("I120=100 I121=0 I122=32")
    card.run_cycles(20)
    assert ask("&1H") == ""
    card.run_cycles(3000)
    assert ask("#1J+") == ""
    moved = record(card, 600)
    speed = moved[-1] - moved[-2]
    assert speed > 5.0
    assert ask(then) == ""
    after = np.diff(record(card, 600))
    assert np.max(np.abs(np.diff(after, prepend=speed))) < 0.1 * speed
    assert after[-1] < 0.5 * speed
