"""On-line commands: answers, number forms, ranges, errors."""

import pytest

from pmac_comp.simulator.card.card import Card
from pmac_comp.simulator.memory.ivariables import TABLE

from .conftest import Ask


@pytest.mark.parametrize(
    ("line", "answer"),
    [
        ("i6=1 i3=2 ver", "1.947  ".strip()),
        ("CID", "603382"),
        ("cpu type vid", "56303 TURBO2, X4 1"),
        ("i20 i21 i22 i23 i24", "$0 $0 $0 $0 $60000"),
        ("I102 I103 I8000", "$78002 $3501 $C78000"),
        ("I130,3,100", "139449 2000 2000"),
        ("I130..131", "139449 2774"),
        ("I3=6 I3", "2"),
        ("I104=@I8001 I104", "$3502"),
        ("P1=1/3 P1", "0.3333333333"),
        ("P1=0.0005 P2=-5797.53 P3=0 P1..3", "0.0005 -5797.53 0"),
        ("P(1+2)=7 P3", "7"),
        ("P1..3=5 P1..3", "5 5 5"),
        ("M1->X:$78000,8,16,S M1->", "X:$78000,8,16,S"),
        ("M1->Y:$C0,0 M1->", "Y:$C0,0"),
        ("M1->X:$B0,24 M1->", "X:$B0,24"),
        ("M1->X:0,0,24,S M1->", "X:$0,24,S"),
        ("M1->DP:$60080 M1->", "DP:$60080"),
        ("M1->* M1=-7 M1", "-7"),
        ("M162->", "D:$8B"),
        ("M0..2->* M0..2->", "* * *"),
        ("M1->Y:$10F0,8,8 M1=300 M1", "44"),
        ("M1->L:$10F0 M1=0.1 RHL$10F0", "6666666667FC"),
        ("WX$10F0,$5A,-1 RX$10F0,2", "90 -1"),
        ("RHY:$3501,2", "C78000 C78008"),
        ("WL$10F0,$400000000800 RHL$10F0 RHX$10F0", "400000000800 400000"),
        ("RX$10F0,4,2", "0 0 0 0"),
        ("#3#", "3"),
        ("&5&", "5"),
        ("##2##", "2"),
        ("1 2 3 P0", "3"),
        ("LOCK0,P1 LOCK0,P2 P1 P2 UNLOCK0 LOCK0,P1 P1", "0 1 0"),
        ("%", "100"),
        ("%0%", "0"),
        ("&2#3->100.5X+20-3Y#3->", "100.5X-3Y+20"),
        ("&2#3->100.5X-3Y+20#3->", "100.5X-3Y+20"),
        ("#1->0#1->", "0"),
        ("I9=3 P1=4 P1 I102 M162->", "P1=4 I102=$78002 M162->D:$8B"),
        ("#1?", "840000000000"),
        ("&1??", "A80020000000000000"),  # X, Y, Z at the feedrate, radius vector incremental
        ("SIZE", "26624"),
    ],
)
def test_answer(ask: Ask, line: str, answer: str) -> None:
    assert ask(line).strip() == answer


@pytest.mark.parametrize(
    ("line", "code"),
    [
        ("XYZZY", 3),
        ("X100", 5),
        ("LINEAR", 5),
        ("WHILE(P1=1)", 5),
        ("P8192", 3),
        ("#33", 3),
        ("&17", 3),
        ("P1=+2", 3),
        ("J=(P5)", 3),
        ("LIST", 3),
        ("LIST PROG 5", 3),
        ("LIST COMP", 3),
        ("LIST GATHER", 3),
        ("CLEAR", 7),
        ("PR", 3),
        ("PC", 3),
        ("&1B7R", 15),
        ("STOP", 5),
        ("R", 14),
        ("FSAVE", 20),
        ("@5", 3),
        ("M1->Z:$5", 3),
        ("M1->X:$5,20,8", 3),
        ("M1->X:$10F0,3,8,D", 3),  # only single bits begin anywhere (SRM p. 360)
        ("M1->Y:$10F0,2,20", 3),
        ("M1->Y:$10F0,1,4", 3),
        ("DEFINE LOOKAHEAD 100,100", 3),
        ("OPEN FORWARD", 3),
        ("OPEN BIN ROT", 3),
        ('SEND"x"', 5),
        ("GATHER", 3),  # a command as well: it lacks its own buffer, not that of a program
        ("OPEN PROG 1 CLEAR X1 CLOSE B1.5", 3),  # no such label
    ],
)
def test_refusal(ask: Ask, line: str, code: int) -> None:
    assert ask(line).endswith(f"ERR{code:03d}")


def test_first_error_stops_the_line(ask: Ask) -> None:
    assert ask("P1=1 P1 NONSENSE P1=2") == "1 ERR003"
    assert ask("P1") == "1"


def test_every_unsupported_ivariable_keeps_its_default_and_refuses_others(
    card: Card, ask: Ask
) -> None:
    fixed = [n for n, v in TABLE.items() if v.fixed]
    assert len(fixed) > 4000
    for number in fixed:
        present = card.variables.read_i(number)
        assert ask(f"I{number}={present:.12g}") == ""
        assert ask(f"I{number}=3") == "ERR003" or present == 3
        assert card.variables.read_i(number) == present


