"""What this layer needs of a conversation with the controller.

``machine.client.commander.Commander`` is the one in use; tests put a scripted peer in its place.
"""

from collections.abc import Callable, Sequence
from typing import Protocol

from pmac_comp.base.clock import Clock


class Link(Protocol):
    """One conversation: questions may be repeated by it, commands never."""

    @property
    def clock(self) -> Clock:
        """Clock that waits are measured on."""
        ...

    def query(self, text: str, *, meanwhile: Callable[[], None] | None = None) -> list[str]:
        """Lines that answer a question; ``meanwhile`` runs once while the answer is awaited."""
        ...

    def command(self, text: str, *, timeout_s: float | None = None) -> list[str]:
        """Send a line that changes something, once; lines of the questions it holds.

        Raises CommandRefused on an error answer.
        """
        ...

    def write_buffer(
        self, lines: Sequence[str], *, progress: Callable[[int, int], None] | None = None
    ) -> None:
        """Send many lines in packets; ``progress`` hears of lines done and in all after each.

        Raises CommandRefused naming the line that was refused.
        """
        ...

    def get_memory(self, offset: int, n_bytes: int) -> bytes:
        """Bytes of the dual-ported RAM from a host byte offset."""
        ...
