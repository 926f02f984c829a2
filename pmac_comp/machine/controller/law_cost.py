"""What one pass of PLC 0 costs the card, counted over its own statements."""

from collections.abc import Collection, Container, Sequence

from pmac_comp.machine.controller.law_bank import LawBlock
from pmac_comp.machine.controller.law_install import law_program

# What a law may lack, and the test by which a pass then leaves it out.
_PARTS = {
    "friction_per_turn": "IF(P7178!=0)",
    "cogging": "IF(P7183!=0)",
    "place": "IF(P7147!=0)",
    "gap": "IF(P7186>0)",
    "bed": "IF(P7140>0)",
    "stribeck": "IF(P7146>0)",
}


def operation_count(lacks: Collection[str] = ()) -> int:
    """Interpreted operations of one pass of PLC 0: operators, functions, stores and tests.

    Counted over the statements of an ordinary pass (loop closed, bank unchanged, gain settled) of
    a law that lacks some of: friction by the turn (``friction_per_turn``), ``cogging``, a load by
    place (``place``), the gap of a nut (``gap``), a bed that swings (``bed``), Stribeck friction
    (``stribeck``).
    """
    skipped = {*_SKIPPED, *(_PARTS[part] for part in lacks)}
    if set(lacks) >= _BY_TURN:
        skipped.add("IF(P7188>0)")
    return sum(_operations(line) for line in _pass(law_program(LawBlock(), 1).lines, skipped))


_BY_TURN = {"friction_per_turn", "cogging"}  # without both a pass leaves out what they share
_SKIPPED = (
    "IF(M7003=1)",
    "IF(M7000-P7100!=P7154)",
    "IF(P7120!=P7001)",
    "IF(ABS(P7115)!>P7156)",
    "IF(P7127>0)",
    "IF(ABS(P7118)>P7174)",
    "IF(ABS(P7131+P7121)>P7148)",
    "IF(ABS(P7122)>P7004)",
    "IF(ABS(P7124)>P7181)",
    "IF(P7005!<0)",
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


def law_cost_cycles(lacks: Collection[str] = ()) -> float:
    """CPU cycles of one pass of PLC 0: an operation takes about 3 us at 80 MHz (User Manual).

    ``lacks`` as in ``operation_count``.
    """
    return 3.0 * 80.0 * operation_count(lacks)
