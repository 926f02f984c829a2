"""A simulated card in this process, with a conversation, limits and a folder."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.machine.client.commander import Commander
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.contents.law_bank import LawBlock
from pmac_comp.machine.controller.contents.programs import Program, ProgramKind
from pmac_comp.machine.controller.contents.safety import Limits
from pmac_comp.machine.transport.base import Framing
from pmac_comp.machine.transport.pair import PairTransport
from pmac_comp.machine.transport.tap import FaultyTransport
from pmac_comp.physics.signals.trajectory import Trajectory
from pmac_comp.simulator.card.card import Card
from pmac_comp.simulator.dialog.sessions import EthernetSession
from pmac_comp.workflow.bench.scales import Scales
from pmac_comp.workflow.motion.motions import Motion
from pmac_comp.workflow.motion.pvt import pvt_program

REQUEST_CYCLES = 2
LIMITS = Limits(
    max_correction_ct=60.0,
    max_slope=0.05,
    max_step_ct=5.0,
    min_position_ct=-300000.0,
    max_position_ct=300000.0,
    um_per_ct=1.0,
    hardest_ct_per_s2=1.2e7,
)


class CycleClock:
    """Time of the card: sleeping runs servo cycles."""

    def __init__(self, card: Card) -> None:
        self.card = card
        self._rest_s = 0.0

    def now_s(self) -> float:
        return self.card.time_s

    def sleep_s(self, duration_s: float) -> None:
        self._rest_s += max(0.0, duration_s)
        cycles = int(self._rest_s / self.card.bench.servo_period_s)
        self._rest_s -= cycles * self.card.bench.servo_period_s
        self.card.run_cycles(cycles)


class CardBench:
    """Card, tap and commander; ``on_request`` is called with the number of each request.

    Its result may be bytes, which are then answered instead of the card's answer; an exception
    it raises ends the conversation there.
    """

    def __init__(self, folder: Path, *, bench: Bench | None = None, card: Card | None = None):
        self.bench = bench or load_bench("paper")
        self.card = card or Card(self.bench)
        self.clock = CycleClock(self.card)
        self.folder = folder
        self.on_request: Callable[[int], None] = lambda _n: None
        self.filter: Callable[[int, bytes], bytes] = lambda _n, data: data
        self.n_requests = 0
        self.connect()

    def connect(self) -> None:
        """A new conversation with the same card; the one before is dropped."""
        self.session = EthernetSession(self.card)
        self.pair = PairTransport(self._peer, self.clock, framing=Framing.PACKETS)
        self.tap = FaultyTransport(self.pair)
        self.on_request = lambda _n: None
        self.filter = lambda _n, data: data
        self.link = Commander(self.tap, clock=self.clock, timeout_s=1.0)
        self.n_requests = 0

    def reconnect(self) -> None:
        self.session.close()
        self.connect()

    def _peer(self, data: bytes) -> bytes:
        if data:
            number = self.n_requests
            self.n_requests += 1
            self.on_request(number)
            self.card.run_cycles(REQUEST_CYCLES)
            data = self.filter(number, data)
        return self.session.receive(data)

    @property
    def context(self) -> Context:
        return Context(LawBlock(), LIMITS, self.folder, self.bench.servo_period_s)

    # The truth, from the card's own memory and not through the wire.

    @property
    def i51(self) -> int:
        return int(self.card.variables.read_i(51))

    def values(self, kind: str, motor: int) -> list[int] | None:
        from pmac_comp.simulator.servo.compensation import TableKind

        return self.card.tables.values(TableKind[kind], motor)

    def p(self, number: int) -> float:
        return float(self.card.variables.read("P", number))

    def side_port(self) -> Callable[[str], bytes]:
        """Another client: a function that sends a line and returns the raw answer."""
        port = self.card.port()
        return lambda text: port.line(text.encode())


def make_plc_bench(folder: Path) -> CardBench:
    """A bench whose motor 1 is in closed loop."""
    bench = CardBench(folder)
    bench.link.command("#1J/")
    bench.clock.sleep_s(0.1)
    return bench


AXIS_LINES = ("&1UNDEFINE ALL", "&1#1->X", "I5113=0", "I5190=1000", "I42=0")


def program_of(path_ct: np.ndarray, bench: Bench, number: int = 710) -> Program:
    """Motion program through positions in counts at every servo cycle, from rest to rest."""
    time_s = np.arange(path_ct.size) * bench.servo_period_s
    position_m = path_ct * Scales.of(bench).motor_m_per_ct
    lines = pvt_program(Motion("path", Trajectory(time_s, position_m)), bench).lines
    return Program(ProgramKind.PROG, number, ("DWELL200", *lines, "DWELL200"))