def test_every_ivariable_answers(card: Card) -> None:
    reply = card.port().line("I0..8191")
    lines = reply.decode().split("\r")
    assert len(lines) == 8193
    assert lines[-1] == "\x06"
    assert all(line.lstrip("-$").replace(".", "").isalnum() for line in lines[:-1])


def test_ivariables_keep_written_values_in_their_registers(card: Card, ask: Ask) -> None:
    ask("I130=12345 I169=20000 I122=12.5 I113=-77 I136=-1.5 I140=0.25 I106=3 I134=1 I197=2")
    assert ask("I130 I169 I122 I113 I136 I140 I106 I134 I197").split() == [
        "12345", "20000", "12.5", "-77", "-1.5", "0.25", "3", "1", "2",
    ]  # fmt: skip
    assert ask("RY$99") == "12345"
    assert int(card.memory.y[0xAE]) == 20000 * 256
    assert int(card.memory.x[0xB0]) & 0x3D == 0x38  # I106 = 3 and I197 = 2


def test_lock_mask_ignores_assignments_silently(ask: Ask) -> None:
    ask("I41=1")
    assert ask("I130=5") == ""
    assert ask("I130") == "139449"


def test_two_ports_keep_their_own_addressing(card: Card) -> None:
    one, two = card.port(), card.port()
    one.line("#4&3")
    assert two.line("#&") == b"1\r1\r\x06"
    assert one.line("#&") == b"4\r3\r\x06"


def test_q_variables_have_a_window_per_coordinate_system(ask: Ask) -> None:
    ask("&1")
    ask("Q1=5")
    ask("&2")
    ask("Q1=6")
    assert ask("Q1&1Q1&2Q1") == "6 5 6"
    assert ask("&1Q513") == "6"


def test_m_variable_can_be_repointed_through_memory(ask: Ask) -> None:
    ask("M500->X:$10F0,24 WX$10F1,42 WY$41F4,$10F1")
    assert ask("M500") == "42"


def test_position_is_set_through_registers_while_killed(card: Card, ask: Ask) -> None:
    card.run_cycles(10)
    ask("#1K M161=500*32*I108 M162=500*32*I108")
    card.run_cycles(10)
    assert ask("#1P") == "500"


def test_identity_of_servo_clock(ask: Ask) -> None:
    assert ask("I7000 I7001 I7002 I10") == "6516 0 3 3707733"
    assert int(640 / 9 * (2 * 6516 + 3) * 4) == 3707733


@pytest.mark.parametrize(
    "line",
    [
        "#1J=100000000000000000000",
        "#1J==100000000000000000000",
        "#1J^-100000000000000000000",
        "&1#1->X X=100000000000000000000",
        "&1#1->0.00000000000000000001X J+ Z",
        "I10=0 #1J/ J+ J=5",
        "M1->L:$10F0 WL$10F0,$7FFFFFFFFFFF M1 P1=M1*M1 P1",
        "WL$10F0,$FFFFFFFFFFFFFFFFFFFFFFFF RL$10F0",
        "DEFINE COMP 4,1000 DELETE COMP",
    ],
)
def test_what_no_register_holds_is_kept_as_near_as_it_can(card: Card, ask: Ask, line: str) -> None:
    ask("#1J/")
    card.run_cycles(20)
    assert "ERR" not in ask(line)
    card.run_cycles(50)
    assert ask("Q1=7 Q1") == "7"


@pytest.mark.parametrize(
    ("line", "code"),
    [
        ("DEFINE BLCOMP 4,100000000000000000000", 3),
        ("DEFINE COMP 2.2,#1,1000,100000000000000000000", 3),
        ("P(EXP(1000)*EXP(1000))", 3),
        ("P(-5)=1", 3),
        ("J=(P5)", 3),
    ],
)
def test_numbers_out_of_range_are_data_errors(ask: Ask, line: str, code: int) -> None:
    assert ask(line) == f"ERR{code:03d}"


def test_an_axis_is_matched_and_renamed_during_an_endless_jog(card: Card, ask: Ask) -> None:
    ask("&1#1->1000X")
    ask("#1J/")
    card.run_cycles(20)
    ask("J+")
    card.run_cycles(500)
    assert ask("PMATCH") == ""
    assert ask("X=5") == ""
    assert float(ask("P")) == pytest.approx(5000, abs=200)
    ask("J/")
    card.run_cycles(2000)
    assert float(ask("Z P")) == pytest.approx(0.0, abs=2)


@pytest.mark.parametrize("text", ["TWS:$1", "Z:$10", "X", "Y:", "DP:", "SL:$10"])
def test_a_bad_m_definition_is_refused_whole(ask: Ask, text: str) -> None:
    ask("M500->X:$10F0,24")
    assert ask(f"M500->{text}") == "ERR003"
    assert ask("M500-> M500->Y:$10,0 M500->P9") == "X:$10F0,24 Y:$10,0 0"
