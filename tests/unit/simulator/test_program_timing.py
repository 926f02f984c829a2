"""When a motion program is calculated, what its status says, and how it is started over."""

import pytest

from pmac_comp.simulator.card.card import Card

from .conftest import Ask

RUNNING = 1
MOVES = ("LINEAR INC TA50 TS0 TM200", "X1", "X1", "X1")


def enter(ask: Ask, *lines: str) -> None:
    for line in ("#1->10000X", "#1J/", *lines):
        assert ask(line) == ""


def run_ms(card: Card, ms: float) -> None:
    card.run_cycles(round(ms / card.servo.cycle_ms))


def is_running(ask: Ask) -> bool:
    return bool(int(ask("??")[:6], 16) & RUNNING)


def test_nothing_is_calculated_before_a_dwell_is_over(card: Card, ask: Ask) -> None:
    # SRM p. 429, third difference to DELAY: this idiom tells a host that the move is done.
    enter(ask, "OPEN PROG 6 CLEAR", "LINEAR INC TA50 TS0 TM100 X1 P60=1 DWELL200 P61=1 X1 CLOSE")
    ask("P60..61=0")
    ask("B6R")
    run_ms(card, 340.0)  # 150 ms of motion, 190 of 200 ms of the dwell
    assert (ask("P60"), ask("P61"), card.servo.is_moving(1)) == ("1", "0", True)
    run_ms(card, 15.0)
    assert ask("P61") == "1"
    run_ms(card, 300.0)
    assert round(card.servo.position(1)) in range(19990, 20010)


def test_dwell_keeps_its_time_and_dwell_0_takes_a_cycle(card: Card, ask: Ask) -> None:
    dwells = (100.0, 0.0)
    for time_ms in dwells:
        enter(ask, "OPEN PROG 6 CLEAR", f"DWELL{time_ms:g}", "P61=P61+1", "CLOSE", "P61=0")
        ask("B6R")
        cycles = max(round(time_ms / card.servo.cycle_ms), 1)
        card.run_cycles(cycles - 2)
        assert ask("P61") == "0" or cycles == 1
        card.run_cycles(4)
        assert ask("P61") == "1"
        run_ms(card, 10.0)


def test_times_beyond_the_longest_are_the_longest(card: Card, ask: Ask) -> None:
    enter(ask, "OPEN PROG 6 CLEAR", "LINEAR INC TA(EXP(500)) TS(EXP(500)) F1", "X1", "CLOSE")
    ask("B6R")
    run_ms(card, 100.0)
    assert card.servo.is_moving(1)


def test_a_loop_of_commands_takes_two_turns_at_a_time(card: Card, ask: Ask) -> None:
    # SRM p. 433: without a move in it a loop is suspended after two jumps back.
    enter(ask, "OPEN PROG 6 CLEAR", 'WHILE(1=1) P61=P61+1 CMD"P62=P62+1" ENDWHILE', "CLOSE")
    # In every real-time interrupt (p. 41), however the cycles are cut into calls.
    for period in (1, 3):
        ask(f"I8={period - 1} P61=0 P62=0")
        ask("B6R")
        for cycles in (1, 1, 40, 50, 7, 1, 200):
            card.run_cycles(cycles)
        assert int(ask("P61")) == pytest.approx(2 * 300 / period, abs=5)
        assert int(ask("P62")) == pytest.approx(2 * 300 / period, abs=25)
        ask("A")


def test_moves_in_a_called_program_keep_a_loop_blended(card: Card, ask: Ask) -> None:
    enter(ask, "OPEN PROG 8 CLEAR", "X1", "RETURN", "CLOSE")
    enter(ask, "OPEN PROG 6 CLEAR", *MOVES[:1], "WHILE(1=1) CALL8 ENDWHILE", "CLOSE")
    ask("B6R")
    run_ms(card, 700.0)
    speeds = []
    for _ in range(40):
        run_ms(card, 20.0)
        speeds.append(float(ask("V")))
    assert min(speeds) > 0.8 * max(speeds) > 0.0


def test_program_runs_until_its_end_is_calculated(card: Card, ask: Ask) -> None:
    # SRM p. 285: the bit goes before the last moves are executed.
    enter(ask, "OPEN PROG 6 CLEAR", *MOVES, "CLOSE")
    ask("B6R")
    assert is_running(ask)
    run_ms(card, 500.0)
    assert not is_running(ask)
    assert card.servo.is_moving(1)
    assert ask("R") == "ERR011"
    assert ask("#1J+") == "ERR001"
    run_ms(card, 500.0)
    assert ask("R") == ""
    assert is_running(ask)


def test_abort_and_run_waits_for_the_motors(card: Card, ask: Ask) -> None:
    # SRM p. 291-293.
    enter(ask, "OPEN PROG 6 CLEAR", "P60=P60+1", *MOVES, "CLOSE")
    enter(ask, "OPEN PROG 7 CLEAR", "P70=P70+1", "N5 P71=P71+1", "CLOSE", "P60=0 P70..71=0")
    ask("I115=1 B6R")
    run_ms(card, 250.0)
    assert ask("ABR") == ""
    run_ms(card, 5.0)
    assert ask("P60") == "1"  # still slowing down
    run_ms(card, 60.0)
    assert ask("P60") == "2"
    assert ask("ABR7.00005") == ""
    run_ms(card, 200.0)
    assert (ask("P70"), ask("P71")) == ("0", "1")
    assert ask("ABR99") == "ERR015"


def test_abort_and_run_is_forgotten_when_the_motor_is_killed(card: Card, ask: Ask) -> None:
    enter(ask, "OPEN PROG 6 CLEAR", "P60=P60+1", *MOVES, "CLOSE")
    ask("P60=0 I115=0.001 B6R")
    run_ms(card, 250.0)
    assert ask("ABR") == ""
    ask("#1K")
    run_ms(card, 500.0)
    assert ask("P60") == "1"


def test_status_tells_how_a_program_runs(card: Card, ask: Ask) -> None:
    # SRM p. 284-285: bit 4 R was given, 3 TM and not F, 2 blended, 1 S or Q, 0 running.
    enter(
        ask,
        "OPEN PROG 6 CLEAR",
        "LINEAR ABS TA50 TS0 TM200",
        "X1",
        "X2",
        "X3",
        "X4",
        "X5",
        "F5",
        "X7",
        "X9",
        "CLOSE",
    )
    ask("B6R")
    assert ask("??")[:6] == "A8003D"
    run_ms(card, 100.0)
    ask("Q")
    assert ask("??")[4:6] == "2F"
    run_ms(card, 2000.0)
    assert ask("??")[4:6] == "28"
    ask("S")
    assert ask("??")[4:6] == "2B"
    run_ms(card, 2000.0)
    ask("R")
    run_ms(card, 300.0)
    assert ask("??")[4:6] == "35"  # by feedrate now
    ask("A")
    run_ms(card, 3000.0)
    ask("I5192=1 B6R")
    assert ask("??")[4:6] == "2D"
    ask("A B6")
    assert ask("??")[4:6] == "20"
