"""The simulated card from the workflow's side: in this process, or served to others.

What lives here: the clock that lets simulated time pass while the host waits, and the option
handling of ``sim``. What may not: anything of the card itself.
"""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.files.capture import Capture
from pmac_comp.files.resources import firmware_path
from pmac_comp.machine.client.commander import Commander
from pmac_comp.machine.controller.contents import servo_source
from pmac_comp.machine.controller.contents.law_bank import LawBlock
from pmac_comp.machine.transport.pair import PairTransport
from pmac_comp.machine.transport.url import Endpoint

if TYPE_CHECKING:
    from pmac_comp.simulator.card.card import Card
    from pmac_comp.simulator.serving.pace import HostPace

_LOOK_s = 2e-4
_WARM_UP_s = 0.05
_REQUEST_CYCLES = 2  # servo cycles that a request takes: the host is never infinitely fast


class CardClock:
    """Clock of an embedded card: waiting runs its servo cycles, nothing else moves time."""

    def __init__(self, card: "Card") -> None:
        self._card = card
        self._left_s = 0.0

    def now_s(self) -> float:
        """Simulated time in s."""
        return self._card.time_s

    def sleep_s(self, duration_s: float) -> None:
        """Let simulated time pass; fractions of a servo period are kept for the next wait."""
        self._left_s += max(0.0, duration_s)
        cycles = int(self._left_s / self._card.bench.servo_period_s)
        self._left_s -= cycles * self._card.bench.servo_period_s
        if cycles:
            self._card.run_cycles(cycles)


class ServedClock:
    """Clock of a card that another thread of this process serves: waiting grants it servo cycles.

    The card never runs ahead of its host, so a busy machine or a slow plant stretches the run but
    loses no sample. Looking at the clock grants a cycle too: a poll without a wait still ends.
    """

    def __init__(self, card: "Card", pace: "HostPace") -> None:
        self._card = card
        self._pace = pace

    def now_s(self) -> float:
        """Simulated time in s."""
        self._pace.grant(1)
        return self._card.time_s

    def sleep_s(self, duration_s: float) -> None:
        """Wait until simulated time has passed."""
        cycles = math.ceil(max(0.0, duration_s) / self._card.bench.servo_period_s)
        until = self._card.cycles + cycles
        self._pace.grant(cycles)
        while self._card.cycles < until:
            time.sleep(_LOOK_s)


def make_card(
    bench: Bench,
    *,
    plant: str | None = None,
    servo: Path | None = None,
    dpram: str | None = None,
    flash: Path | None = None,
    faults: bool = False,
) -> "Card":
    """Card with the drive of a plant file, or the bench's own."""
    from pmac_comp.simulator.card.card import Card
    from pmac_comp.simulator.plant.door import load_plant

    return Card(
        bench,
        plant=None if plant is None else load_plant(plant, bench),
        servo_source=None if servo is None else _servo_text(servo, bench),
        dpram=dpram,
        flash=flash,
        faults=faults,
    )


def _servo_text(servo: Path, bench: Bench) -> str:
    """Source of an open servo; that of this installation for the block of a bench file."""
    from pmac_comp.simulator.servo.open_servo import read_open_servo

    text = read_open_servo(servo)
    if not servo_source.is_as_it_comes(text):
        return text
    return servo_source.servo_for(text, LawBlock.from_p_block(bench.controller.p_block))


@contextmanager
def embedded(card: "Card") -> Iterator[Commander]:
    """Conversation with a card in this process over its packet port, in simulated time."""
    from pmac_comp.simulator.dialog.sessions import EthernetSession

    session = EthernetSession(card)

    def peer(data: bytes) -> bytes:
        if data:
            card.run_cycles(_REQUEST_CYCLES)
        return session.receive(data)

    clock = CardClock(card)
    try:
        with Commander(PairTransport(peer, clock), clock=clock) as link:
            yield link
    finally:
        session.close()


@contextmanager
def open_embedded(bench: Bench, endpoint: Endpoint) -> Iterator[Commander]:
    """Conversation with a fresh card of a bench, set up as the bench file says."""
    del endpoint
    with embedded(make_card(bench)) as link:
        yield link


