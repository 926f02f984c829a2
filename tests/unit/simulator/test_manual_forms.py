"""Forms of the manual and of real program files: abbreviations, labels, modes, addressing.

Source: Turbo PMAC Software Reference Manual p. 284-300, 318-343, 409-416, 435-437.
"""

import pytest

from pmac_comp.simulator.card.card import Card

from .conftest import Ask

RUN_TIME_ERROR = 1 << 22

COMPUTED_JUMPS = """
&1#1->100X
OPEN PROG 5 CLEAR
LINEAR ABS TA50 TS0 F10
P1=0
GOSUB(P2)
P1=P1+1
GOTO(50+P3)
P1=999
N51 P4=51 GOTO60
N52 P4=52
O60 P5=60
GOSUB777
P6=1
IF(P7>0) GOTO888
DWELL10
RETURN
N10 P1=10
RETURN
N20 P1=20 RETURN
CLOSE
#1J/
""".strip().splitlines()


def enter(ask: Ask, lines: list[str]) -> None:
    for line in lines:
        assert ask(line) == "", line


@pytest.mark.parametrize(
    ("short", "long"),
    [
        ("EAVER", "EAVERSION"),
        ("IDNUM", "IDNUMBER"),
        ("DAT", "DATE"),
        ("CHKS", "CHECKSUM"),
        ("LIS PLC 3", "LIST PLC 3"),
        ("LIS PROG 4,0", "LIST PROGRAM 4,0"),
        ("LIS GAT", "LIST GATHER"),
        ("CLS", "CLOSE"),
        ("CLS ALL", "CLOSE ALL"),
        ("FSAV", "FSAVE"),
        ("DIS PLCC 0..31", "DISABLE PLCC 0..31"),
    ],
)
def test_abbreviations_mean_the_long_word(ask: Ask, short: str, long: str) -> None:
    enter(ask, ["OPEN PLC 3 CLR", "P1=1", "CLS", "OPEN PROG 4 CLEAR", "DWELL5", "CLOSE"])
    assert ask(short) == ask(long)


def test_an_abbreviated_clear_empties_what_is_open(ask: Ask) -> None:
    enter(ask, ["OPEN PLC 3 CLEAR", "P1=1", "CLR", "P2=2", "CLS"])
    assert ask("LIST PLC 3") == "P2=2 RET"
    enter(ask, ["CLR ALL PLCS"])
    assert ask("LIST PLC 3") == "ERR003"


@pytest.mark.parametrize(
    ("settings", "answer"),
    [
        ("P2=10 P3=1 P7=0", "11 51 60 1"),
        ("P2=20 P3=2 P7=0", "21 52 60 1"),
        ("P2=33 P3=2 P7=0", "1 52 60 1"),  # a GOSUB without its label is ignored
    ],
)
def test_jumps_to_computed_labels(card: Card, ask: Ask, settings: str, answer: str) -> None:
    enter(ask, [*COMPUTED_JUMPS, settings, "&1B5R"])
    card.run_cycles(300)
    assert ask("P1 P4 P5 P6") == answer
    assert not int(ask("&1??")[6:12], 16) & RUN_TIME_ERROR


@pytest.mark.parametrize("settings", ["P2=10 P3=2 P7=1", "P2=10 P3=9 P7=0"])
def test_a_jump_to_no_label_is_a_run_time_error(card: Card, ask: Ask, settings: str) -> None:
    enter(ask, [*COMPUTED_JUMPS, settings, "&1B5R"])
    card.run_cycles(300)
    assert int(ask("&1??")[6:12], 16) & RUN_TIME_ERROR
    assert not int(ask("&1??")[:6], 16) & 1
    assert ask("#1?")[1] == "8"  # the motor still holds its place


def test_addressed_by_variable_the_windows_move(card: Card, ask: Ask) -> None:
    enter(ask, ["I5=2", "OPEN PLC 4 CLEAR", "P400=2", "ADDRESS#P400", "ADR&P401", "Q5=77"])
    enter(ask, ['CMD"HMZ"', "DISABLE PLC4", "CLOSE", "P401=18", "ENABLE PLC4"])
    card.run_cycles(200)
    assert ask("&2Q5 &3Q5") == "77 0"  # 18 is 2 of 16
    homed = 1 << 14
    assert int(ask("#2?")[6:], 16) & homed
    assert not int(ask("#1?")[6:], 16) & homed


def test_axis_modes_stand_on_line_and_last(card: Card, ask: Ask) -> None:
    enter(ask, ["&1FRAX(X) INC(X)"])
    assert ask("&1??")[:6] == "0C0020"
    enter(ask, ["#1->100X", "#1J/", "OPEN PROG 6 CLEAR", "DWELL1", "CLOSE", "B6R"])
    card.run_cycles(100)
    assert ask("&1??")[:6] == "0C0020"  # neither B nor the program's end changes them
    enter(ask, ["FRAX", "ABS"])
    assert ask("??")[:6] == "AAAAA0"
    ask("$$$")
    assert ask("&1??")[:6] == "A80020"


def test_conditions_are_listed_without_blanks(ask: Ask) -> None:
    enter(
        ask, ["OPEN PROG 31 CLEAR", "IF(P174!=0 AND P176!=0 OR P1=$F AND P2=1)", "ENDIF", "CLOSE"]
    )
    assert ask("LIST PROG 31") == "IF(P174!=0ANDP176!=0ORP1=$F ANDP2=1) ENDI RET"
