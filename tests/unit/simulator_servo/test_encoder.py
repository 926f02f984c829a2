"""Encoder channels and conversion table, on hand-made registers."""

import numpy as np
import pytest

from pmac_comp.simulator import encoder
from pmac_comp.simulator.registers import ECT_BASE

CHANNEL = 0x78000


@pytest.fixture
def spaces():
    return np.zeros(0x80000, np.int32), np.zeros(0x80000, np.int32)


def signed(word):
    return int(word) - 0x1000000 if word >= 0x800000 else int(word)


def run(spaces, lines, times=1):
    x, y = spaces
    y[ECT_BASE : ECT_BASE + len(lines)] = lines
    entries, memory = encoder.new_table()
    n, bad = encoder.decode_table(x, y, entries)
    for _ in range(times):
        encoder.convert(x, y, entries, n, memory)
    return n, bad


@pytest.mark.parametrize(
    ("position", "counts"), [(0.0, 0), (0.49, 0), (0.51, 1), (-0.49, 0), (-0.51, -1), (1e5, 100000)]
)
def test_counter_changes_half_way_between_marks(spaces, position, counts):
    x, y = spaces
    assert encoder.latch_channel(x, y, CHANNEL, position, 1) == counts
    assert signed(x[CHANNEL + 1]) == counts
    assert encoder.latch_channel(x, y, CHANNEL, -position, -1) == counts


def test_method_c_counts_and_method_0_extends(spaces):
    x, y = spaces
    encoder.latch_channel(x, y, CHANNEL, 1234.25, 1)
    run(spaces, [0xC78000, 0x078000, 0xC80000 | CHANNEL])
    assert x[ECT_BASE] == 1234 * 32
    assert x[ECT_BASE + 1] == 1234 * 32 + 24  # three quarters past the edge at 1233.5
    assert x[ECT_BASE + 2] == x[ECT_BASE + 1]


def test_extension_follows_slow_motion_in_32nds(spaces):
    x, y = spaces
    found = []
    for position in np.arange(-3.0, 3.0, 1 / 64):
        encoder.latch_channel(x, y, CHANNEL, position, 1)
        run(spaces, [0x078000])
        found.append(signed(x[ECT_BASE]))
    steps = np.diff(found)
    assert set(steps.tolist()) == {0, 1}
    assert found[-1] - found[0] == pytest.approx(6 * 32, abs=1)


def test_counter_wraps_without_a_jump(spaces):
    x, y = spaces
    previous = None
    for position in range((1 << 18) - 3, (1 << 18) + 3):
        encoder.latch_channel(x, y, CHANNEL, float(position), 1)
        run(spaces, [0xC78000])
        if previous is not None:
            assert (int(x[ECT_BASE]) - previous) & 0xFFFFFF == 32
        previous = int(x[ECT_BASE])


def test_simulated_axis_of_a_real_backup_turns_output_into_position(spaces):
    # $6800BF,$010020,$EC0009: 16 bits of X:$BF from bit 8, then integrate.
    x, _y = spaces
    x[0xBF] = (-5 & 0xFFFF) << 8
    n, bad = run(spaces, [0x6800BF, 0x010020, 0xEC0001], times=4)
    assert (n, bad) == (2, False)
    assert signed(x[ECT_BASE + 1]) == -5
    assert signed(x[ECT_BASE + 2]) == -20


def test_parallel_filter_limits_the_change(spaces):
    x, y = spaces
    y[0x100] = 100
    run(spaces, [0x300100, 0x018000, 0x000004], times=3)
    assert signed(x[ECT_BASE + 2]) == 12 * 32


def test_sum_and_difference(spaces):
    x, y = spaces
    y[0x100], y[0x101] = 300, 70
    lines = [0x200100, 0x018000, 0x200101, 0x018000, 0xE00301, 0xE20301, 0xE40301]
    run(spaces, lines)
    # Offsets name the lines that hold the results: 1 and 3.
    assert signed(x[ECT_BASE + 4]) == (300 + 70) * 32
    assert signed(x[ECT_BASE + 5]) == (300 - 70) * 32
    assert signed(x[ECT_BASE + 6]) == 300 * 32


def test_exponential_filter_settles(spaces):
    x, y = spaces
    y[0x100] = 1000
    run(spaces, [0x200100, 0x018000, 0xD03502, 0, 0x400000], times=40)
    assert signed(x[ECT_BASE + 4]) == pytest.approx(32000, abs=2)


@pytest.mark.parametrize("line", [0x478000, 0x578000, 0x878000, 0x978000, 0xF78000, 0xD83501])
def test_unknown_methods_end_the_table_and_say_so(spaces, line):
    assert run(spaces, [0xC78000, line, 0xC78008]) == (1, True)


def test_zero_line_ends_the_table(spaces):
    assert run(spaces, [0xC78000, 0, 0xC78008]) == (1, False)
