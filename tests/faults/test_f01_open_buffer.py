"""F01: a program that was cut on its way leaves a buffer open: on this port, or on another one."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from pmac_comp.base.errors import CommandRefused, ConnectFailed, ControllerState, PmacCompError
from pmac_comp.machine.client.commander import Commander
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.contents.programs import ProgramKind
from pmac_comp.machine.controller.contents.settings import Settings
from pmac_comp.machine.controller.settings.settings_upload import change_settings
from pmac_comp.machine.controller.whole import recovery
from pmac_comp.machine.controller.whole.grouping import grouped
from pmac_comp.machine.transport.base import Framing
from pmac_comp.machine.transport.pair import PairTransport
from pmac_comp.machine.transport.tap import Fault, FaultKind, FaultyTransport, Way
from pmac_comp.simulator.dialog.sessions import AsciiSession, EthernetSession
from tests.unit.machine_controller.card_bench import CardBench

pytestmark = pytest.mark.faults
Count = Callable[[int], None]
PROGRAM = (ProgramKind.PROG, 704)
LINES = ("LINEAR", *(f"X{k}" for k in range(500)), "DWELL100")


class Line:
    """A port of the card that stays as it is when a conversation over it ends."""

    def __init__(self, bench: CardBench, framing: Framing, *, checksum: bool = False) -> None:
        kind = AsciiSession if framing is Framing.LINES else EthernetSession
        self.session, self.bench, self.framing = kind(bench.card), bench, framing
        self.checksum = checksum

    def open(self, faults: list[Fault] | None = None) -> tuple[Commander, FaultyTransport]:
        def peer(data: bytes) -> bytes:
            self.bench.card.run_cycles(2 if data else 0)
            return self.session.receive(data)

        tap = FaultyTransport(PairTransport(peer, self.bench.clock, framing=self.framing))
        tap.schedule(faults or [])
        return Commander(tap, clock=self.bench.clock, timeout_s=1.0, checksum=self.checksum), tap


def load(link: Commander, context: Context) -> None:
    with grouped(link, context, "program") as parts:
        change_settings(link, parts, Settings(programs={PROGRAM: LINES}))


def load_cut(line: Line, context: Context, at: int) -> None:
    with pytest.raises(PmacCompError):
        load(line.open([Fault(FaultKind.CUT, Way.SEND, at)])[0], context)


def bytes_of_load(tmp_path: Path, framing: Framing, *, checksum: bool) -> int:
    bench = CardBench(tmp_path / "whole")
    link, tap = Line(bench, framing, checksum=checksum).open()
    load(link, replace(bench.context, store=tmp_path / "whole"))
    return tap.sent


@pytest.mark.parametrize("checksum", [False, True])
def test_f01_the_same_serial_line_works_again(
    tmp_path: Path, *, checksum: bool, exhaustive: bool, count_runs: Count
) -> None:
    total = bytes_of_load(tmp_path, Framing.LINES, checksum=checksum)
    cuts = range(0, total, 23 if exhaustive else 499)
    for at in cuts:
        bench = CardBench(tmp_path / f"{at}")
        context = replace(bench.context, store=tmp_path / f"{at}")
        line = Line(bench, Framing.LINES, checksum=checksum)
        load_cut(line, context, at)
        link, _ = line.open()
        assert recovery.recover(link, context).verdict is ControllerState.OLD, at
        load(link, context)
    count_runs(len(cuts))


@pytest.mark.parametrize(
    ("first", "then"), [(Framing.LINES, Framing.PACKETS), (Framing.PACKETS, Framing.LINES)]
)
def test_f01_over_another_port_it_is_told_how(
    tmp_path: Path, first: Framing, then: Framing, count_runs: Count
) -> None:
    """Nobody knows whose buffer it is: it is not closed unasked."""
    total = bytes_of_load(tmp_path, first, checksum=False)
    for at in range(total // 4, total, total // 16):  # until the card has OPEN and no CLOSE yet
        bench = CardBench(tmp_path / f"{at}")
        load_cut(Line(bench, first), bench.context, at)
        if bench.card.programs.open_program is not None:
            break
    link, _ = Line(bench, then).open()
    with pytest.raises(CommandRefused, match="ERR007") as refused:
        recovery.recover(link, bench.context)
    assert "CLOSE ALL" in refused.value.advice
    assert refused.value.left is ControllerState.DISABLED
    link.command("CLOSE ALL")
    assert recovery.recover(link, bench.context).verdict is ControllerState.OLD
    load(link, bench.context)
    count_runs(1)


@pytest.mark.parametrize("answer", [b"login: \r", b"\x07\x07\x07\x07", b"ERR003\r", b"0\r"])
def test_f01_what_is_no_pmac_gets_no_close(tmp_path: Path, answer: bytes) -> None:
    bench, sent = CardBench(tmp_path), bytearray()

    def peer(data: bytes) -> bytes:
        sent.extend(data)
        return answer if data.endswith(b"\r") else b""

    with pytest.raises(ConnectFailed):
        Commander(PairTransport(peer, bench.clock, framing=Framing.LINES), clock=bench.clock)
    assert b"CLOSE" not in sent
