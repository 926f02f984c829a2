"""``FAULT"..."``: only on a card that was made to take commanded faults."""

from __future__ import annotations

from pmac_comp.simulator.commands.line import LineContext, command
from pmac_comp.simulator.memory.errors import CardError
from pmac_comp.simulator.servo.commanded_faults import command_fault


@command("FAULT")
def _fault(context: LineContext) -> None:
    if not context.card.faults:
        raise CardError(3)
    command_fault(context.card, context.scanner.quoted())
