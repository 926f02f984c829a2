"""Words of gathered data: from the RAM listing and from the dual-ported RAM, both directions.

What lives here: how samples lie in the two forms of gathered data. What a word means (its scale,
its source) is not known here. Source: Turbo PMAC Software Reference Manual pp. 170-171, 344;
User Manual pp. 401-402.

A sample holds its sources in the order of their I-variables: a 24-bit source is one word, a 48-bit
source two, low word first. In RAM two words make one long word, Y first; an odd sample ends in one
filler word.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pmac_comp.base.arrays import IntArray
from pmac_comp.base.errors import LocalProtocolError, RemoteProtocolError
from pmac_comp.machine.wire.numbers import join_48_array, signed_24_array

LONG_WORDS_PER_LINE = 16


@dataclass(frozen=True)
class SampleLayout:
    """Where each source lies in a sample.

    Parameters
    ----------
    widths : tuple of int
        Number of 24-bit words of each source, 1 or 2.
    padded : bool
        Whether an odd sample is filled up to whole long words (RAM yes, dual-ported RAM no).
    """

    widths: tuple[int, ...]
    padded: bool = True

    def __post_init__(self) -> None:
        if not self.widths or any(width not in (1, 2) for width in self.widths):
            raise LocalProtocolError(f"sources are 1 or 2 words wide, not {self.widths}")

    @property
    def words(self) -> int:
        """24-bit words per sample, filler included."""
        total = sum(self.widths)
        return total + (total & 1 if self.padded else 0)

    @property
    def long_words(self) -> int:
        """48-bit words per sample in RAM."""
        return (self.words + 1) // 2

    def values(self, words: IntArray) -> list[IntArray]:
        """Signed integer values of each source.

        Parameters
        ----------
        words : IntArray, shape (n * words,)
            Unsigned 24-bit words of whole samples; an incomplete last sample is left out.

        Returns
        -------
        list of IntArray, shape (n,)
        """
        n_samples = len(words) // self.words
        table = np.asarray(words, dtype=np.int64)[: n_samples * self.words]
        table = table.reshape(n_samples, self.words)
        out: list[IntArray] = []
        column = 0
        for width in self.widths:
            low = table[:, column]
            wide = width == 2
            out.append(join_48_array(table[:, column + 1], low) if wide else signed_24_array(low))
            column += width
        return out


def words_from_listing(lines: Sequence[str]) -> IntArray:
    """24-bit words of a LIST GATHER answer, in the order they were stored.

    Each item is 12 hexadecimal digits: X then Y. The Y half was stored first.

    Raises
    ------
    RemoteProtocolError
        If an item is not 12 hexadecimal digits.
    """
    items = " ".join(lines).split()
    joined = "".join(items)
    if any(len(item) != 12 for item in items):
        raise RemoteProtocolError("LIST GATHER gave an item that is not 12 digits long")
    try:
        octets = np.frombuffer(bytes.fromhex(joined), dtype=np.uint8)
    except ValueError as error:
        raise RemoteProtocolError("LIST GATHER gave an item that is not hexadecimal") from error
    triples = octets.reshape(-1, 3).astype(np.int64)
    halves = (triples[:, 0] << 16) | (triples[:, 1] << 8) | triples[:, 2]
    return np.ascontiguousarray(halves.reshape(-1, 2)[:, ::-1]).reshape(-1)


def listing_from_words(words: IntArray) -> list[str]:
    """Lines of LIST GATHER for words in storage order (an odd last word is filled with 0)."""
    padded = np.asarray(words, dtype=np.int64) & 0xFFFFFF
    if len(padded) % 2:
        padded = np.append(padded, 0)
    items = [f"{high:06X}{low:06X}" for low, high in padded.reshape(-1, 2).tolist()]
    step = LONG_WORDS_PER_LINE
    return [" ".join(items[start : start + step]) for start in range(0, len(items), step)]


def words_from_dpram(data: bytes) -> IntArray:
    """24-bit words of dual-ported RAM: each is a little-endian 32-bit cell, sign-extended."""
    if len(data) % 4:
        raise RemoteProtocolError(f"{len(data)} bytes are no whole number of 32-bit cells")
    return np.frombuffer(data, dtype="<i4").astype(np.int64) & 0xFFFFFF


def dpram_from_words(words: IntArray) -> bytes:
    """Bytes of dual-ported RAM that hold 24-bit words, one sign-extended cell each."""
    return signed_24_array(np.asarray(words, dtype=np.int64)).astype("<i4").tobytes()
