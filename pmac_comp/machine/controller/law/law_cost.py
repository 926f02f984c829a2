"""What one pass of PLC 0 or of the open servo costs the card, counted over its own statements."""

from collections.abc import Collection, Container, Sequence
from typing import Final

from pmac_comp.base.errors import InternalError
from pmac_comp.files.resources import firmware_path
from pmac_comp.machine.controller.contents.law_bank import LawBlock
from pmac_comp.machine.controller.law.law_goal import law_program

_INTERPRETED_us: Final = 3.0  # an operation at 80 MHz (User Manual)
_COMPILED_us: Final = 1.0  # in floating point, in which the open servo is written
_OF_MHz: Final = 80.0

# What a law may lack, and the test by which a pass then leaves it out.
_PARTS = {
    "friction_per_turn": "IF(P7188>2)",
    "wobble": "IF(P7178<0)",
    "cogging": "IF(P7183!=0)",
    "place": "IF(P7147!=0)",
    "gap": "IF(P7186>0)",
    "uneven": "IF(P7165!=0)",
    "ripple": "IF(P7136!=0)",
    "bed": "IF(P7140>0)",
    "stribeck": "IF(P7146>0)",
    "drag": "IF(P7140<0)",
}


def operation_count(lacks: Collection[str] = ()) -> int:
    """Interpreted operations of one pass of PLC 0: operators, functions, stores and tests.

    Counted over the statements of an ordinary pass (loop closed, bank unchanged, gain settled), in
    motion or at rest, whichever takes more, of a law that lacks some of: friction by the turn
    (``friction_per_turn``) or, in its place, a wave against the wobble of the lead (``wobble``),
    ``cogging``, a load by place (``place``), the gap of a nut (``gap``), friction that differs by
    direction (``uneven``), torque that ripples in proportion (``ripple``), a bed that swings
    (``bed``) or, in its place, what drags over millimetres (``drag``), Stribeck friction
    (``stribeck``).
    """
    skipped = {*_SKIPPED, *(_PARTS[part] for part in lacks)}
    if "drag" not in lacks:
        skipped.discard(_PARTS["place"])  # within that
    skipped |= {test for test, parts in _SHARED.items() if set(lacks) >= parts}
    if "gap" not in lacks:
        skipped.add(_WITHOUT_GAP)
    if "ripple" in lacks or not set(lacks) >= _SHARED["IF(P7153>1)"]:
        skipped.add(_RIPPLES_ALONE)
    lines = law_program(LawBlock(), 1).lines
    _require_tests(lines, _TESTS)
    passes = (_pass(lines, skipped | {_RESTS}), _pass(lines, skipped | {_BEGINS_TO_REST}))
    return max(sum(_operations(line) for line in one) for one in passes)


_RESTS, _BEGINS_TO_REST = "IF(ABS(P7115)!>P7156)", "IF(P7127<200)"
_SHARED = {  # tests of several parts
    "IF(P7153>1)": {"place", "bed", "drag"},
    "IF(P7188>0)": {"friction_per_turn", "wobble", "cogging", "uneven"},
    "IF(P7188>1)": {"friction_per_turn", "wobble"},
}
_WITHOUT_GAP = "IF(P7186=0)"  # within that of several by the turn
_RIPPLES_ALONE = "IF(P7153=1)"
_SKIPPED = (
    "IF(M7003=1)",
    "IF(M7000-P7100!=P7154)",
    "IF(P7120!=P7001)",
    "IF(P7127>0)",
    "IF(ABS(P7118)>P7174)",
    "IF(ABS(P7131+P7121)>P7122)",
    "IF(ABS(P7122)>P7004)",
    "IF(ABS(P7124)>P7181)",
    "IF(P7005!<0)",
    "IF(P7003!=P7002)",
    "IF(P7108>0)",
)
_TESTS = {*_SKIPPED, *_PARTS.values(), *_SHARED, _WITHOUT_GAP, _RIPPLES_ALONE}
_TESTS |= {_RESTS, _BEGINS_TO_REST}


