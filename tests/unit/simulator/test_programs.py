"""Program buffers: entering, structure, listing, PLC scans and switches."""

import pytest

from pmac_comp.simulator.card.card import Card

from .conftest import Ask


def enter(ask: Ask, *lines: str) -> None:
    for line in lines:
        assert ask(line) == "", line


def test_listing_forms(ask: Ask) -> None:
    enter(ask, "OPEN PROG 5 CLEAR", "linear abs ta100 ts0", "f(p4) x(p5*2) y-10.50", "dwell 500")
    enter(ask, "while (p1 < 360 and m1=1)", "x100:50 p1=p1+$10", "endwhile", 'cmd "#1j/"', "CLOSE")
    assert ask("LIST PROG 5").split(" ") == [
        "LIN", "ABS", "TA100", "TS0", "F(P4)", "X(P5*2)Y-10.5", "DWE500",
        "WHILE(P1<360ANDM1=1)", "X100:50", "P1=P1+$10", "ENDW", 'CMD"#1j/"', "RET",
    ]  # fmt: skip
    ask("I9=3")
    assert ask("LIST PROG 5,0,3") == "0:LINEAR 1:ABS 2:TA100"
    assert ask("LIST PROG 5,6").startswith("6:X(P5*2)Y-10.5 8:DWELL500 9:WHILE(")
    assert ask("LIST PROG 5,900") == "ERR003"


def test_listing_can_be_entered_again_and_lists_the_same(ask: Ask) -> None:
    enter(ask, "OPEN PROG 7 CLEAR", "IF(P1=1)X10 DWELL5", "ELSE X20", "N100 GOSUB 200")
    enter(ask, "IF (P1=2)", "X5", "ENDIF", "M1==5", "N200 P3=P3+1 RETURN", "CLOSE")
    first = ask("LIST PROG 7")
    lines = [*first.split(" ")]
    enter(ask, "OPEN PROG 8 CLEAR", *lines[:-1], "CLOSE")
    assert ask("LIST PROG 8") == first


def test_a_block_that_begins_behind_else_ends_on_its_own_line(card: Card, ask: Ask) -> None:
    lines = ["IF(P1=1)", "P2=1", "ELSEIF(P1=2)", "P2=2", "IF(P3=1)P4=1", "ENDI", "ENDI", "P5=5"]
    enter(ask, "OPEN PROG 7 CLEAR", *lines, "CLOSE")
    assert ask("LIST PROG 7").split(" ") == [*lines, "RET"]
    enter(ask, "P1..5=0", "P3=1", "&1#1->X", "#1J/ B7R")
    card.run_cycles(20)
    assert ask("P2 P4 P5") == "0 0 5"
    enter(ask, "P1=2", "B7R")
    card.run_cycles(20)
    assert ask("P2 P4 P5") == "2 1 5"


@pytest.mark.parametrize(
    "lines",
    [
        ["IF(P1=1)", "P2=1"],
        ["WHILE(P1=1)"],
        ["ENDIF"],
        ["ELSE"],
        ["ENDWHILE"],
        ["WHILE(P1=1)", "ENDIF"],
        ["IF(P1=1)", "ENDWHILE"],
        ["P1=1", "AND(P2=1)"],
        ["IF(P1=1)", "P2=1", "OR(P2=1)", "ENDIF"],
    ],
)
def test_structure_errors_are_told_at_close_and_close_anyway(ask: Ask, lines: list[str]) -> None:
    enter(ask, "OPEN PLC 5 CLEAR", *lines)
    assert ask("CLOSE") == "ERR009"
    enter(ask, "OPEN PLC 6 CLEAR", "CLOSE")
    ask("ENABLE PLC 5")
    assert ask("RHY$3105")[:1] in "4567"