def warm_up(bench: Bench, plant: str | None = None) -> None:
    """Compile what a card needs to run programs, before anybody waits for its answers."""
    programs = [f"OPEN PLC {n} CLEAR P{n}=P{n}+1 CLOSE" for n in (0, 2)]
    with embedded(make_card(bench, plant=plant)) as link:
        link.write_buffer(["I5=3", *programs, "ENABLE PLC 0", "ENABLE PLC 2"])
        link.clock.sleep_s(_WARM_UP_s)


def default_servo() -> Path:
    """Source of the open servo that comes with the installation."""
    return firmware_path("feedforward_servo.txt")


def serve_forever(
    *,
    tcp: int | None,
    udp: int | None,
    ascii_port: int | None,
    pty: bool,
    host: str,
    bench: str,
    plant: str | None,
    servo: Path | None,
    speed: str,
    dpram: str | None,
    flash: Path | None,
    force: Path | None,
    faults: bool,
    starting: Callable[[], None],
    ready: Callable[[dict[str, Any]], None],
) -> None:
    """Serve a card until it is stopped.

    ``starting`` is called when all options were found good, before anything is compiled, ``ready``
    with the endpoints once all of them listen.
    """
    from pmac_comp.simulator.serving.server import ServeOptions, check_options, serve

    if tcp is None and udp is None and ascii_port is None and not pty:
        tcp = 1025
    loaded = load_bench(bench)
    options = ServeOptions(
        tcp=tcp, udp=udp, ascii_port=ascii_port, pty=pty, host=host, speed=speed, force=force
    )
    check_options(options)
    _check_files(loaded, plant, servo, flash)
    starting()
    warm_up(loaded, plant)
    card = make_card(loaded, plant=plant, servo=servo, dpram=dpram, flash=flash, faults=faults)
    serve(card, options, ready=ready)


def _check_files(bench: Bench, plant: str | None, servo: Path | None, flash: Path | None) -> None:
    """Refuse files that the card cannot start with, as far as it is quickly seen."""
    from pmac_comp.simulator.memory.flash import check_image
    from pmac_comp.simulator.plant.door import check_plant
    from pmac_comp.simulator.servo.open_servo import translate_open_servo

    if plant is not None:
        check_plant(plant)
    if servo is not None:
        translate_open_servo(_servo_text(servo, bench), name=servo.name)
    if flash is not None:
        check_image(flash)


@dataclass(frozen=True)
class Truth:
    """Unquantised positions of the plant of an embedded or served card, by servo cycle."""

    motor_position_m: FloatArray
    table_position_m: FloatArray
    first_cycle: int

    def of(self, capture: Capture) -> tuple[FloatArray, FloatArray] | None:
        """True motor and table position in m at the samples of a capture, None if not recorded."""
        start = int(capture.attributes.get("first_servo_cycle", -1)) - self.first_cycle
        stop = start + capture.n
        if start < 0 or stop > self.motor_position_m.size:
            return None
        return self.motor_position_m[start:stop], self.table_position_m[start:stop]


class TruthRecorder:
    """Records what the plant behind a card really does, for simulated cards only.

    Parameters
    ----------
    card : Card
        A card that has not run yet.
    longest_s : float
        Simulated time that the ring holds.
    """

    def __init__(self, card: "Card", longest_s: float = 600.0) -> None:
        self._plant: Any = card.servo.plant
        cycles = int(longest_s / card.bench.servo_period_s)
        self._record = getattr(self._plant, "record", None)
        if callable(self._record):
            self._record(cycles)

    def truth(self) -> Truth | None:
        """What was recorded; None if the plant does not record."""
        if not callable(self._record):
            return None
        found: Any = cast(Any, self._plant).recorded()
        if found["cycle"].size == 0:
            return None
        return Truth(
            found["motor_position_m"],
            found["table_position_m"],
            int(found["cycle"][0]),
        )

    def notes(self) -> tuple[str, ...]:
        """What the plant holds that the bench file does not say, as far as it tells."""
        effects = getattr(self._plant, "effects", None)
        if not effects:
            return ()
        return tuple(
            f"{name}: " + ", ".join(f"{key} {value}" for key, value in values.items())
            for name, values in effects.items()
        )
