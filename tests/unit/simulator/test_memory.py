"""Number formats of the memory against the manual's worked values."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pmac_comp.simulator.memory.memory import (
    Memory,
    read_float48,
    read_long,
    write_float48,
    write_long,
)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (1.0, "400000000800"),
        (2.0, "400000000801"),
        (0.5, "4000000007FF"),
        (-1.0, "8000000007FF"),
        (-2.0, "800000000800"),
        (-0.75, "A000000007FF"),
        (1000.25, "7D0800000809"),
        (0.0, "000000000000"),
    ],
)
def test_float48_has_the_bits_of_the_manual(value: float, text: str) -> None:
    m = Memory()
    write_float48(m.x, m.y, 5, value)
    assert f"{m.x[5]:06X}{m.y[5]:06X}" == text
    assert read_float48(m.x, m.y, 5) == value


def test_float48_that_is_not_normalised_is_read_by_the_formula() -> None:
    m = Memory()
    m.x[5], m.y[5] = 0xBFFFFF, 0xFFF800
    assert read_float48(m.x, m.y, 5) == pytest.approx(-1.0, abs=1e-9)


@given(st.floats(min_value=-1e200, max_value=1e200, allow_nan=False))
def test_float48_keeps_ten_digits(value: float) -> None:
    m = Memory()
    write_float48(m.x, m.y, 5, value)
    assert read_float48(m.x, m.y, 5) == pytest.approx(value, rel=2**-34, abs=1e-300)


@given(st.integers(min_value=-(2**47), max_value=2**47 - 1))
def test_long_is_a_signed_48_bit_integer(value: int) -> None:
    m = Memory()
    write_long(m.x, m.y, 5, value)
    assert read_long(m.x, m.y, 5) == value


@given(st.integers(0, 200), st.binary(min_size=1, max_size=40))
def test_dpram_bytes_come_back_and_touch_nothing_else(offset: int, data: bytes) -> None:
    m = Memory()
    m.write_bytes(0, b"\xa5" * 256)
    m.write_bytes(offset, data)
    expected = bytearray(b"\xa5" * 256)
    expected[offset : offset + len(data)] = data
    assert m.read_bytes(0, 256) == bytes(expected[:256])


def test_dpram_cell_is_y_low_x_high() -> None:
    m = Memory()
    m.write_bytes(0x1140, bytes([1, 2, 3, 4]))
    assert (m.y[0x060450], m.x[0x060450]) == (0x0201, 0x0403)
    assert m.x.dtype == np.int32
