"""What is outside the supported lists is refused; what real clients send is inside."""

import pytest

from pmac_comp.simulator.card import Card
from pmac_comp.simulator.support import refused, supported

from .conftest import Ask

# Commands of the manual's list that the simulated card does not have.
UNSUPPORTED = [
    "!X5", "ADISABLE", "AENABLE", "DISABLE", "DEFINE_CCBUF", "DEFINE_TBUF_2",
    "DEFINE_LOOKAHEAD_100,10", "DELETE_PLCC_3", "FSAVE", "FSAVECLEAR", "FREAD",
    "LIST_FORWARD", "LIST_INVERSE", "LIST_LINK", "LIST_LDS", "LIST_ROTARY",
    "MACROAUX0,1", "MACROAUXREAD1,2,P3", "MACROSLV4,5", "MACROSLVSAVE0", "MS0,MI10",
    "MSR0,1,P1", "NOFRAX", "OPEN_BIN_ROT", "OPEN_FORWARD", "OPEN_INVERSE", "ROT0",
    "SETPHASE1", "TRACE", "WY$5", "RF$60000", "RDP$60000", "STN", "CLOSE_BIN", "REBOOT",
    "DUMP", "FSAV", "FSAVCLR", "ENABLE_PLCC_1",
]  # fmt: skip

# Program text of the manual that is refused when it is entered.
UNSUPPORTED_PROGRAM = [
    "CIRCLE1", "CIRCLE2", "SPLINE2", "NORMAL_K-1", "CC0", "CC1", "CCR5", "TX1", "TSEL1",
    "TINIT", "ADIS1", "AROT1", "IROT1", "IDIS1", "TR", "READ(X)", 'DISPLAY"x"', 'DISP"x"',
    "SETPHASE1", "G1", "M3", "T5", "D4", "X10^5", "X10I5J5", "LOOKAHEAD", "NOFRAX",
    "MACROSLAVE", "ENABLEPLCC1", "PRELUDE1",
]  # fmt: skip

# Lines seen from EPICS, terminal programs and device servers.
CLIENT_LINES = """
??? M4040 M72 M73 M70 M71 M4038 M4039
&1%&2%&16%
M5000..5031
M5180 M5280 M6680
M4037 M4041 M4042 M4049 I42 I8 I7002
I113 I114 I130 I131 I133
#1? #1P #1F I124 #2? #2P #2F I224
i65???&1??%#1?PVFm190p99#2?PVFm290p99
P4801=1 P4901=2.5
I113=1000000 I114=1
&1%100.000000
I122=32.000000 I120=100.000000 #1 J=5000.00
#1 J/
 i124=i124|$20000
#1K M161=5*32*I108 M162=5*32*I108
&2 Q80,4,1
M162 = 30/0.000488
i5051=0 i5050=$3
i5001=$80008B
define gather 287.0
delete gather
WL:$10020,$400000000800,$400000000801
RHX:$10F0,16
disable plc 0..31
&1#1->X
undefine all
#1J:100#1J^0#1J=*
TYPE VERSION CPU VID DATE TIME TODAY
""".strip().splitlines()


@pytest.mark.parametrize("text", UNSUPPORTED)
def test_commands_outside_the_list_are_refused(card: Card, ask: Ask, text: str) -> None:
    line = text.replace("_", " ")
    before = card.memory.x.tobytes(), card.memory.y.tobytes()
    assert ask(line).endswith(("ERR003", "ERR005", "ERR020")), line
    assert (card.memory.x.tobytes(), card.memory.y.tobytes()) == before


@pytest.mark.parametrize("text", UNSUPPORTED_PROGRAM)
def test_program_text_outside_the_list_is_refused(ask: Ask, text: str) -> None:
    assert ask("OPEN PROG 1 CLEAR") == ""
    assert ask(text.replace("_", " ")).endswith("ERR003")
    assert ask("LIST") in ("", "X10")


@pytest.mark.parametrize("line", CLIENT_LINES)
def test_lines_of_real_clients_are_answered(card: Card, ask: Ask, line: str) -> None:
    card.run_cycles(10)
    assert "ERR" not in ask(line)


def test_lists_name_what_they_should() -> None:
    lists = supported()
    assert {"J", "HM", "DEFINE", "LIST", "SAVE", "$$$", "RHX"} <= set(lists["commands"])
    assert {"LINEAR", "RAPID", "PVT", "SPLINE1", "DWELL", "DELAY", "HOME"} <= set(lists["motion"])
    assert {"IF", "WHILE", "COMMAND", "ENABLEPLC", "AND"} <= set(lists["plc"])
    assert "WRITEBUFFER" in lists["requests"]
    assert "FWDOWNLOAD" in refused()["requests"]
    assert not set(lists["variables"]) & set(refused()["variables"])
