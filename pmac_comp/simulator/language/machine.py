"""Runs bytecode against the memory of the card from Python: on-line expressions, programs."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pmac_comp.simulator.language.expressions import Code, Compiled, compiled
from pmac_comp.simulator.memory import vm
from pmac_comp.simulator.memory.errors import CardError
from pmac_comp.simulator.memory.numbers import finite
from pmac_comp.simulator.memory.variables import Variables

LINE_BUDGET = 20_000


@dataclass
class Context:
    """State of one running program."""

    state: NDArray[np.int64] = field(default_factory=lambda: np.zeros(vm.N_STATE, dtype=np.int64))
    stack: NDArray[np.float64] = field(default_factory=lambda: np.zeros(vm.STACK_DEPTH))
    regs: NDArray[np.float64] = field(default_factory=lambda: np.zeros(vm.N_REGS))
    events: NDArray[np.float64] = field(default_factory=lambda: np.zeros(vm.EVENT_WORDS))

    def restart(self) -> None:
        """Go back to the first instruction with an empty stack."""
        self.state[vm.S_PC] = 0
        self.state[vm.S_SP] = 0
        self.state[vm.S_EVENTS] = 0
        self.state[vm.S_JUMPS] = 0
        self.stack[:] = 0.0

    def take_events(self) -> list[tuple[int, tuple[float, ...]]]:
        """Events of the last run, oldest first; the queue is emptied."""
        found: list[tuple[int, tuple[float, ...]]] = []
        position, used = 0, int(self.state[vm.S_EVENTS])
        while position < used:
            number, count = int(self.events[position]), int(self.events[position + 1])
            arguments = tuple(float(v) for v in self.events[position + 2 : position + 2 + count])
            found.append((number, arguments))
            position += 2 + count
        self.state[vm.S_EVENTS] = 0
        return found


class Machine:
    """The compiled interpreter with the memory it works on."""

    def __init__(self, variables: Variables) -> None:
        self.variables = variables
        self._scratch = Context()

    def run(self, program: Compiled, context: Context, budget: int) -> int:
        """Run a program from where its context stands; a status of `vm`."""
        v, m = self.variables, self.variables.memory
        return int(
            vm.run(
                m.x,
                m.y,
                m.dirty,
                v.imap,
                v.iscale,
                program.code,
                program.consts,
                context.stack,
                context.state,
                context.regs,
                context.events,
                budget,
            )
        )

    def evaluate(self, code: Code, cs: int = 1) -> float:
        """Finite value of an expression, Q-variables in the window of coordinate system `cs`."""
        context = self._scratch
        context.restart()
        context.state[vm.S_CS] = cs - 1
        status = self.run(compiled(code), context, LINE_BUDGET)
        if status != vm.FINISHED:
            raise CardError(3, "expression cannot be evaluated")
        return finite(context.stack[0])
