"""What one pass of PLC 0 costs the card, counted over its own statements."""

from collections.abc import Container, Sequence

from pmac_comp.machine.controller.law_bank import LawBlock
from pmac_comp.machine.controller.law_install import law_program


def operation_count(
    lines: Sequence[str] | None = None,
    *,
    per_turn: bool = True,
    gap: bool = True,
    bed: bool = True,
    stribeck: bool = True,
) -> int:
    """Interpreted operations of one pass of PLC 0: operators, functions, stores and tests.

    Counted over the statements of an ordinary pass (loop closed, bank unchanged, gain settled) of
    a law with or without torque per turn, the gap of a nut, a bed that swings,
    Stribeck friction.
    """
    body = lines if lines is not None else law_program(LawBlock(), 1).lines
    skipped = set(_SKIPPED)
    skipped |= set() if gap else {"IF(P7186>0)"}
    skipped |= set() if bed else {"IF(P7140>0)"}
    skipped |= set() if stribeck else {"IF(P7146>0)"}
    skipped |= set() if per_turn else {"IF(P7188>0)"}
    return sum(_operations(line) for line in _pass(body, skipped))


_SKIPPED = (
    "IF(M7003=1 OR M7004=0)",
    "IF(P7112>16)",
    "IF(P7120!=P7001)",
    "IF(P7115=0)",
    "IF(P7127>0)",
    "IF(ABS(P7118)>P7174)",
    "IF(ABS(P7131-P7121)>P7147)",
    "IF(ABS(P7122)>P7004)",
    "IF(ABS(P7124)>P7181)",
    "IF(P7005!<0)",
    "IF(P7003=0)",
    "IF(P7003!=P7002)",
    "IF(P7108>0)",
)


def _pass(lines: Sequence[str], skipped_tests: Container[str]) -> list[str]:
    """Statements of ``feedforward_law.plc0`` that run when these tests fail and all others hold."""
    kept: list[str] = []
    live = [True]
    for line in lines:
        if line.startswith("IF("):
            if live[-1]:
                kept.append(line)
            live.append(live[-1] and line not in skipped_tests)
        elif line == "ELSE":
            live[-1] = live[-2] and not live[-1]
        elif line == "ENDIF":
            live.pop()
        elif live[-1]:
            kept.append(line)
    return kept


def _operations(line: str) -> int:
    functions = line.count("ABS(") + line.count("SIN(")
    operators = sum(line.count(c) for c in "+-*/%<>")
    return operators + functions + line.count("=") + line.count("AND") + line.count("OR")


def law_cost_us(
    cpu_clock_MHz: float,
    *,
    per_turn: bool = True,
    gap: bool = True,
    bed: bool = True,
    stribeck: bool = True,
) -> float:
    """CPU time of one pass of PLC 0 in us: about 3 us per operation at 80 MHz (User Manual)."""
    n = operation_count(per_turn=per_turn, gap=gap, bed=bed, stribeck=stribeck)
    return 3.0 * 80.0 / cpu_clock_MHz * n