def test_buffer_rules(card: Card, ask: Ask) -> None:
    assert ask("OPEN PLC 3 CLEAR") == ""
    other = card.port()
    assert other.line("OPEN PROG 1") == b"\x07ERR007\r"
    assert other.line("CLEAR") == b"\x07ERR007\r"
    assert other.line("CLOSE P1=3 P1") == b"3\r\x06"  # another port's buffer stays open
    assert ask("P1=9") == ""  # goes into the buffer
    assert other.line("P1") == b"3\r\x06"
    assert ask("P1..3=0") == ask("P1,3,2=0") == ask("P1, 3 = $A") == "ERR003"
    assert ask("P1..2") == ask("P1,2") == "3 0"  # asking is no program text
    assert ask("#1P") == "0"  # pure on-line commands are executed
    assert ask("X100") == "ERR003"  # no axis moves in a PLC
    assert int(ask("???")[6:], 16) >> 17 & 1  # PLC buffer open
    assert ask("LIST") == ask("LIST PLC 3") == "P1=9"  # CLOSE appends RETURN
    assert ask("SIZE").startswith("-")
    assert ask("CLOSE") == ""
    assert ask("LIST PLC 3") == "P1=9 RET"


def test_no_program_runs_while_a_motion_buffer_is_open(ask: Ask) -> None:
    enter(ask, "&1#1->X", "OPEN PROG 1 CLEAR", "X100", "CLOSE", "#1J/", "B1")
    enter(ask, "OPEN PROG 2 CLEAR")
    assert ask("&1R") == "ERR015"
    ask("CLOSE")
    assert ask("&1R") == "ERR015"  # must be pointed again
    assert ask("&1B1R") == ""


def test_memory_full_is_err006(card: Card, ask: Ask) -> None:
    enter(ask, "DEFINE GATHER")
    assert ask("SIZE") == "0"
    enter(ask, "OPEN PROG 9 CLEAR")
    assert ask("X100") == "ERR006"
    ask("CLOSE")
    assert ask("DELETE GATHER") == ""
    assert int(ask("SIZE")) > 20000


def test_plc_scan_ends_at_endwhile(card: Card, ask: Ask) -> None:
    enter(ask, "OPEN PLC 4 CLEAR", "P10=P10+1", "P11=0", "WHILE(P11<3)", "P11=P11+1")
    enter(ask, "P12=P12+1", "ENDWHILE", "P13=P13+1", "DISABLE PLC 4", "CLOSE", "I5=2", "P10..13=0")
    enter(ask, "ENABLE PLC 4")
    seen = []
    for _ in range(6):
        card.run_cycles(10)
        seen.append(ask("P10 P12 P13"))
    assert seen == ["1 1 0", "1 2 0", "1 3 0", "1 3 1", "1 3 1", "1 3 1"]


def test_plc_condition_lines_bind_after_those_inside(card: Card, ask: Ask) -> None:
    enter(ask, "OPEN PLC 4 CLEAR", "IF(P1=1 OR P2=1)", "AND(P3=1)", "P4=1", "ELSE", "P4=2", "ENDIF")
    enter(ask, "CLOSE", "I5=2", "P1=1 P2=0 P3=0", "ENABLE PLC 4")
    card.run_cycles(10)
    assert ask("P4") == "2"
    ask("P3=1")
    card.run_cycles(10)
    assert ask("P4") == "1"


def test_plc_zero_runs_at_the_real_time_interrupt(card: Card, ask: Ask) -> None:
    enter(ask, "OPEN PLC 0 CLEAR", "P10=P10+1", "CLOSE", "P10=0", "I8=0", "I5=1", "ENABLE PLC 0")
    card.run_cycles(1)
    start = int(ask("P10"))
    card.run_cycles(100)
    assert int(ask("P10")) - start == 100
    ask("I8=3")
    card.run_cycles(8)
    start = int(ask("P10"))
    card.run_cycles(100)
    assert int(ask("P10")) - start == 25
    ask("I5=2")
    start = int(ask("P10"))
    card.run_cycles(100)
    assert int(ask("P10")) == start


def test_command_in_plc_is_executed_after_the_scan_with_its_own_addressing(
    card: Card, ask: Ask
) -> None:
    enter(ask, "OPEN PLC 4 CLEAR", "ADDRESS#2&3", 'CMD"P20=123"', "P21=P20", 'CMD"I8=5"')
    enter(ask, "Q5=77", "DISABLE PLC4", "CLOSE", "I5=2", "P20=0 P21=9", "ENABLE PLC 4")
    card.run_cycles(30)
    assert ask("P20 P21 I8") == "123 0 5"
    assert ask("&3Q5") == "77"


