"""What lines, programs and control characters ask of the card.

A line is executed from left to right; program text goes into the buffer that is open on the port.
What programs ask of the rest of the card comes here too, and so does what they say to people.
Source: Turbo PMAC Software Reference Manual p. 254-263 (control characters), 405-485 (statements).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import TYPE_CHECKING, ClassVar

from pmac_comp.simulator.commands.line import LineContext, Modal, execute_command
from pmac_comp.simulator.language.parser import StatementParser
from pmac_comp.simulator.language.scanner import Scanner
from pmac_comp.simulator.language.statements import MOTION, PLC, Statement
from pmac_comp.simulator.memory import registers as r
from pmac_comp.simulator.memory.errors import CardError
from pmac_comp.simulator.programs.coordinate_system import CoordinateSystem

if TYPE_CHECKING:
    from pmac_comp.simulator.card.card import Card

Listener = Callable[[str, str], None]
_LOCKS = r.INTERNAL_GLOBAL + 0xF4
_LOCK_SHIFT = 4
_MOST_COMMANDS = 256  # that wait for the background; a program that gives more is halted (p. 424)


class Interpreter:
    """Executes lines for all ports and programs of a card.

    Parameters
    ----------
    card : Card
        The card.
    """

    def __init__(self, card: Card) -> None:
        self._card = card
        self._queue: deque[tuple[str, Modal, str]] = deque()
        self.listeners: list[Listener] = []

    @property
    def is_idle(self) -> bool:
        """Whether no command of a program waits."""
        return not self._queue

    def reset(self) -> None:
        """Forget the commands that wait."""
        self._queue.clear()

    def background(self) -> None:
        """Execute the commands that programs have given since the last background cycle."""
        for _ in range(len(self._queue)):
            if not self._queue:  # $$$ has emptied it
                return
            text, modal, port = self._queue.popleft()
            self._execute_queued(text, modal, port)

    def execute_line(self, context: LineContext) -> None:
        """Execute a line: program text into an open buffer, the rest at once."""
        scanner = context.scanner
        first = True
        try:
            while not scanner.at_end:
                if not self._take_program_text(context, starts_line=first):
                    self._take_command(context)
                first = False
        except CardError:
            self._card.rotary.drop_line()
            self._card.programs.drop_line()
            raise
        if self._card.rotary.is_open_on(context.owner):
            self._card.rotary.end_line(context.modal.cs)
        if self._card.programs.is_open_on(context.owner):
            self._card.programs.end_line()

    def _take_program_text(self, context: LineContext, *, starts_line: bool) -> bool:
        rotary = self._card.rotary.is_open_on(context.owner)
        store = self._card.programs
        program = store.open_program if store.is_open_on(context.owner) else None
        if not rotary and program is None:
            return False
        kind = program.kind if program is not None else MOTION
        statement = StatementParser(context.scanner, kind).statement()
        if statement is None:
            return False
        statement.starts_line = starts_line
        if program is not None:
            store.enter(statement)
        else:
            self._card.rotary.enter(context.modal.cs, statement)
        return True

    def _take_command(self, context: LineContext) -> None:
        scanner = context.scanner
        start = scanner.position
        try:
            execute_command(context)
        except CardError as error:
            if error.code == 3 and not self._card.programs.is_open_on(context.owner):
                # A command that read all of it knows the words, and refuses them for what they ask.
                if _program_text(scanner.text[start:]) > scanner.position - start:
                    raise CardError(5) from error
            elif error.code == 5 and self._card.programs.is_open_on(context.owner):
                raise CardError(3) from error
            raise

    def _execute_queued(self, text: str, modal: Modal, port: str) -> None:
        context = LineContext(self._card, modal, Scanner(text), owner=self._card)
        try:
            self.execute_line(context)
        except CardError as error:
            if self._card.variables.int_i(6) != 2:
                self.announce(port, f"\x07ERR{error.code:03d}", commanded=True)
        for line in context.lines:
            self.announce(port, line, commanded=True)

    def announce(self, port: str, text: str, *, commanded: bool = False) -> None:
        """Unsolicited text of a program, or of its command, to a port.

        ``S`` is the main serial port, ``R`` the dual-ported RAM, empty means nowhere.
        """
        if port == "R":
            self._card.dpram_ascii.announce(text, commanded=commanded)
        elif port:
            for listener in self.listeners:
                listener(port, text)

    def do_statement(self, statement: Statement, motor: int, cs: int, *, origin: str) -> None:
        """What programs ask of the rest of the card."""
        kind, data = statement.kind, statement.data
        if kind == "plc":
            verb, numbers = data
            for number in numbers:
                self._card.plcs.switch(verb, number)
        elif kind == "command":
            port, body = data
            if len(body) == 1 and body < " ":
                self.control_character(ord(body))
            elif len(self._queue) >= _MOST_COMMANDS:
                raise CardError(6, f"too many commands in {origin}")
            else:
                self._queue.append((body, Modal(motor, cs), port))
        elif kind == "send":
            port, body = data
            self.announce(port or "S", body)
        elif kind == "gather":
            self._card.gathering.start()
        elif kind == "endgather":
            self._card.gathering.stop()
        elif kind == "lock":
            self.lock(*data)
        else:
            raise CardError(16, f"{kind} in {origin}")

    def lock(self, number: int, variable: int | None) -> None:
        """LOCK{number},P{variable}, which tells whether it was locked before; None: UNLOCK."""
        bit = 1 << (_LOCK_SHIFT + number)
        words, cell = self._card.memory.x, _LOCKS
        if variable is None:
            words[cell] = int(words[cell]) & ~bit
            return
        self._card.variables.write("P", variable, 1.0 if int(words[cell]) & bit else 0.0)
        words[cell] = int(words[cell]) | bit

    def control_character(self, code: int) -> None:
        """Control characters that act on the whole card; others do nothing."""
        act = self._on_control.get(code)
        if act is not None:
            act(self)

    def _abort_all(self) -> None:
        for system in self._card.systems.values():
            system.stop_now()
        for motor in self._card.servo.active_motors():
            self._card.servo.abort(motor)

    def _disable_plcs(self) -> None:
        self._card.plcs.disable_all()

    def _enable_killed(self) -> None:
        for motor in self._card.servo.active_motors():
            if self._card.servo.is_killed(motor):
                self._card.servo.enable(motor)

    def _kill_all(self) -> None:
        for system in self._card.systems.values():
            system.stop_now()
        for motor in self._card.servo.active_motors():
            self._card.servo.kill(motor)

    def _hold_all(self) -> None:
        for system in self._card.systems.values():
            system.hold()

    def _quit_all(self) -> None:
        for system in self._card.systems.values():
            system.quit()

    def _run_all(self, *, single: bool = False) -> None:
        for system in self._card.systems.values():
            self._try_run(system, single=single)

    def _step_all(self) -> None:
        self._run_all(single=True)

    def _try_run(self, system: CoordinateSystem, *, single: bool) -> None:
        if not system.axes and not system.holding:
            return
        with suppress(CardError):  # a control character has no way to answer with an error
            system.run(single=single)

    _on_control: ClassVar[Mapping[int, Callable[[Interpreter], None]]] = {
        0x01: _abort_all,  # ^A
        0x04: _disable_plcs,  # ^D
        0x05: _enable_killed,  # ^E
        0x0B: _kill_all,  # ^K
        0x0F: _hold_all,  # ^O
        0x11: _quit_all,  # ^Q
        0x12: _run_all,  # ^R
        0x13: _step_all,  # ^S
    }


def _program_text(text: str) -> int:
    """Characters of the program statement that a text begins with, 0 if it begins with none."""
    try:
        for kind in (MOTION, PLC):
            scanner = Scanner(text)
            statement = StatementParser(scanner, kind).statement()
            if statement is not None and statement.kind != "assign":
                return scanner.position
    except CardError:
        return 0
    return 0