def _require_tests(lines: Sequence[str], tests: Collection[str]) -> None:
    """Raise InternalError where a program lacks a test by which statements are left out."""
    missing = sorted(set(tests).difference(lines))
    if missing:
        raise InternalError(
            f"The law's program has no {', '.join(missing)}: what it costs would be counted wrong.",
            code="PC-BUG-002",
            hint="The tests named in law_cost are those of the program in firmware_plc.",
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
    return _INTERPRETED_us * _OF_MHz * operation_count(lacks)


# The open servo: the same law, its bank read in place --------------------------------------------

_SERVO_LAW = "IF(MTRNUM=P7007)"
_SERVO_PARTS = {
    "gap": "IF(P(P7144+26)>0)",
    "uneven": "IF(P(P7144+5)!=0)",
    "ripple": "IF(P7160!=0)",
    "wobble": "IF(P(P7144+18)<0)",
    "bed": "IF(P(P7126)>0)",
    "stribeck": "IF(P(P7126+6)>0)",
}
_SERVO_OF_BED = {"bed", "drag"}  # they share a test:
_SERVO_PLACE_OF_BED = "IF(P(P7126)!=0)"
_SERVO_WITHOUT_GAP = "IF(P(P7144+26)=0)"
_SERVO_SKIPPED = (
    "IF(F2=0 OR P7142>16 OR P7142=0)",
    "IF(P7143!=P7001+1)",
    "IF(P7005>0)",
    "IF(P7005=0)",
    "IF(P7003<P7002)",
    "IF(P7003>P7002)",
    "IF(ABS(P7153)>P7114)",
    "IF(ABS(P7152)*P7163<6)",
    "IF(P7120>99 AND P7119>0)",
    "IF(ABS(P7154)>2*P(P7144+14))",
    "IF(P7154>P(P7144+14))",
    "IF(P7154<0-P(P7144+14))",
    "IF(P7003=0)",
    "IF(P7127>P7152+P7119)",
    "IF(P7127<P7152-P7119)",
    "IF(P7150<P(P7144+17))",
    "IF(P7162>P7004)",
    "IF(P7162<0-P7004)",
    "IF(P7156>P(P7144+21))",
    "IF(P7156<0-P(P7144+21))",
)
_SERVO_TESTS = {
    *_SERVO_SKIPPED,
    *_SERVO_PARTS.values(),
    _SERVO_PLACE_OF_BED,
    _SERVO_WITHOUT_GAP,
}


def servo_operation_count(lacks: Collection[str] = ()) -> int:
    """Compiled operations that the law takes of the open servo in a servo cycle.

    Counted as in ``operation_count``, over what the motor of the law takes more than another one:
    the loop's own terms are the same for all. More than in PLC 0, which copies its bank, for the
    addresses of the bank are computed. Friction by the turn, cogging and a load by place are
    computed here in any case; leaving them out saves nothing.
    """
    skipped = {*_SERVO_SKIPPED, *(_SERVO_PARTS[k] for k in lacks if k in _SERVO_PARTS)}
    if set(lacks) >= _SERVO_OF_BED:
        skipped.add(_SERVO_PLACE_OF_BED)
    if "gap" not in lacks:
        skipped.add(_SERVO_WITHOUT_GAP)
    lines = _servo_lines()
    _require_tests(lines, _SERVO_TESTS)
    first = lines.index(_SERVO_LAW)
    return sum(_operations(line) for line in _pass(lines[first : _servo_end(lines)], skipped))


def _servo_lines() -> list[str]:
    text = firmware_path("feedforward_servo.txt").read_text(encoding="utf-8")
    return [line for raw in text.splitlines() if (line := raw.partition(";")[0].strip())]


def _servo_end(lines: Sequence[str]) -> int:
    """Line behind the law: the one that tells the next cycle that the loop is closed."""
    return lines.index("F2=1")


def servo_cost_cycles(lacks: Collection[str] = ()) -> float:
    """CPU cycles that the law takes of the open servo: an operation takes about 1 us at 80 MHz."""
    return _COMPILED_us * _OF_MHz * servo_operation_count(lacks)