def test_a_plc_may_reset_the_card_whatever_it_commands_behind_it(card: Card, ask: Ask) -> None:
    enter(ask, "P7=5 I5=2", "OPEN PLC 3 CLEAR", 'CMD"P7=6"', 'CMD"$$$"', 'CMD"P7=7"', "CLOSE")
    enter(ask, "ENABLE PLC 3")
    card.run_cycles(100)
    assert ask("P7") == "0"
    assert ask("LIST PLC 3") == "ERR003"


def test_commands_that_start_their_own_program_again_do_not_pile_up(card: Card, ask: Ask) -> None:
    enter(ask, "#1->1000X", "#1J/", 'OPEN PROG 5 CLEAR CMD"&1S" CMD"&1S P7=P7+1" CLOSE', "B5R")
    card.run_cycles(150)
    assert 0 < int(ask("P7")) <= 15 * 256  # each turn would double them


def test_a_plc_that_floods_the_command_queue_is_halted(card: Card, ask: Ask) -> None:
    many = [f'CMD"P{k}=1"' for k in range(50)]
    for number in range(1, 8):
        enter(ask, f"OPEN PLC {number} CLEAR", *many, "CLOSE", f"ENABLE PLC {number}")
    enter(ask, "I5=2")
    card.run_cycles(30)
    stopped = [int(ask(f"RHY$31{number:02X}"), 16) >> 22 & 1 for number in range(1, 8)]
    assert 0 < sum(stopped) < 7


def test_pause_and_resume(card: Card, ask: Ask) -> None:
    enter(ask, "OPEN PLC 4 CLEAR", "P10=P10+1", "PAUSE PLC 4", "P11=P11+1", "CLOSE")
    enter(ask, "I5=2", "P10=0 P11=0", "ENABLE PLC 4")
    card.run_cycles(50)
    assert ask("P10 P11") == "1 0"
    ask("RESUME PLC 4")
    card.run_cycles(10)
    assert ask("P10 P11") == "1 1"


def test_user_timer_waits_in_servo_cycles(card: Card, ask: Ask) -> None:
    enter(
        ask, "OPEN PLC 4 CLEAR", "I5111=100*8388608/I10", "WHILE(I5111>0)", "ENDWHILE", "P10=M100"
    )
    enter(ask, "DISABLE PLC4", "CLOSE", "I5=2", "P10=0", "ENABLE PLC 4")
    card.run_cycles(100)
    assert ask("P10") == "0"
    card.run_cycles(150)
    assert 220 <= int(ask("P10")) <= 250  # 100 ms are 226 cycles


def test_endless_plc_does_not_hang_the_card(card: Card, ask: Ask) -> None:
    enter(ask, "OPEN PLC 4 CLEAR", *["P1=P1+1"] * 50, "WHILE(1=1)", "ENDWHILE", "CLOSE")
    enter(ask, "I5=3", "ENABLE PLC 4")
    card.run_cycles(1000)
    assert ask("P2=5 P2") == "5"


def test_password_protects_programs(ask: Ask) -> None:
    enter(ask, "OPEN PLC 4 CLEAR", "P1=1", "CLOSE", "OPEN PLC 20 CLEAR", "P1=1", "CLOSE")
    enter(ask, "PASSWORD=Geheim", "SAVE", "$$$")
    assert ask("LIST PLC 4") == "ERR002"
    assert ask("OPEN PLC 4") == "ERR002"
    assert ask("LIST PLC 20") == "P1=1 RET"
    assert ask("PASSWORD=geheim") == "ERR002"
    assert ask("PASSWORD=Geheim") == ""
    assert ask("LIST PLC 4") == "P1=1 RET"


def test_a_plc_that_holds_nothing_is_none_after_a_reset(card: Card, ask: Ask) -> None:
    """Its bit 22 was 0, as of one that runs."""
    for line in ("OPEN PLC 3 CLEAR", "P1=1", "CLOSE", "OPEN PLC 3 CLEAR"):
        ask(line)
    assert int(ask("RHY$3103"), 16) >> 23 == 1
    ask("CLOSE")
    ask("SAVE")
    card.reset()
    card.run_cycles(50)
    assert (ask("RHY$3103"), ask("LIST PLC 3")) == ("400000", "ERR003")
