"""Encoder channels and conversion table, on hand-made registers."""

import numpy as np
import pytest

from pmac_comp.simulator.memory.registers import ECT_BASE
from pmac_comp.simulator.servo import conversion, encoder

CHANNEL = 0x78000


@pytest.fixture
def spaces():
    return np.zeros(0x80000, np.int32), np.zeros(0x80000, np.int32)


def signed(word):
    return int(word) - 0x1000000 if word >= 0x800000 else int(word)


def run(spaces, lines, times=1):
    x, y = spaces
    y[ECT_BASE : ECT_BASE + len(lines)] = lines
    entries, memory = conversion.new_table()
    n, bad = conversion.decode_table(x, y, entries)
    for _ in range(times):
        conversion.convert(x, y, entries, n, memory)
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
    run(spaces, [0x200100, 0x018000, 0xD03502, 0x7FFFFF, 0x400000], times=40)
    assert signed(x[ECT_BASE + 4]) == pytest.approx(32000, abs=2)


@pytest.mark.parametrize(
    "lines",
    [[0xF78000, 0x500000, 0], [0x200100, 0x000000], [0x200100, 0x019000], [0x200100, 0x001030]],
    ids=["extended 5", "no width", "25 bits", "bit 48"],
)
def test_entries_the_manual_does_not_know_end_the_table_and_say_so(spaces, lines):
    assert run(spaces, [0xC78000, *lines, 0xC78008]) == (1, True)


class Table:
    """A decoded table that lives on from cycle to cycle."""

    def __init__(self, spaces, lines):
        self.x, self.y = spaces
        self.y[ECT_BASE : ECT_BASE + len(lines)] = lines
        self.entries, self.memory = conversion.new_table()
        self.n, bad = conversion.decode_table(self.x, self.y, self.entries)
        assert not bad

    def cycle(self, line):
        conversion.convert(self.x, self.y, self.entries, self.n, self.memory)
        return signed(self.x[ECT_BASE + line])


def test_parallel_word_goes_on_in_the_next_word(spaces):
    # SRM p. 237: beyond bit 23 methods 2 and 3 read the next Y, 6 and 7 the X beside it.
    x, y = spaces
    y[0x100], y[0x101], x[0x100] = 0xABC000, 0x000123, 0x000456
    run(spaces, [0x280100, 0x01800C, 0x680100, 0x01800C, 0x280100, 0x010018])
    assert x[ECT_BASE + 1] == 0x123ABC
    assert x[ECT_BASE + 3] == 0x456ABC
    assert x[ECT_BASE + 5] == 0x000123


def test_time_base_is_twice_the_factor_times_the_change(spaces):
    # SRM p. 240; 512 and 256 counts/ms is the manual's example of a time base at real time.
    x, y = spaces
    table = Table(spaces, [0xC78000, 0x403501, 512])
    per_cycle = 256 * 0.441995
    found = []
    for k in range(1, 2001):
        encoder.latch_channel(x, y, CHANNEL, k * per_cycle, 1)
        found.append(table.cycle(2))
    # At real time the result is I10: 2^23 times the servo period in ms.
    assert np.mean(found[1:]) == pytest.approx(0.441995 * 8388608, rel=1e-4)


def test_integrated_converter_adds_readings_less_bias(spaces):
    # SRM p. 235-236: result bit 5 is one bit of the 16-bit converter, bias in 1/256 of it.
    _, y = spaces
    y[0x100] = 7 << 8
    table = Table(spaces, [0x500100, 5 * 256])
    assert [table.cycle(1) for _ in range(3)] == [64, 128, 192]
    y[0x100] = (-3 & 0xFFFF) << 8
    assert table.cycle(1) == 192 - 8 * 32
    unsigned = Table(spaces, [0x580100, 5 * 256])
    y[0x100] = 3 << 8
    assert unsigned.cycle(1) == 0  # not permitted to be less than zero


def test_parallel_extension_takes_its_fraction_from_the_flags(spaces):
    x, y = spaces
    encoder.latch_channel(x, y, CHANNEL, 100.0, 1)
    x[CHANNEL] |= 0b10110 << 19
    run(spaces, [0x800000 | 0x80000 | CHANNEL])
    assert x[ECT_BASE] == 100 * 32 + 0b10110


