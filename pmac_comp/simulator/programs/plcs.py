"""PLC programs 0-31: their switches, their scans, what they ask of the rest of the card.

PLC 0 runs inside the servo loop at the real-time interrupt; 1-31 run one scan each per background
cycle. Switches are the bits of Y:$3100+n, so that a host can poll them.
Source: Turbo PMAC Software Reference Manual p. 318-320, 385-393, 427, 509.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from pmac_comp.simulator.language.machine import Context
from pmac_comp.simulator.language.statements import PLC, Statement
from pmac_comp.simulator.memory import registers as r
from pmac_comp.simulator.memory import vm
from pmac_comp.simulator.memory.errors import CardError
from pmac_comp.simulator.programs.programs import PLC_DISABLED, PLC_OPEN, Program

if TYPE_CHECKING:
    from pmac_comp.simulator.card.card import Card

SCAN_BUDGET = 200_000
SCAN_EVENTS = 64  # statements for the rest of the card: a program that enables itself makes no end
EXECUTION_ERROR = 1 << 23


class Plcs:
    """All PLC programs of a card."""

    def __init__(self, card: Card) -> None:
        self.card = card
        self.contexts = [Context() for _ in range(32)]
        self.paused = [False] * 32

    # --- switches -------------------------------------------------------------------------------

    def enabled(self, number: int) -> bool:
        """Whether a PLC may scan (I5 apart)."""
        word = int(self.card.memory.y[r.PLC_TABLE + number])
        return not word & (PLC_DISABLED | PLC_OPEN)

    def switch(self, verb: str, number: int) -> None:
        """ENABLE, DISABLE, PAUSE or RESUME a PLC; without a program nothing happens."""
        program = self.card.programs.plcs.get(number)
        if program is None or program.assembled is None:
            return
        cell = r.PLC_TABLE + number
        words = self.card.memory.y
        if verb == "ENABLE":
            self.contexts[number].restart()
            self.paused[number] = False
            words[cell] = int(words[cell]) & ~PLC_DISABLED
            self.card.memory.x[cell] = int(self.card.memory.x[cell]) & ~EXECUTION_ERROR
        elif verb == "RESUME":
            if self.paused[number]:
                self.paused[number] = False
                words[cell] = int(words[cell]) & ~PLC_DISABLED
        else:
            self.paused[number] = verb == "PAUSE"
            words[cell] = int(words[cell]) | PLC_DISABLED
        self.card.background_needed()

    def disable_all(self) -> None:
        """Control-D."""
        for number in range(32):
            self.switch("DISABLE", number)

    def enable_all(self) -> None:
        """Power-up: every PLC in memory is enabled; I5 decides whether it runs (p. 39)."""
        for number, program in self.card.programs.plcs.items():
            if program.statements:
                self.switch("ENABLE", number)

    def opened(self, number: int) -> None:
        """OPEN PLC: disabled, and forgotten where it stood."""
        self.contexts[number].restart()
        self.reload(number)

    def reload(self, number: int) -> None:
        """A buffer was opened or closed: hand PLC 0 to the servo loop or take it away."""
        self.contexts[number] = Context()
        self.contexts[number].state[vm.S_MOTOR_ADDRESS] = 1
        if number != 0:
            self.contexts[number].state[vm.S_SUSPEND] = 1
            return
        program = self.card.programs.plcs.get(0)
        if program is None or program.assembled is None:
            self.card.servo.set_plc0(None)
        else:
            self.card.servo.set_plc0(program.assembled.compiled, self.contexts[0])

    def next_offset(self, number: int) -> int:
        """Word offset of the line that is executed next."""
        program = self.card.programs.plcs[number]
        if program.assembled is None:
            return 0
        position = int(self.contexts[number].state[vm.S_PC])
        return program.offset_of(program.assembled.statement_at(position))

    # --- scans ----------------------------------------------------------------------------------

    def any_background(self) -> bool:
        """Whether some PLC 1-31 wants to scan."""
        plcs = self.card.programs.plcs
        if not plcs or not self.card.variables.int_i(5) & 2:
            return False
        return any(n and self.enabled(n) for n in plcs)

    def background(self) -> None:
        """One scan of each enabled PLC 1-31."""
        if not self.card.programs.plcs or not self.card.variables.int_i(5) & 2:
            return
        for number in sorted(self.card.programs.plcs):
            program = self.card.programs.plcs[number]
            if number and self.enabled(number) and program.assembled is not None:
                self._scan(number, program)

    def _scan(self, number: int, program: Program) -> None:
        if program.assembled is None:
            return
        context = self.contexts[number]
        budget, events_left = SCAN_BUDGET, SCAN_EVENTS
        while budget > 0:
            status = self.card.machine.run(program.assembled.compiled, context, budget)
            budget -= int(context.state[vm.S_STEPS])
            for index, arguments in context.take_events():
                self._do(program.statements[index], arguments, context, number)
                events_left -= 1
            if status != vm.EVENTS:
                break
            if self.paused[number] or events_left <= 0:
                return
        else:
            status = vm.OUT_OF_BUDGET
        if status == vm.FAULT:
            self._halt(number)

    def _halt(self, number: int) -> None:
        """An error while the program runs ends it."""
        self.card.memory.x[r.PLC_TABLE + number] |= EXECUTION_ERROR
        self.card.memory.y[r.PLC_TABLE + number] |= PLC_DISABLED

    def servo_events(self) -> None:
        """What PLC 0 asked for during the servo loop."""
        program = self.card.programs.plcs.get(0)
        if program is None:
            return
        for index, arguments in self.card.servo.plc0.take_events():
            if index < len(program.statements):
                self._do(program.statements[index], arguments, self.contexts[0], 0)

    def _do(
        self, statement: Statement, arguments: tuple[float, ...], context: Context, number: int
    ) -> None:
        if statement.kind == "address":
            _readdress(context, statement.data, arguments[0])
            return
        motor = max(int(context.state[vm.S_MOTOR_ADDRESS]), 1)
        cs = int(context.state[vm.S_CS]) + 1
        try:
            self.card.interpreter.do_statement(statement, motor, cs, origin=f"{PLC}{number}")
        except CardError:
            self._halt(number)


def _readdress(context: Context, sign: str, value: float) -> None:
    """``ADDRESS#P`` and ``ADDRESS&P``: numbers beyond the last start again at the first."""
    most = r.MOTORS if sign == "#" else r.COORDINATE_SYSTEMS
    number = (math.floor(value + 0.5) - 1) % most
    if sign == "#":
        context.state[vm.S_MOTOR_ADDRESS] = number + 1
    else:
        context.state[vm.S_CS] = number
