"""Commands and answers over the Ethernet packet port."""

from pmac_comp.base.clock import Deadline
from pmac_comp.machine.client.link import BaseLink, SETTLE_s
from pmac_comp.machine.wire import ethernet, ethernet_requests
from pmac_comp.machine.wire.replies import Reply, ReplyReader, plain_lines

QUIET_s = 0.25
"""A pause inside an answer after which the port is asked for more."""
_FLUSH_s = 0.5
_BUSY_POLL_s = 0.02
_TEXT = bytes([0x0D, *range(0x20, 0x7F)])


class PacketLink(BaseLink):
    """The Ethernet packet port."""

    def request(self, request: ethernet.Request, deadline: Deadline) -> bytes:
        """The answer to a request whose size is known beforehand."""
        size = ethernet.reply_size(request)
        if size is None:
            raise ValueError(f"{request.name} is answered with text")
        self._clear_way(deadline)
        self.unsettled = True
        self._send(ethernet.encode(request), deadline)
        data = b""
        while len(data) < size:
            data += self._receive(deadline)
        self.unsettled = len(data) > size
        return data[:size]

    def exchange(self, command: bytes, deadline: Deadline) -> Reply:
        """Send a command line with GETRESPONSE and read its whole answer with GETBUFFER."""
        self._clear_way(deadline)
        self.unsettled = True
        self._send(ethernet_requests.command_packet(command), deadline)
        data = last = self._receive(deadline)
        # Long listings come in whole parts of plain text: no need to look at each byte of them.
        while not self.i4 and len(last) == ethernet.MAX_REPLY and _is_text(last):
            if len(data) > self._limit:
                break
            self._ask_more(deadline)
            last = self._receive(deadline)
            data += last
        lines = None if self.i4 or len(last) > ethernet.MAX_REPLY else plain_lines(data)
        if lines is not None:
            self.unsettled = False
            return Reply(lines)
        reader = ReplyReader(limit=self._limit, checksum=bool(self.i4 & 1))
        self._read_parts(reader, data, len(last), deadline)
        return self._finish(reader)

    def _read_parts(self, reader: ReplyReader, data: bytes, part: int, deadline: Deadline) -> None:
        asked_early = waiting = False
        heard_s = self._clock.now_s()
        while not reader.receive(data):
            busy = bool(data) and not data.strip(b"\x00")
            if data and not busy:
                heard_s = self._clock.now_s()
            self._require_within_pause(heard_s)
            if busy:
                self._clock.sleep_s(_BUSY_POLL_s)
            if data:
                waiting = False
            if busy or part == ethernet.MAX_REPLY:
                part = 0
                self._ask_more(deadline)
            elif not data and not waiting:
                # A part shorter than 1400 bytes that was not the last, or a pause inside one: if
                # the latter, the answer to this request is one too many.
                asked_early = waiting = True
                self._ask_more(deadline)
            data = self._receive_within(QUIET_s, deadline) if part else self._receive(deadline)
            part += len(data)
        self.unsettled = asked_early

    def _ask_more(self, deadline: Deadline) -> None:
        self._send(ethernet.encode(ethernet_requests.get_buffer()), deadline)

    def control(self, character: int, deadline: Deadline, *, answers: bool) -> bytes:
        """Send a control character through its own request."""
        if not answers:
            self.request(ethernet_requests.send_control(character), deadline)
            return b""
        self._clear_way(deadline)
        self.unsettled = True
        self._send(ethernet.encode(ethernet_requests.control_response(character)), deadline)
        text = bytearray()
        while b"\r" not in text and len(text) < ethernet.MAX_REPLY:
            text += self._receive(deadline)
        # An ACK may follow the line or not: what comes late is found as a stray.
        text += self._receive_within(SETTLE_s / 3, deadline) if text[-1:] == b"\r" else b""
        self.unsettled = False
        return bytes(text).partition(b"\r")[0]

    def collect(self, command: bytes, deadline: Deadline) -> bytes:
        """All that answers a line in whatever mode: parts are asked for until none comes."""
        self._silence(deadline)
        self._ask(command, deadline)
        taken = self._receive(deadline)
        while True:
            more = self._take_until_quiet(deadline)
            taken += more
            reader = ReplyReader(limit=self._limit)
            if reader.receive(taken) and not reader.rest:
                return taken
            self._ask_more(deadline)
            more = self._take_until_quiet(deadline)
            taken += more
            if not more.strip(b"\x00"):
                return taken.replace(b"\x00", b"")

    def _silence(self, deadline: Deadline) -> None:
        self._send(ethernet.encode(ethernet_requests.flush()), deadline)
        # Should no answer come, what follows still finds its mark: FLUSH only makes way for it.
        if self._receive_within(_FLUSH_s, deadline):
            self._take_until_quiet(deadline)

    def _ask(self, command: bytes, deadline: Deadline) -> None:
        self._send(ethernet.encode(ethernet_requests.get_response(command)), deadline)


def _is_text(part: bytes) -> bool:
    """Whether a part of an answer holds printable characters and CR only, so it goes on."""
    return part.translate(None, _TEXT) == b""
