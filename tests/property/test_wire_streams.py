"""Any split or merge of any stream gives the same events; hostile bytes never raise."""

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pmac_comp.machine.wire import ethernet, ethernet_requests
from pmac_comp.machine.wire.dialog import (
    LineReader,
    format_reply,
    format_unsolicited,
)
from pmac_comp.machine.wire.ethernet import Malformed, RequestReader, encode
from pmac_comp.machine.wire.numbers import (
    decode_float_48,
    encode_float_48,
    number_text,
    read_number,
)
from pmac_comp.machine.wire.replies import ReplyReader, read_settled

printable = st.text(alphabet=st.characters(min_codepoint=0x20, max_codepoint=0x7E), max_size=40)
command = printable.map(str.encode).filter(lambda text: bool(text.strip()))
words = st.integers(0, 0xFFFF)
controls = st.integers(1, 31)

requests = st.one_of(
    command.map(ethernet_requests.send_line),
    command.map(ethernet_requests.get_response),
    st.just(ethernet_requests.flush()),
    st.just(ethernet_requests.get_buffer()),
    st.just(ethernet_requests.read_ready()),
    st.builds(ethernet_requests.get_memory, words, st.integers(1, 1400)),
    st.builds(ethernet_requests.set_memory, words, st.binary(min_size=1, max_size=1400)),
    st.builds(
        ethernet_requests.set_bits, words, st.integers(0, 2**32 - 1), st.integers(0, 2**32 - 1)
    ),
    st.builds(ethernet_requests.or_bits, words, st.integers(0, 2**32 - 1)),
    controls.map(ethernet_requests.control_response),
    controls.map(ethernet_requests.send_control),
    st.lists(command, min_size=1, max_size=5).map(ethernet_requests.write_buffer),
    st.just(ethernet_requests.get_address()),
)


def cut(data: bytes, places: list[int]) -> list[bytes]:
    edges = sorted({0, len(data), *(place % (len(data) + 1) for place in places)})
    return [data[a:b] for a, b in pairwise(edges)]


@given(st.lists(requests, max_size=8), st.lists(st.integers(0, 10**6), max_size=12))
def test_requests_survive_any_split(sent, places):
    stream = b"".join(encode(request) for request in sent)
    reader = RequestReader()
    got = [event for piece in cut(stream, places) for event in reader.receive(piece)]
    assert got == sent
    assert reader.pending == 0


@given(st.lists(requests, max_size=4))
def test_requests_survive_single_bytes(sent):
    reader = RequestReader()
    stream = b"".join(encode(request) for request in sent)
    assert [e for value in stream for e in reader.receive(bytes([value]))] == sent


@given(st.binary(max_size=3000), st.lists(st.integers(0, 10**6), max_size=5))
def test_hostile_bytes_are_events_and_do_not_depend_on_the_split(data, places):
    whole = RequestReader()
    events = whole.receive(data)
    pieces = RequestReader()
    assert [e for piece in cut(data, places) for e in pieces.receive(piece)] == events
    assert sum(isinstance(event, Malformed) for event in events) <= 1
    assert whole.pending <= ethernet.HEADER_SIZE + ethernet.MAX_PAYLOAD


text_line = printable.filter(bool)
replies = st.tuples(
    st.lists(text_line, max_size=6),
    st.sampled_from([2, 3]),
    st.sampled_from([0, 1, 2, 3]),
    st.sampled_from([1, 3]),
    st.one_of(st.none(), st.integers(1, 22)),
    command,
)


@given(replies, st.lists(st.integers(0, 10**6), max_size=12))
def test_answers_survive_any_split(case, places):
    lines, i3, i4, i6, error, line = case
    data = format_reply(lines, i3=i3, i4=i4, i6=i6, error=error, command=line)
    reader = ReplyReader(checksum=bool(i4 & 1))
    done = [reader.receive(piece) for piece in cut(data, places)]
    assert done[-1]
    assert not any(done[:-1])
    assert reader.reply.lines == tuple(lines)
    assert reader.reply.error == error
    assert reader.reply.faults == ()
    assert reader.rest == b""


@given(replies, replies)
def test_a_second_answer_is_left_over_whole(one, two):
    first, second = (
        format_reply(c[0], i3=c[1], i4=one[2], i6=c[3], error=c[4], command=c[5])
        for c in (one, two)
    )
    reader = ReplyReader(checksum=bool(one[2] & 1))
    assert reader.receive(first + second)
    assert reader.rest == second


@given(replies)
def test_no_prefix_of_an_answer_counts_as_an_answer(case):
    lines, i3, i4, i6, error, line = case
    data = format_reply(lines, i3=i3, i4=i4, i6=i6, error=error, command=line)
    for size in range(len(data)):
        assert not ReplyReader(checksum=bool(i4 & 1)).receive(data[:size])


@given(
    st.lists(text_line, min_size=1, max_size=4),
    st.integers(0, 3),
    st.integers(0, 3),
    command,
)
def test_settled_answers_are_read_in_every_mode(lines, i3, i4, line):
    data = format_reply(lines, i3=i3, i4=i4, command=line)
    reply = read_settled(data, i3=i3, i4=i4)
    assert reply is not None
    assert reply.lines == tuple(lines)


@given(st.binary(max_size=600), st.booleans())
def test_hostile_answers_end_or_wait_but_never_raise(data, checksum):
    one, other = ReplyReader(checksum=checksum), ReplyReader(checksum=checksum)
    one.receive(data)
    for value in data:
        other.receive(bytes([value]))
    assert one.done == other.done
    assert one.reply == other.reply
    for line in (*one.reply.lines, *one.reply.unsolicited, *one.reply.faults):
        assert line.isprintable()


@given(st.lists(st.one_of(command.map(lambda c: c + b"\r"), controls.map(lambda c: bytes([c])))))
def test_command_lines_survive_any_split(pieces):
    stream = b"".join(pieces)
    whole, single = LineReader(), LineReader()
    assert whole.receive(stream) == [e for v in stream for e in single.receive(bytes([v]))]


@given(format_case=st.tuples(printable, st.integers(0, 3), st.integers(0, 3)))
def test_text_of_programs_never_ends_an_answer(format_case):
    text, i3, i4 = format_case
    reader = ReplyReader(checksum=bool(i4 & 1))
    assert not reader.receive(format_unsolicited(text, i3=i3, i4=i4))
    assert reader.at_line_start


moderate = st.floats(min_value=-1e18, max_value=1e18).filter(lambda x: x == 0 or abs(x) > 1e-15)


@given(moderate)
@pytest.mark.faults
def test_f36_numbers_are_plain_decimals_and_read_back_exactly(value):
    text = number_text(value)
    assert "e" not in text.lower()
    assert "," not in text
    assert text != "-0"
    assert float(read_number(text)) == value


@given(moderate)
def test_registers_hold_36_bits(value):
    held = decode_float_48(encode_float_48(value))
    assert abs(held - value) <= abs(value) * 2.0**-35
    assert decode_float_48(encode_float_48(held)) == held
