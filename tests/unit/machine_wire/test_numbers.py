"""Numbers as text and as register words."""

import numpy as np
import pytest

from pmac_comp.base.errors import LocalProtocolError, RemoteProtocolError
from pmac_comp.machine.wire import numbers

# User Manual pp. 241-248: the register of known values.
REGISTERS = [
    (0.0, "000000000000"),
    (1.0, "400000000800"),
    (2.0, "400000000801"),
    (0.5, "4000000007FF"),
    (-1.0, "8000000007FF"),
    (-2.0, "800000000800"),
    (-0.75, "A000000007FF"),
    (1000.25, "7D0800000809"),
]


@pytest.mark.parametrize(("value", "word"), REGISTERS)
def test_floating_point_registers(value, word):
    assert f"{numbers.encode_float_48(value):012X}" == word
    assert numbers.decode_float_48(int(word, 16)) == value


@pytest.mark.parametrize("power", [-40, 0, 40])
def test_rounding_up_to_a_power_of_two_moves_the_exponent(power):
    below = (1.0 - 2.0**-40) * 2.0**power
    assert numbers.register_value(below) == 2.0**power
    assert numbers.encode_float_48(below) == numbers.encode_float_48(2.0**power)
    assert numbers.register_value(-below) == -(2.0**power)


def test_registers_that_are_not_normalised_are_read():
    # one driver writes -1.0 with the exponent of +1.0, one unit of the last place off
    assert numbers.decode_float_48(0xBFFFFFFFF800) == pytest.approx(-1.0, rel=1e-10)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_what_is_no_number_has_no_form(value):
    with pytest.raises(LocalProtocolError):
        numbers.encode_float_48(value)
    with pytest.raises(LocalProtocolError):
        numbers.number_text(value)


def test_a_third_rounds_to_36_bits():
    held = numbers.register_value(1.0 / 3.0)
    assert held != 1.0 / 3.0
    assert abs(held * 3.0 - 1.0) < 2.0**-35


@pytest.mark.parametrize(
    ("word", "value"), [(0xFFFFFF, -1), (0x800000, -0x800000), (0x7FFFFF, 0x7FFFFF), (0, 0)]
)
def test_24_bit_words(word, value):
    assert numbers.signed_24(word) == value
    assert numbers.signed_24_array(np.array([word])).tolist() == [value]


@pytest.mark.parametrize("value", [0, 1, -1, 2**47 - 1, -(2**47), 123456789012])
def test_48_bit_words(value):
    assert numbers.join_48(*numbers.split_48(value)) == value


def test_arrays_agree_with_single_values():
    rng = np.random.default_rng(5)
    high, low = rng.integers(0, 1 << 24, (2, 500))
    joined = numbers.join_48_array(high, low)
    floats = numbers.float_48_array(high, low)
    for h, lo, whole, value in zip(high, low, joined, floats, strict=True):
        assert numbers.join_48(int(h), int(lo)) == whole
        assert numbers.decode_float_48((int(h) << 24) | int(lo)) == value


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (1e-7, "0.0000001"),
        (-0.0, "0"),
        (10.0, "10"),
        (3, "3"),
        (-2.5, "-2.5"),
        (1e15, "1000000000000000"),
    ],
)
def test_text_for_the_controller(value, text):
    assert numbers.number_text(value) == text


def test_values_too_small_to_write_out_are_refused_not_rounded():
    with pytest.raises(LocalProtocolError, match="Scale"):
        numbers.number_text(1.23e-60)


@pytest.mark.parametrize(
    ("text", "value"), [("$78C02", 0x78C02), ("-12", -12), ("0.5", 0.5), (" 7 ", 7), ("$0", 0)]
)
def test_text_from_the_controller(text, value):
    assert numbers.read_number(text) == value


@pytest.mark.parametrize("text", ["", "1e5", "0x10", "nan", "1,5", "--1", "$", "ERR003"])
def test_other_text_is_no_number(text):
    with pytest.raises(RemoteProtocolError):
        numbers.read_number(text)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        # from a real configuration backup: both values are 24-bit fractions
        (1677721 / 2**23, "0.19999992847"),
        (32763 / 32768, "0.9998474121"),
        (0.0, "0"),
        (-5797.53125, "-5797.53125"),
        (2000.0, "2000"),
        (-1e-13, "0"),
        (140737488355327.0, "140737488355327"),
    ],
)
def test_text_as_the_card_prints_it(value, text):
    assert numbers.card_number_text(value) == text


def test_hexadecimal_text():
    assert numbers.hex_text(0x78002) == "$78002"
    with pytest.raises(LocalProtocolError):
        numbers.hex_text(-1)
