"""Sessions as evidence: every byte of a conversation in a text file, and a link that plays it back.

Each line is ``{"t_s": ..., "way": "send" | "receive", "hex": ...}``, times from the start of the
session. Logins happen below the transport and are never in it. A recorded session replays as long
as the host asks the same questions; the question that settles a link is random on purpose, so a
session with trouble replays up to it.
"""

import json
from collections import deque
from collections.abc import Iterable
from pathlib import Path
from typing import TextIO

from pmac_comp.base.clock import Clock, Deadline
from pmac_comp.base.errors import ConfigError, RemoteProtocolError, ReplyTimeout
from pmac_comp.base.reading import why
from pmac_comp.machine.transport.base import Framing, Transport
from pmac_comp.machine.transport.tap import Way


class RecordingTransport:
    """A transport that notes what passes through it.

    Parameters
    ----------
    inner : Transport
        The link in use; closed with this one.
    path : Path
        File to write; an existing one is refused, evidence is not overwritten.
    clock : Clock
        Clock of the times noted.
    """

    def __init__(self, inner: Transport, path: Path, clock: Clock) -> None:
        self._inner = inner
        self._clock = clock
        self._start_s = clock.now_s()
        try:
            self._file: TextIO = path.open("x", encoding="ascii")
        except OSError as error:
            inner.close()
            raise ConfigError(
                f"the session cannot be recorded in {path}: {why(error)}",
                code="PC-URL-005",
                hint="?record= takes the name of a new file in a folder that can be written.",
            ) from error
        self._note_line({"name": inner.name, "framing": inner.framing.value})

    @property
    def name(self) -> str:
        """Where it leads."""
        return self._inner.name

    @property
    def framing(self) -> Framing:
        """What the bytes are."""
        return self._inner.framing

    def send(self, data: bytes, deadline: Deadline) -> None:
        """Send and note; what may not have left is noted too."""
        self._note(Way.SEND, data)
        self._inner.send(data, deadline)

    def receive(self, deadline: Deadline) -> bytes:
        """Receive and note."""
        return self._note(Way.RECEIVE, self._inner.receive(deadline))

    def drain(self) -> bytes:
        """Take what has arrived, and note it."""
        return self._note(Way.RECEIVE, self._inner.drain())

    def renew(self) -> None:
        """Renew the link below."""
        self._inner.renew()

    def close(self) -> None:
        """Close link and file."""
        self._inner.close()
        self._file.close()

    def _note(self, way: Way, data: bytes) -> bytes:
        if data and not self._file.closed:
            t_s = round(self._clock.now_s() - self._start_s, 6)
            self._note_line({"t_s": t_s, "way": way.value, "hex": data.hex()})
        return data

    def _note_line(self, entry: dict[str, object]) -> None:
        self._file.write(json.dumps(entry) + "\n")
        self._file.flush()


class ReplayTransport:
    """A link that answers as a recorded one did, and refuses to be asked anything else.

    Parameters
    ----------
    lines : iterable of str
        Lines of a recorded session.
    clock : Clock
        Waiting for an answer that was never given passes time on it.
    """

    def __init__(self, lines: Iterable[str], clock: Clock) -> None:
        entries = [json.loads(line) for line in lines]
        if not entries or "framing" not in entries[0]:
            raise ConfigError(
                "This is no recorded session.",
                hint="Sessions are kept by `?record=FILE` behind a URL.",
            )
        self._name = f"replay of {entries[0]['name']}"
        self._framing = Framing(entries[0]["framing"])
        self._clock = clock
        self._entries: deque[tuple[Way, bytes]] = deque(
            (Way(entry["way"]), bytes.fromhex(entry["hex"])) for entry in entries[1:]
        )

    @property
    def name(self) -> str:
        """Which session it is."""
        return self._name

    @property
    def framing(self) -> Framing:
        """What the bytes are."""
        return self._framing

    @property
    def finished(self) -> bool:
        """Whether all of the session was played."""
        return not self._entries

    def send(self, data: bytes, deadline: Deadline) -> None:
        """Compare with what was sent then."""
        del deadline
        if not self._entries or self._entries[0] != (Way.SEND, data):
            raise RemoteProtocolError(f"{self._name}: the session went on otherwise here")
        self._entries.popleft()

    def receive(self, deadline: Deadline) -> bytes:
        """What came then; where nothing came, time passes until the deadline."""
        if self._entries and self._entries[0][0] is Way.RECEIVE:
            return self._entries.popleft()[1]
        self._clock.sleep_s(deadline.remaining_s())
        raise ReplyTimeout(f"{self._name}: nothing came here")

    def drain(self) -> bytes:
        """Nothing: what came is given when it is waited for."""
        return b""

    def renew(self) -> None:
        """Nothing to renew."""

    def close(self) -> None:
        """Nothing to close."""
