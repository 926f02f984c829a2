"""Queries and assignments of I, P, Q and M variables; M-variable definitions."""

from __future__ import annotations

import re

from pmac_comp.simulator.commands.line import LineContext, command
from pmac_comp.simulator.memory.errors import CardError

_DEFINITION = re.compile(
    r"\*|(?:DP|X|Y|D|L|F)\s*:?\s*(?:\$[0-9A-F]+|\d+)(?:\s*,\s*[0-9]+)*(?:\s*,\s*[USDC](?![A-Z0-9]))?"
)

# What starts like a definition but is none must not be read as a query and a command (M5->Z:1).
_UNSUPPORTED_DEFINITION = re.compile(r"[XY]|TW|(?!J)[A-Z]{1,3}\s*:")


@command("I")
def _i(context: LineContext) -> None:
    variable(context, "I")


@command("P")
def _p(context: LineContext) -> None:
    if _number_follows(context):
        variable(context, "P")
    else:
        context.answer(context.card.status.position(context.modal.motor))


@command("Q")
def _q(context: LineContext) -> None:
    if _number_follows(context):
        variable(context, "Q")
    else:
        context.system.quit()


@command("M")
def _m(context: LineContext) -> None:
    variable(context, "M")


def _number_follows(context: LineContext) -> bool:
    nearby = context.scanner.peek()
    return nearby.isdigit() or (nearby in ("(", "$") and nearby != "")


def variable(context: LineContext, kind: str) -> None:
    """Everything that can follow the letter of a variable."""
    scanner = context.scanner
    ranged = False
    if scanner.peek() == "(":
        scanner.expect("(")
        first = int(context.expression() + 1e-6)
        scanner.expect(")")
        if not 0 <= first <= 8191:
            raise CardError(3)
        numbers = range(first, first + 1)
    else:
        first = scanner.need_integer(0, 8191)
        numbers, ranged = _range(context, first)
    if kind == "M" and scanner.take("->"):
        _define(context, numbers)
    elif scanner.take("="):
        _assign(context, kind, numbers, ranged=ranged)
    else:
        for number in numbers:
            context.answer(context.card.variables.answer(kind, number, context.modal.cs))


def _range(context: LineContext, first: int) -> tuple[range, bool]:
    scanner = context.scanner
    if scanner.take(".."):
        last = scanner.need_integer(first, 8191)
        return range(first, last + 1), True
    if scanner.take(","):
        count = scanner.need_integer(1, 8192)
        step = scanner.need_integer(1, 8191) if scanner.take(",") else 1
        last = first + (count - 1) * step
        if last > 8191:
            raise CardError(3)
        return range(first, last + 1, step), True
    return range(first, first + 1), False


def _assign(context: LineContext, kind: str, numbers: range, *, ranged: bool) -> None:
    scanner, variables = context.scanner, context.card.variables
    if kind == "I" and scanner.take("*"):
        for number in numbers:
            variables.default_i(number)
        return
    if kind == "I" and scanner.take("@"):
        scanner.expect("I")
        value = float(variables.address_of(scanner.need_integer(0, 8191)))
    elif ranged:
        constant = scanner.signed_number()
        if constant is None:
            raise CardError(3)
        value = constant
    else:
        value = context.expression()
    for number in numbers:
        variables.write(kind, number, value, context.modal.cs)
        context.card.variable_written(kind, number)


def _define(context: LineContext, numbers: range) -> None:
    scanner, variables = context.scanner, context.card.variables
    scanner.skip_blanks()
    match = _DEFINITION.match(scanner.text, scanner.position)
    if match is None:
        if _UNSUPPORTED_DEFINITION.match(scanner.rest):
            raise CardError(3, f"definition of M{numbers[0]} not understood at '{scanner.rest}'")
        for number in numbers:
            context.answer(variables.definition(number))
        return
    scanner.position = match.end()
    text = re.sub(r"\s+", "", match.group())
    for number in numbers:
        variables.define_m_text(number, text)
