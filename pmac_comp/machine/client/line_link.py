"""Commands and answers over an ASCII port: a serial line or a terminal server."""

from pmac_comp.base.clock import Deadline
from pmac_comp.base.errors import RemoteProtocolError
from pmac_comp.machine.client.link import BaseLink, SETTLE_s
from pmac_comp.machine.wire import dialog
from pmac_comp.machine.wire.replies import Reply, ReplyReader

CHANGED_ON_THE_WAY = "PC-LINK-SUM"
"""Code of the error that a changed command earns; it is never answered by asking again."""


class LineLink(BaseLink):
    """An ASCII port: serial line or terminal server."""

    def exchange(self, command: bytes, deadline: Deadline) -> Reply:
        """Send a command line and read its whole answer."""
        self._clear_way(deadline)
        reader = ReplyReader(checksum=bool(self.i4 & 1), limit=self._limit)
        self.unsettled = True
        self._ask(command, deadline)
        while not reader.receive(self._receive(deadline)):
            pass
        self.unsettled = False
        reply = self._finish(reader)
        self._check_command(reply, command)
        if reply.faults:
            self.unsettled = True
        return reply

    def _check_command(self, reply: Reply, command: bytes) -> None:
        """Raise if the line that the card carried out was not ours."""
        expected = dialog.command_sum(command)
        if reply.command_sum not in (None, expected):
            self.unsettled = True
            raise RemoteProtocolError(
                f"noise changed '{dialog.visible(command)}' on its way: the controller received "
                f"a line with the sum {reply.command_sum}, not {expected}, and carried it out",
                code=CHANGED_ON_THE_WAY,
                hint="Read back what you rely on, and check the cable and its shield.",
            )

    def control(self, character: int, deadline: Deadline, *, answers: bool) -> bytes:
        """Send a control character as it is."""
        self._clear_way(deadline)
        self._send(bytes([character]), deadline)
        if not answers:
            return b""
        self.unsettled = True
        text = bytearray()
        while b"\r" not in text:
            text += self._receive(deadline)
        line, _, rest = bytes(text).partition(b"\r")
        if self.i4 & 1:
            self._check_sum(line + b"\r", rest or self._receive_within(SETTLE_s, deadline))
        self.unsettled = False
        return line.strip(b"\n")

    def _check_sum(self, line: bytes, rest: bytes) -> None:
        if rest and rest[0] != dialog.line_sum(line):
            raise RemoteProtocolError(f"'{dialog.visible(line)}' does not match its checksum")

    def collect(self, command: bytes, deadline: Deadline) -> bytes:
        """All that answers a line in whatever mode."""
        self._silence(deadline)
        self._ask(command, deadline)
        first = self._receive(deadline)
        return first + self._take_until_quiet(deadline)

    def _silence(self, deadline: Deadline) -> None:
        self._send(bytes([dialog.CAN]), deadline)
        self._take_until_quiet(deadline)

    def _ask(self, command: bytes, deadline: Deadline) -> None:
        self._send(command + b"\r", deadline)
