"""Operators and functions against the worked examples of the manuals."""

import pytest

from pmac_comp.simulator.language.expressions import Code, ExpressionParser
from pmac_comp.simulator.language.machine import Machine
from pmac_comp.simulator.language.scanner import Scanner
from pmac_comp.simulator.memory.errors import CardError
from pmac_comp.simulator.memory.memory import Memory
from pmac_comp.simulator.memory.variables import Variables


@pytest.fixture(scope="module")
def machine() -> Machine:
    variables = Variables(Memory())
    variables.set_factory_memory()
    return Machine(variables)


def evaluate(machine: Machine, text: str) -> float:
    code = Code()
    scanner = Scanner(text)
    ExpressionParser(scanner).expression(code)
    assert scanner.at_end, scanner.rest
    return machine.evaluate(code)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("11%-4", 3),
        ("-11%-4", -3),
        ("3%-2.5", -2),
        ("-3%-2.5", 2),
        ("7%4", 3),
        ("-1%4", 3),
        ("5%0", 0),
        ("0.5^0.875", 0.375),
        ("3^-3", -2),
        ("$FF&$F0|1", 241),
        ("INT(-2.5)", -3),
        ("1/0", 2.0**47),
        ("-1/0", -(2.0**47)),
        ("2+3*4-6/3", 12),
        ("10-4-3", 3),
        ("LN(-1)", 0),
        ("TAN(90)", 2.0**47),
        ("SIN(30)*2", 1),
        ("ATAN2(1)", 90),
        ("EXP(LN(8)/3)", 2),
        ("I(100+30)", 2000),
        ("-(-2)", 2),
    ],
)
def test_value(machine: Machine, text: str, value: float) -> None:
    assert evaluate(machine, text) == pytest.approx(value, rel=1e-12, abs=1e-12)


def test_atan2_takes_its_cosine_from_q0(machine: Machine) -> None:
    machine.variables.write("Q", 0, -1.0)
    assert evaluate(machine, "ATAN2(0)") == pytest.approx(180)
    machine.variables.write("Q", 0, 0.0)


def test_radians_by_i15(machine: Machine) -> None:
    machine.variables.write_i(15, 1)
    assert evaluate(machine, "COS(0)+ASIN(1)") == pytest.approx(1 + 1.5707963268)
    machine.variables.write_i(15, 0)


def test_store_rounds_to_the_register(machine: Machine) -> None:
    machine.variables.write("P", 1, 1 / 3)
    stored = machine.variables.read("P", 1)
    assert stored != 1 / 3
    assert stored == pytest.approx(1 / 3, rel=2**-34)


@pytest.mark.parametrize(
    "text",
    ["+2", "1+", "(1", "SIN 30", "P8192", "1//2", "", "P(", "(" * 40 + "1" + ")" * 40, "FOO(1)"],
)
def test_syntax_errors_are_err003(machine: Machine, text: str) -> None:
    with pytest.raises(CardError) as refusal:
        evaluate(machine, text)
    assert refusal.value.code == 3


@pytest.mark.parametrize(
    ("condition", "holds"),
    [
        ("(1=1 AND 2>3)", False),
        ("(1=1 OR 2>3 AND 0=1)", True),
        ("(1~1.4)", True),
        ("(1~1.5)", False),
        ("(1!~1.4)", False),
        ("(2!>2)", True),
        ("(2!<3)", False),
        ("(2!=3)", True),
    ],
)
def test_condition(machine: Machine, condition: str, *, holds: bool) -> None:
    code = Code()
    ExpressionParser(Scanner(condition)).condition(code)
    assert machine.evaluate(code) == float(holds)
