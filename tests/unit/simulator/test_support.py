"""What is outside the supported lists is refused; what real clients send is inside."""

import pytest

from pmac_comp.simulator.card.card import Card
from pmac_comp.simulator.dialog import manual
from pmac_comp.simulator.dialog.support import refused, report, report_lines, supported

from .conftest import Ask

# What has to be there before a form can act.
PREPARED: dict[str, tuple[str, ...]] = {
    "@1": ("I1=2",),
    "@": ("I1=2",),
    "LIST": (
        "OPEN PROG 1 CLEAR",
        "X1",
    ),
    "LIST PROGRAM 1": (
        "OPEN PROG 1 CLEAR",
        "X1",
        "CLOSE",
    ),
    "LIST PLC 1": (
        "OPEN PLC 1 CLEAR",
        "P1=1",
        "CLOSE",
    ),
    "OPEN ROT": ("DEFINE ROT 100",),
    "CLEAR": ("OPEN PROG 1",),
    "GATHER": ("DEFINE GATHER 100",),
    "GATHER TRIGGER": ("DEFINE GATHER 100",),
    "LIST GATHER": ("DEFINE GATHER 100",),
    "PR": (
        "DEFINE ROT 100",
        "OPEN ROT",
    ),
    "X=5": ("#1->X",),
    **dict.fromkeys(
        ("LIST COMP", "LIST COMP DEF"),
        (
            "DEFINE COMP 2,1000",
            "1 2",
        ),
    ),
    **dict.fromkeys(
        ("LIST TCOMP", "LIST TCOMP DEF"),
        (
            "DEFINE TCOMP 2,1000",
            "1 2",
        ),
    ),
    **dict.fromkeys(
        ("LIST BLCOMP", "LIST BLCOMP DEF"),
        (
            "DEFINE BLCOMP 2,1000",
            "1 2",
        ),
    ),
    **dict.fromkeys(
        ("LIST PC", "LIST PE", "PC", "PE", "R", "S", "B1", "ABR1", ">"),
        (
            "OPEN PROG 1 CLEAR",
            "X1",
            "CLOSE",
            "#1->X",
            "#1J/",
            "B1",
        ),
    ),
}
# Words of other sources that have to be refused as well.
UNSUPPORTED = [
    "ADISABLE", "AENABLE", "DISABLE", "ROT0", "WY$5", "RF$60000", "RDP$60000", "CLOSE BIN",
    "REBOOT", "DUMP", "TRACE", "DELETE TRACE", "DEFINE TRACE 5",
]  # fmt: skip
UNSUPPORTED_PROGRAM = ["TX1", "X10^5", "X10I5J5", "X5Y5R2", "MACROSLAVE", "X1G1", "GOSUB5(P1)D1"]


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


def refuses(answer: str) -> bool:
    return answer.endswith(("ERR003", "ERR005", "ERR020"))


@pytest.mark.parametrize("text", manual.ON_LINE)
def test_supported_commands_of_the_manual_act(ask: Ask, text: str) -> None:
    for line in PREPARED.get(text, ()):
        assert not refuses(ask(line)), line
    assert not refuses(ask(text))


@pytest.mark.parametrize("text", [*manual.ON_LINE_REFUSED, *UNSUPPORTED])
def test_other_commands_are_refused_and_change_nothing(card: Card, ask: Ask, text: str) -> None:
    before = card.memory.x.tobytes(), card.memory.y.tobytes()
    answer = ask(text)
    assert refuses(answer)
    assert answer.count(" ") == 0  # no part of it was a question
    assert (card.memory.x.tobytes(), card.memory.y.tobytes()) == before


@pytest.mark.parametrize(
    ("buffer", "text"),
    [*(("PROG", t) for t in manual.MOTION), *(("PLC", t) for t in manual.PLC)],
)
def test_supported_statements_of_the_manual_are_stored(ask: Ask, buffer: str, text: str) -> None:
    ask(f"I9=3 OPEN {buffer} 1 CLEAR")
    assert ask(text) == ""
    assert ask("LIST").replace(" ", "") == text.replace(" ", "").replace("SENDS", "SENDS")


