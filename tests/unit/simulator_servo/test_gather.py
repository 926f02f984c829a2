"""Gather engine: layouts and pointers of RAM buffer and dual-ported RAM ring."""

import itertools

import pytest

from pmac_comp.simulator.memory import registers as reg

COUNTER, POSITION, OUTPUT = 0x400000, 0x80008B, 0x4000BF


def prepare(servo, sources, *, mode=0, period=1):
    servo.variables.write_i(5000, mode)
    servo.variables.write_i(5049, period)
    for k, source in enumerate(sources):
        servo.variables.write_i(5001 + k, source)
    servo.variables.write_i(5050, (1 << len(sources)) - 1)
    servo.variables.write_i(5051, 0)


def signed24(word):
    return word - 0x1000000 if word & 0x800000 else word


def ram_words(servo):
    """The stream of 24-bit words that a client makes of LIST GATHER."""
    text = " ".join(servo.gathering.list_lines())
    return [int(part, 16) for item in text.split() for part in (item[6:], item[:6])]


def test_ram_layout_with_an_odd_set_is_filled_up(enabled):
    prepare(enabled, [POSITION, COUNTER])
    assert enabled.gathering.define(400) == 0
    start = int(enabled.memory.x[0x3120])
    assert start == reg.USER_BUFFER_END_STANDARD - 400
    enabled.gathering.start()
    enabled.jog_to(1, "=", 3000.0)
    enabled.run(120)
    enabled.gathering.stop()
    enabled.run(10)
    assert int(enabled.memory.y[0x3120]) == start + 2 * 120
    words = ram_words(enabled)
    samples = [words[i : i + 4] for i in range(0, len(words), 4)]
    assert len(samples) == 120
    counters = [s[2] for s in samples]
    assert counters == list(range(counters[0], counters[0] + 120))
    assert {s[3] for s in samples} == {0}
    positions = [signed24(s[1]) * 2**24 + s[0] for s in samples]
    assert positions[0] < positions[-1]


def test_period_and_stop_when_full(enabled):
    prepare(enabled, [COUNTER], period=3)
    enabled.gathering.define(10)
    enabled.gathering.start()
    enabled.run(27)
    assert enabled.gathering.running
    enabled.run(40)
    assert not enabled.gathering.running
    counters = ram_words(enabled)[0::2]
    assert len(counters) == 10
    assert {b - a for a, b in itertools.pairwise(counters)} == {3}


def test_wrapping_buffer_keeps_the_latest(enabled):
    prepare(enabled, [COUNTER], mode=1)
    enabled.gathering.define(16)
    enabled.gathering.start()
    enabled.run(40)
    enabled.gathering.stop()
    first = int(enabled.memory.x[0x3120])
    values = [int(enabled.memory.y[first + k]) for k in range(16)]
    last = int(enabled.memory.x[0])
    assert sorted(values) == list(range(last - 16, last))
    assert int(enabled.memory.y[0x3120]) - first == 40 % 16


def test_dpram_ring_has_sign_extended_cells_and_a_moving_pointer(enabled):
    prepare(enabled, [OUTPUT, POSITION, COUNTER], mode=3)
    enabled.memory.x[reg.motor_base(1) + reg.M_COMMAND] = 0
    assert enabled.gathering.define(30) == 0  # 4 cells a sample: rounded up to 32
    assert int(enabled.memory.y[0x6044F]) == 32
    enabled.gathering.start()
    seen = {}
    for _ in range(50):
        offset = int(enabled.memory.x[0x6044F])
        enabled.run(1)
        raw = enabled.memory.read_bytes(0x1140 + 4 * offset, 16)
        cells = [int.from_bytes(raw[i : i + 4], "little", signed=True) for i in (0, 4, 8, 12)]
        assert cells[0] == signed24(int(enabled.memory.x[0xBF]))
        position = cells[2] * 2**24 + (cells[1] & 0xFFFFFF)
        assert position == enabled._long(1, reg.M_ACTUAL)
        seen[cells[3]] = offset
    counters = sorted(seen)
    assert counters == list(range(counters[0], counters[0] + 50))
    assert {seen[c] for c in counters} == set(range(0, 32, 4))


def test_dpram_without_wrap_stops_at_the_end(enabled):
    prepare(enabled, [COUNTER], mode=2)
    enabled.gathering.define(8)
    enabled.gathering.start()
    enabled.run(20)
    assert not enabled.gathering.running
    assert int(enabled.memory.x[0x6044F]) == 8


def test_trigger_waits_for_the_machine_input(enabled):
    prepare(enabled, [COUNTER])
    enabled.gathering.define(50)
    enabled.gathering.start(on_trigger=True)
    enabled.run(20)
    assert int(enabled.memory.x[6]) & reg.G1_GATHER_TRIGGER
    enabled.set_machine_input(high=True)
    enabled.run(5)
    assert int(enabled.memory.x[6]) & reg.G1_GATHERING
    enabled.gathering.stop()
    assert len(ram_words(enabled)) == 10


def test_commands_refuse_at_the_wrong_time(enabled):
    gathering = enabled.gathering
    assert gathering.start() == 3
    prepare(enabled, [COUNTER])
    assert gathering.define(10**6) == 6
    assert gathering.define(100) == 0
    gathering.start()
    assert gathering.define(100) == 1
    assert gathering.delete() == 1
    gathering.stop()
    assert gathering.delete() == 0
    assert gathering.list_lines() is None


def test_period_zero_takes_one_sample_per_command(enabled):
    prepare(enabled, [COUNTER], period=0)
    enabled.gathering.define(10)
    for _ in range(3):
        enabled.gathering.start()
        enabled.run(7)
    counters = ram_words(enabled)[0::2]
    assert [b - a for a, b in itertools.pairwise(counters)] == [7, 7]


def test_list_takes_start_and_length(enabled):
    prepare(enabled, [COUNTER])
    enabled.gathering.define(64)
    enabled.gathering.start()
    enabled.run(40)
    lines = enabled.gathering.list_lines(3, 20)
    assert [len(line.split()) for line in lines] == [16, 4]
    assert all(len(word) == 12 for line in lines for word in line.split())
    assert lines[0].split()[0] == " ".join(enabled.gathering.list_lines()).split()[3]


@pytest.mark.parametrize("mode", [0, 3])
def test_samples_do_not_depend_on_how_time_was_cut(make_servo, mode):
    results = []
    for chunk in (1, 7, 300):
        servo = make_servo()
        servo.enable(1)
        prepare(servo, [POSITION, OUTPUT, COUNTER], mode=mode)
        servo.gathering.define(2000)
        servo.gathering.start()
        servo.jog_to(1, "=", 4000.0)
        done = 0
        while done < 300:
            done += servo.run(min(chunk, 300 - done))
        results.append((servo.memory.x.tobytes(), servo.memory.y.tobytes()))
    assert results[0] == results[1] == results[2]
