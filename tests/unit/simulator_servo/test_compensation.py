"""Compensation tables: definition, order rules, listing, look-up."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pmac_comp.simulator.memory import registers as reg
from pmac_comp.simulator.memory.memory import Memory
from pmac_comp.simulator.memory.user_memory import lowest_defined
from pmac_comp.simulator.servo import compensation as comp
from pmac_comp.simulator.servo.compensation import CompensationTables, TableKind

COMP, TCOMP, BLCOMP = TableKind.COMP, TableKind.TCOMP, TableKind.BLCOMP


@pytest.fixture
def memory():
    made = Memory()
    made.x[reg.MEMORY_END] = reg.USER_BUFFER_END_STANDARD
    made.y[reg.PROGRAM_END] = reg.USER_BUFFER_START
    return made


@pytest.fixture
def tables(memory):
    return CompensationTables(memory)


def fill(tables, values):
    for value in values:
        assert tables.wants_values()
        assert tables.store(value) == 0


def decoded(memory):
    rows = comp.empty_tables()
    n = comp.decode_tables(memory.x, memory.y, rows)
    return rows[:n]


# Forms of the manual's page and what LIST COMP DEF prints for them, addressed motor 1.
@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("100,100000", "100,#1,#1,100000"),
        ("100,#2,100000", "100,#2,#1,100000"),
        ("100,#2,#3,100000", "100,#2,#3,100000"),
        ("100, #2D, #3, 100000", "100,#2D,#3,100000"),
        ("10.20,#4,50000,100000", "10,20,#4,#1,#1,50000,100000"),
        ("10.20,#4,#5,50000,100000", "10,20,#4,#5,#1,50000,100000"),
        ("10.20,#4D,#5D,#6,50000,100000", "10,20,#4D,#5D,#6,50000,100000"),
    ],
)
def test_definitions_are_listed_with_all_defaults(tables, text, line):
    assert tables.define(COMP, 1, text) == 0
    assert tables.list_definition(COMP, 1) == line


@pytest.mark.parametrize(
    "text",
    ["", "100", "0,100", "100,0", "100,#33,1000", "100,#0,1000", "100,#1,#2,#3,1000", "x,1000",
     "100,#1,#2D,1000", "-5,1000", "10.0,#1,100,100", "10.20,100,100", "10.20,#1,100"],
)  # fmt: skip
def test_malformed_definitions_are_refused(tables, text):
    assert tables.define(COMP, 1, text) == 3
    assert tables.list_definition(COMP, 1) is None


def test_torque_and_backlash_tables_have_no_cross_axis_form(tables):
    assert tables.define(BLCOMP, 1, "10,#2,1000") == 3
    assert tables.define(TCOMP, 1, "10,#2,1000") == 3
    assert tables.define(TCOMP, 1, "10,1000") == 0
    assert tables.list_definition(TCOMP, 1) == "10,1000"


def test_values_fill_in_order_and_then_go_elsewhere(tables):
    tables.define(COMP, 1, "15,15000")
    fill(tables, range(-7, 8))
    assert not tables.wants_values()
    assert tables.store(1.0) == 3
    lines = tables.list_values(COMP, 1)
    assert lines == ["-7 -6 -5 -4 -3 -2 -1 0 1 2 3 4", "5 6 7"]


def test_entries_beyond_24_bits_are_refused(tables):
    tables.define(COMP, 1, "2,100")
    assert tables.store(8388608) == 3
    assert tables.store(8388607) == 0
    assert tables.store(-8388607) == 0
    assert tables.values(COMP, 1) == [8388607, -8388607]


def test_order_of_definition_and_deletion(tables):
    assert tables.define(COMP, 3, "2,100") == 0
    assert tables.define(COMP, 4, "2,100") == 3  # a lower motor has one
    assert tables.define(COMP, 1, "2,100") == 0
    assert tables.define(TCOMP, 2, "2,100") == 0
    assert tables.define(COMP, 1, "2,100") == 3
    assert tables.define(BLCOMP, 5, "2,100") == 0
    assert tables.define(TCOMP, 1, "2,100") == 3
    assert tables.delete(TCOMP, 2) == 3
    assert tables.delete(BLCOMP, 5) == 0
    assert tables.delete(COMP, 1) == 3
    assert tables.delete(TCOMP, 2) == 0
    assert tables.delete(COMP, 3) == 3
    assert tables.delete(COMP, 1) == 0
    assert tables.delete(COMP, 3) == 0
    assert [tables.exists(kind, m) for kind in TableKind for m in range(1, 33)] == [False] * 96


@pytest.mark.parametrize("pointer", [0x3120, 0x3121, 0x3141, 0x3151])
def test_later_buffers_block_tables(tables, memory, pointer):
    memory.x[pointer] = 0x10000
    assert tables.define(COMP, 1, "2,100") == 3
    assert tables.delete(COMP, 1) == (0 if pointer == 0x3121 else 3)


def test_memory_is_allocated_downward_without_holes(tables, memory):
    tables.define(COMP, 2, "10,100")
    tables.define(COMP, 1, "20,100")
    end = reg.USER_BUFFER_END_STANDARD
    second, first = (int(memory.x[reg.COMP_POINTERS + i]) for i in (1, 0))
    assert second == end - (comp.HEADER + 11)
    assert first == second - (comp.HEADER + 21)
    assert lowest_defined(memory) == first
    memory.y[reg.PROGRAM_END] = first - 10
    assert tables.define(TCOMP, 1, "20,100") == 6


def test_definition_survives_as_memory_words(tables, memory):
    tables.define(COMP, 1, "3,#2D,#4,3000")
    fill(tables, [16, -32, 48])
    copy = Memory()
    copy.x[:] = memory.x
    copy.y[:] = memory.y
    again = CompensationTables(copy)
    again.reloaded()
    assert again.list_definition(COMP, 1) == "3,#2D,#4,3000"
    assert again.values(COMP, 1) == [16, -32, 48]


def test_lookup_is_linear_and_rolls_over(tables, memory):
    tables.define(COMP, 1, "4,4000")
    fill(tables, [10, 20, -30, 40])
    row = decoded(memory)[0]
    cases = {0: 0, 500: 5, 1000: 10, 1500: 15, 2500: -5, 3500: 5, 3999: 39.93, 4500: 5}
    for position, value in cases.items():
        assert comp.look_up(memory.y, row, position, 0.0) == pytest.approx(value)
    # Negative travel uses the end of the table (User Manual p. 80).
    assert comp.look_up(memory.y, row, -1000.0, 0.0) == pytest.approx(-30)
    assert comp.look_up(memory.y, row, -500.0, 0.0) == pytest.approx(5)


@pytest.mark.parametrize(("i30", "at_zero"), [(0, 0.0), (1, 40.0)])
def test_i30_counts_while_values_are_loaded(tables, memory, i30, at_zero):
    memory.x[reg.INTERNAL_GLOBAL + 30] = i30
    tables.define(COMP, 1, "4,4000")
    fill(tables, [10, 20, -30, 40])
    memory.x[reg.INTERNAL_GLOBAL + 30] = 1 - i30
    assert comp.look_up(memory.y, decoded(memory)[0], 0.0, 0.0) == at_zero


@given(st.integers(-100_000, 100_000), st.integers(-100_000, 100_000))
def test_two_dimensional_lookup_is_bilinear(first, second):
    memory = Memory()
    memory.x[reg.MEMORY_END] = reg.USER_BUFFER_END_STANDARD
    tables = CompensationTables(memory)
    rows, columns = 3, 2
    assert tables.define(COMP, 1, f"{rows}.{columns},#1,#2,#1,2000,6000") == 0
    # Row 0 columns 1..c, then every row from column 0; a plane bends nowhere.
    grid = np.array([[50 * c + 7 * r for c in range(columns + 1)] for r in range(rows + 1)])
    fill(tables, grid.ravel()[1:])
    row = decoded(memory)[0]
    value = comp.look_up(memory.y, row, first, second)
    u, v = (first % 2000) / 1000, (second % 6000) / 2000
    assert value == pytest.approx(50 * u + 7 * v, abs=1e-6)


def test_unfilled_and_overwritten_tables_do_not_lead_outside(tables, memory):
    tables.define(COMP, 1, "4,4000")
    start = int(memory.x[reg.COMP_POINTERS])
    memory.x[start + 1] = 0xFFFFFF
    assert len(decoded(memory)) == 0