@pytest.mark.parametrize(
    ("buffer", "text"),
    [
        *(("PROG", t) for t in (*manual.MOTION_REFUSED, *UNSUPPORTED_PROGRAM)),
        *(("PLC", t) for t in (*manual.PLC_REFUSED, "X1", "LINEAR", "DWELL5")),
    ],
)
def test_other_statements_are_refused_whole(ask: Ask, buffer: str, text: str) -> None:
    assert ask(f"OPEN {buffer} 1 CLEAR") == ""
    assert ask("P1=5") == ""
    size = ask("SIZE")
    assert ask(text).endswith("ERR003")
    assert ask("LIST") == "P1=5"
    assert ask("SIZE") == size


def test_every_keyword_stands_in_a_form_of_the_manual() -> None:
    lists = supported()
    for words, forms in (("commands", "command_forms"), ("motion", "motion_forms")):
        known = " ".join(form.replace(" ", "") for form in lists[forms])
        for word in lists[words]:
            assert word in NOT_IN_THE_SUMMARY or SHORT.get(word, word) in known, word
    assert set(lists["plc"]) - set(lists["motion"]) <= {"AND", "OR", "ADDRESS", "ADR"}


# Short forms of the command pages (SRM p. 295-403, 405-485), and what they are short for.
SHORT = {
    "ADR": "ADDRESS", "BSTART": "BLOCKSTART", "BSTOP": "BLOCKSTOP", "CHKS": "CHECKSUM",
    "CLR": "CLEAR", "CLRALL": "CLEARALL", "CLRALLPLCS": "CLEARALLPLCS", "CLS": "CLOSE",
    "CLSALL": "CLOSEALL", "CMD": "COMMAND", "DAT": "DATE", "DEF": "DEFINE",
    "DEL": "DELETE", "DISPLC": "DISABLEPLC", "DISPLCC": "DISABLEPLCC",
    "DISABLEPLCC": "DISABLEPLCC", "DLY": "DELAY", "DWE": "DWELL",
    "EAVER": "EAVERSION", "ENAPLC": "ENABLEPLC", "ENDG": "ENDGATHER",
    "ENDI": "ENDIF", "ENDW": "ENDWHILE", "GAT": "GATHER", "GOS": "GOSUB",
    "HM": "HOME", "HMZ": "HOMEZ", "IDNUM": "IDNUMBER", "LIN": "LINEAR",
    "LIS": "LIST", "LISTGAT": "LISTGATHER", "LISTPROG": "LISTPROGRAM",
    "LISGAT": "LISTGATHER", "LISGATHER": "LISTGATHER", "LISPC": "LISTPC",
    "LISPE": "LISTPE", "LISPLC": "LISTPLC", "LISPROG": "LISTPROGRAM",
    "LISPROGRAM": "LISTPROGRAM", "MVTM": "MOVETIME", "OPENPROGRAM": "OPENPROG",
    "OPENROTARY": "OPENROT", "PAUPLC": "PAUSEPLC", "RESPLC": "RESUMEPLC",
    "RET": "RETURN", "RPD": "RAPID", "UNDEF": "UNDEFINE", "UNDEFALL": "UNDEFINEALL",
    "VER": "VERSION", "WAI": "WAIT",
}  # fmt: skip
# Read and write commands of the other memories, the test command, and refusals with a number.
NOT_IN_THE_SUMMARY = {
    "FAULT", "FREAD", "FSAV", "FSAVCLR", "FSAVE", "FSAVECLEAR", "RHL", "RHP", "RHX", "RHY", "RL",
    "RP", "RX", "RY", "WL", "WP", "WX", "WY",
}  # fmt: skip


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


def test_report_names_everything() -> None:
    text = "\n".join(report_lines())
    for word in ("J=100^50", "CIRCLE1", "WRITEBUFFER", "FWDOWNLOAD", "I5000", "Isx13"):
        assert word in text
    assert max(len(line) for line in report_lines()[2:]) < 250
    assert set(report()) == {"supported", "refused", "kept_without_effect", "differences"}
