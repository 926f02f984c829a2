"""Words of gathered data."""

import numpy as np
import pytest

from pmac_comp.base.errors import LocalProtocolError, RemoteProtocolError
from pmac_comp.machine.wire.gather_words import (
    SampleLayout,
    dpram_from_words,
    listing_from_words,
    words_from_dpram,
    words_from_listing,
)


def test_a_position_and_an_output_as_the_listing_shows_them():
    # 48-bit source -2 (X FFFFFF, Y FFFFFE), then a 24-bit source 5: the second long word holds
    # the output right and the filler left.
    words = words_from_listing(["FFFFFFFFFFFE 000000000005"])
    position, output = SampleLayout((2, 1)).values(words)
    assert position.tolist() == [-2]
    assert output.tolist() == [5]


def test_a_wide_source_behind_a_narrow_one_straddles_long_words():
    words = words_from_listing(["00000A000001 00000B000000"])
    narrow, wide = SampleLayout((1, 2)).values(words)
    assert narrow.tolist() == [1]
    assert wide.tolist() == [0x00000000000A]


def test_samples_in_dual_ported_ram_have_no_filler():
    data = dpram_from_words(np.array([1, 0xFFFFFF, 3, 4, 5, 6]))
    assert data[4:8] == b"\xff\xff\xff\xff"
    first, second, third = SampleLayout((1, 1, 1), padded=False).values(words_from_dpram(data))
    assert (first.tolist(), second.tolist(), third.tolist()) == ([1, 4], [-1, 5], [3, 6])


def test_odd_samples_are_filled_up_in_ram_only():
    ram, dpram = SampleLayout((2, 1)), SampleLayout((2, 1), padded=False)
    assert (ram.words, ram.long_words) == (4, 2)
    assert (dpram.words, dpram.long_words) == (3, 2)
    assert (SampleLayout((1, 1)).words, SampleLayout((1, 1)).long_words) == (2, 1)
    position, output = ram.values(np.array([1, 0, 5, 0, 2, 0, 6, 0]))
    assert (position.tolist(), output.tolist()) == ([1, 2], [5, 6])
    position, output = dpram.values(np.array([1, 0, 5, 2, 0, 6]))
    assert (position.tolist(), output.tolist()) == ([1, 2], [5, 6])


def test_an_incomplete_sample_is_left_out():
    values = SampleLayout((1,), padded=False).values(np.array([1, 2, 3]))
    assert values[0].tolist() == [1, 2, 3]
    assert SampleLayout((2,)).values(np.array([1, 0, 3]))[0].tolist() == [1]


def test_listing_has_sixteen_long_words_a_line():
    lines = listing_from_words(np.arange(66))
    assert [len(line.split()) for line in lines] == [16, 16, 1]
    assert words_from_listing(lines).tolist() == list(range(66))


@pytest.mark.parametrize("count", [0, 1, 2, 3, 31, 32, 33])
def test_listings_of_any_length_come_back(count):
    words = words_from_listing(listing_from_words(np.arange(1, count + 1)))
    assert words.tolist() == list(range(1, count + 1)) + [0] * (count % 2)


@pytest.mark.parametrize("lines", [["00000000001"], ["00000000000G"], ["0" * 13]])
def test_damaged_listings_are_refused(lines):
    with pytest.raises(RemoteProtocolError):
        words_from_listing(lines)


def test_damaged_memory_is_refused():
    with pytest.raises(RemoteProtocolError):
        words_from_dpram(b"\0\0\0")
    with pytest.raises(LocalProtocolError):
        SampleLayout((3,))
    with pytest.raises(LocalProtocolError):
        SampleLayout(())