def test_triggered_time_base_starts_at_the_captured_position(spaces):
    # SRM p. 240-242: frozen 0, armed 0, then 512 times the factor times the counts.
    x, y = spaces
    table = Table(spaces, [0x900000 | 0x80000 | CHANNEL, 64])
    x[CHANNEL] |= encoder.CAPTURED
    encoder.latch_channel(x, y, CHANNEL, 1000.0, 1)
    assert table.cycle(1) == 0
    assert not x[CHANNEL] & encoder.CAPTURED
    assert x[ECT_BASE] == 1000 * 256 + 128  # undifferentiated, half a count past the edge
    armed = Table(spaces, [0xB00000 | 0x80000 | CHANNEL, 64])
    encoder.latch_channel(x, y, CHANNEL, 1100.0, 1)
    assert armed.cycle(1) == 0
    x[CHANNEL] |= encoder.CAPTURED
    x[CHANNEL + 3] = 1150
    encoder.latch_channel(x, y, CHANNEL, 1160.0, 1)
    assert armed.cycle(1) == 512 * 64 * 10 + 2 * 64 * 128
    assert y[ECT_BASE] >> 20 == 0xA
    encoder.latch_channel(x, y, CHANNEL, 1180.0, 1)
    assert armed.cycle(1) == 512 * 64 * 20


def test_exponential_filter_follows_its_equation(spaces):
    # SRM p. 243, worked by hand for K = 2^22: half of the difference in every cycle.
    x, _ = spaces
    x[0x100] = 1000
    table = Table(spaces, [0xD00100, 400, 1 << 22])
    assert [table.cycle(2) for _ in range(4)] == [200, 500, 750, 875]


def test_tracking_filter_has_no_lag_at_constant_speed(spaces):
    # SRM p. 244: the integrator removes the error of the equation, In(n) - Out(n - 1).
    x, _ = spaces
    plain = Table(spaces, [0xD00100, 4000, 1 << 20])
    lag = []
    for k in range(400):
        x[0x100] = (50 * k) & 0xFFFFFF
        lag.append(50 * k - plain.cycle(2))
    # Time constant 2^23/K - 1 = 7 cycles.
    assert lag[-1] == pytest.approx(7 * 50, abs=1)
    tracking = Table(spaces, [0xD80100, 4000, 1 << 20, 0, 1 << 17])
    error, before = 0, 0
    for k in range(400):
        x[0x100] = (50 * k) & 0xFFFFFF
        error, before = 50 * k - before, tracking.cycle(4)
    assert error == pytest.approx(0, abs=1)


def test_byte_wide_words_are_put_together(spaces):
    # SRM p. 252: 20 bits from bit 3 of the middle bytes of three words.
    x, y = spaces
    value = 0b1010_1100_0011_0101_1001
    for k in range(3):
        y[0x100 + k] = (((value << 3) >> (8 * k)) & 0xFF) << 8
    run(spaces, [0xF80100, 0x214103])
    assert x[ECT_BASE + 1] == (value - (1 << 20)) & 0xFFFFFF  # 20 bits count both ways from zero
    filtered = Table(spaces, [0xF00100, 0x314103, 4])
    assert filtered.cycle(2) == -4 * 32


def test_interpolator_has_4096_states_a_line(spaces):
    x, y = spaces
    table = Table(spaces, [0xFF8000, 0x078005, 0x000000])
    for line in np.linspace(-3.2, 3.2, 129):
        x[CHANNEL + 2] = (int(np.floor(4.0 * line)) << 1) & 0xFFFFFF
        y[CHANNEL + 5] = int(8.0e6 * np.sin(2 * np.pi * line)) & 0xFFFFFF
        y[CHANNEL + 6] = int(8.0e6 * np.cos(2 * np.pi * line)) & 0xFFFFFF
        assert table.cycle(2) == pytest.approx(4096 * line, abs=1.01)


def test_interpolator_diagnostics(spaces):
    _, y = spaces
    magnitude = Table(spaces, [0xF78005, 0x100000, 0, 0, 0])
    y[CHANNEL + 5], y[CHANNEL + 6] = 0x400000, 0x400000
    assert magnitude.cycle(4) == 0x400000  # 0.5 in the range 0 to 2
    bias = Table(spaces, [0xF78005, 0x100001, 0, 0, 0])
    for sine, cosine in ((1000, -500), (-1008, 512)):
        y[CHANNEL + 5] = (sine << 12) & 0xFFFFFF
        y[CHANNEL + 6] = (cosine << 12) & 0xFFFFFF
        found = bias.cycle(4) & 0xFFFFFF
    assert (found >> 12, found & 0xFFF) == (4, -6 & 0xFFF)  # the manual's $004FFA
    assert y[ECT_BASE + 1] == 0x100003


def test_resolver_counts_4096_a_cycle_and_goes_on(spaces):
    _, y = spaces
    for first, sign in ((0xF00200, 1.0), (0xF80200, -1.0)):
        table = Table(spaces, [first, 0x400210, 0])
        for turn in np.linspace(0.0, 2.3, 60):
            y[0x200] = int(8.0e6 * np.sin(2 * np.pi * turn)) & 0xFFFFFF
            y[0x201] = int(8.0e6 * np.cos(2 * np.pi * turn)) & 0xFFFFFF
            found = table.cycle(2)
        assert found / 32 == pytest.approx(sign * 2.3 * 4096, abs=0.1)


def test_zero_line_ends_the_table(spaces):
    assert run(spaces, [0xC78000, 0, 0xC78008]) == (1, False)
