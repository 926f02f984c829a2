"""Text to a Power PMAC: the ``gpascii`` program in an SSH login.

What lives here: how the program is started behind whatever a shell prints, and where an answer of
it ends. Only ``info`` and ``terminal`` use it. There was no Power PMAC to test on: what is known
comes from public clients, which wait for ``ASCII`` after the start and for ACK after an answer.
"""

import secrets

import paramiko

from pmac_comp.base.clock import Clock, Deadline, SystemClock
from pmac_comp.base.errors import CommandRefused, ConnectFailed, LinkError, ReplyTimeout
from pmac_comp.machine.transport.base import Framing
from pmac_comp.machine.transport.ssh import login
from pmac_comp.machine.transport.tcp import SocketTransport
from pmac_comp.machine.transport.url import parse_url
from pmac_comp.machine.wire.dialog import visible

_ACK = b"\x06"
_QUIET_s = 0.1
_MAX_ANSWER = 1_000_000


class GpasciiTerminal:
    """A dialog with a Power PMAC's command interpreter; after any doubt it closes itself.

    Parameters
    ----------
    url : str
        ``gpascii://user@host``.
    clock : Clock or None
        Clock of deadlines.
    timeout_s : float
        Total time of connecting and of each answer in s.
    """

    def __init__(self, url: str, *, clock: Clock | None = None, timeout_s: float = 10.0) -> None:
        self._clock: Clock = clock or SystemClock()
        self._timeout_s = timeout_s
        deadline = Deadline.after(self._clock, timeout_s)
        endpoint = parse_url(url)
        self._client = login(endpoint, deadline)
        try:
            self._transport = SocketTransport(
                _shell(self._client, deadline), endpoint.name, Framing.LINES
            )
            self._start(deadline)
        except BaseException:
            self._client.close()
            raise

    @property
    def name(self) -> str:
        """Where it leads."""
        return self._transport.name

    def query(self, text: str) -> list[str]:
        """Lines that answer a command; control characters in them are shown escaped.

        Raises
        ------
        CommandRefused
            If the controller reports an error.
        ReplyTimeout, LinkLost
            If no whole answer came; the dialog is then closed.
        """
        deadline = Deadline.after(self._clock, self._timeout_s)
        self._transport.drain()
        self._transport.send(text.encode("ascii", "replace") + b"\n", deadline)
        try:
            answer = self._read_until(_ACK, deadline)
        except LinkError:
            self.close()
            raise
        lines = _lines(answer.partition(_ACK)[0])
        if lines and lines[0] == text.strip():
            lines = lines[1:]  # a terminal that echoes
        refusals = [line for line in lines if "error #" in line]
        if refusals:
            raise CommandRefused(
                f"the controller refused '{text}': {refusals[0]}",
                context={"command": text, "lines": lines},
            )
        return lines

    def close(self) -> None:
        """End the login."""
        self._transport.close()
        self._client.close()

    def __enter__(self) -> "GpasciiTerminal":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _start(self, deadline: Deadline) -> None:
        # The quotes keep the shell's echo of this line from looking like its output.
        nonce = secrets.token_hex(8)
        self._transport.send(f'echo "ready"-{nonce}\n'.encode(), deadline)
        self._expect(f"ready-{nonce}".encode(), "its shell does not answer", deadline)
        self._transport.send(b"gpascii -2\n", deadline)
        self._expect(b"ASCII", "gpascii does not start", deadline)
        self._take_until_quiet(deadline)
        self._transport.send(b"echo 7\n", deadline)
        self._expect(_ACK, "gpascii does not acknowledge", deadline)
        self._take_until_quiet(deadline)

    def _expect(self, wanted: bytes, problem: str, deadline: Deadline) -> None:
        try:
            self._read_until(wanted, deadline)
        except LinkError as error:
            raise ConnectFailed(
                f"{self.name}: {problem}",
                hint="Is it a Power PMAC? A Turbo PMAC is reached over tcp://, serial:// or ssh://.",
            ) from error

    def _read_until(self, wanted: bytes, deadline: Deadline) -> bytes:
        seen = bytearray()
        while wanted not in seen and len(seen) < _MAX_ANSWER:
            seen += self._transport.receive(deadline)
        return bytes(seen)

    def _take_until_quiet(self, deadline: Deadline) -> None:
        until_s = min(self._clock.now_s() + _QUIET_s, deadline.at_s)
        try:
            while True:
                self._transport.receive(Deadline(self._clock, until_s))
        except ReplyTimeout:
            return


def _shell(client: paramiko.SSHClient, deadline: Deadline) -> paramiko.Channel:
    transport = client.get_transport()
    try:
        if transport is None:
            raise paramiko.SSHException("the login has ended")  # noqa: TRY301
        channel = transport.open_session(timeout=max(1e-3, deadline.remaining_s()))
        # No terminal is asked for: fewer shells then echo, colour or prompt.
        channel.invoke_shell()
    except (paramiko.SSHException, OSError, EOFError) as error:
        raise ConnectFailed(
            f"the login gives no shell: {error}",
            hint="Try the same login with ssh; the account needs a shell that starts gpascii.",
        ) from error
    return channel


def _lines(data: bytes) -> list[str]:
    return [
        visible(part.strip()) for part in data.replace(b"\r", b"\n").split(b"\n") if part.strip()
    ]
