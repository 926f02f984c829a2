"""The same commands at the same servo cycles leave the same card, however time was cut.

A card served at real time, at a factor of it and as fast as it goes differs in nothing but the
pieces its time comes in; whole memory, drive and answers are compared byte by byte.
"""

import numpy as np
import pytest

from pmac_comp.files.bench import Bench
from pmac_comp.simulator.card.card import Card

SETUP = """
I5=3 I8=0 I124=$20001 I113=0 I114=0 I111=64000 I116=1000 I117=1
#1 DEFINE COMP 8,#1D,#1,40000
16 32 -16 48 -32 16 8 0
I51=1
I5000=3 I5001=$400000 I5002=$80008B I5003=$80010B I5004=$4000BF I5050=15 I5049=3
DEFINE GATHER 3000
OPEN PLC 0 CLEAR
P1=P1+1
M600=P1%7
CLOSE
OPEN PLC 5 CLEAR
P2=P2+1
IF(P2=40)
CMD"#2J:100"
SEND"forty"
ENDIF
CLOSE
M600->X:$10F0,0,24
&1#1->1000X
OPEN PROG 7 CLEAR
LINEAR ABS TA40 TS10 F80
WHILE(P9<6)
X5
M601==P9
X-5
P9=P9+1
ENDWHILE
DWELL50
CLOSE
M601->Y:$10F1,0,24
I47=4 I48=1 I49=1 I50=10
""".strip().splitlines()
# Servo cycle -> commands, among them a jog stop, a feed hold and a fault in mid-motion.
SCHEDULE = {
    3: ["#1J/", "ENABLE PLC 0", "ENABLE PLC 5", 'FAULT"NOISE 0.3"'],
    101: ["GATHER", "#1J:2500"],
    613: ["#1J/"],
    900: ["P9=0 &1B7R"],
    1777: ["&1H"],
    2222: ["#1J:300"],
    3333: ["#1J="],
    4001: ["&1R"],
    5000: ["%40"],
    6500: ['FAULT"SCALE"'],
    7000: ["&1A", "I130=120000"],
    7600: ["#1O5"],
    7700: ["#1K"],
}
LAST = 8000


def life(bench: Bench, cut: list[int]) -> tuple[list[bytes], bytes, bytes, bytes]:
    """Answers, memory and drive after the schedule; time comes in the pieces of `cut`, in turn."""
    card = Card(bench, faults=True)
    port = card.port()
    answers = [port.line(line) for line in SETUP]
    assert not any(b"ERR" in answer for answer in answers)
    turn, now = 0, 0
    for cycle in [*SCHEDULE, LAST]:
        while now < cycle:
            piece = min(cut[turn % len(cut)], cycle - now)
            turn += 1
            card.run_cycles(piece)
            now += piece
        answers += [port.line(line) for line in SCHEDULE.get(cycle, [])]
        answers += [port.line("#1?PVF#2?P&1??%"), port.line("??? P1..2 P9")]
    drive = card.servo.plant.state  # type: ignore[attr-defined]
    return answers, card.memory.x.tobytes(), card.memory.y.tobytes(), drive.tobytes()


@pytest.mark.parametrize(
    "cut",
    [[1], [7, 3, 11, 1], [23], [300, 1, 299]],
    ids=["every cycle", "small pieces", "real time", "as fast as it goes"],
)
def test_speed_changes_nothing(bench: Bench, cut: list[int]) -> None:
    answers, x, y, drive = life(bench, cut)
    wanted = life(bench, [LAST])
    assert answers == wanted[0]
    for name, found, expected in (("X", x, wanted[1]), ("Y", y, wanted[2])):
        words = np.frombuffer(found, np.int32) != np.frombuffer(expected, np.int32)
        assert not words.any(), f"{name}:${int(np.flatnonzero(words)[0]):X}"
    assert drive == wanted[3]
