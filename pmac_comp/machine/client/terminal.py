"""A person's conversation with a controller: any line, refusals shown as text, nothing repeated.

Control characters are written ``^K``. Imports the commander and, for a Power PMAC, gpascii.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from pmac_comp.base.errors import CommandRefused
from pmac_comp.machine.client.commander import Commander
from pmac_comp.machine.transport.url import parse_url
from pmac_comp.machine.wire.errors import error_meaning, error_text

Ask = Callable[[str], list[str]]


def terminal_of(commander: Commander) -> Ask:
    """A function that takes what a person typed and gives the lines to show.

    Parameters
    ----------
    commander : Commander
        Conversation to use. The line is sent once, whatever it is.
    """

    def ask(line: str) -> list[str]:
        if not line.strip():
            return []
        if len(line.strip()) == 2 and line.strip()[0] == "^":
            answer = commander.control(line.strip()[1])
            return [answer] if answer else []
        try:
            shown = commander.command(line)
        except CommandRefused as error:
            shown = [str(text) for text in _list(error.context["lines"])]
            shown.append(_refusal(error))
        return [*(f"<{text}>" for text in commander.take_unsolicited()), *shown]

    return ask


@contextmanager
def open_terminal(url: str) -> Iterator[Ask]:
    """A terminal for an address other than ``sim://``; ``gpascii://`` included."""
    if parse_url(url).scheme != "gpascii":
        with Commander.open(url) as commander:
            yield terminal_of(commander)
        return
    from pmac_comp.machine.transport.gpascii import GpasciiTerminal

    with GpasciiTerminal(url) as power:
        yield _forgiving(power.query)


def _forgiving(query: Ask) -> Ask:
    def ask(line: str) -> list[str]:
        try:
            return query(line) if line.strip() else []
        except CommandRefused as error:
            return [str(text) for text in _list(error.context["lines"])]

    return ask


def _refusal(error: CommandRefused) -> str:
    number = error.context["error"]
    code = number if isinstance(number, int) else 0
    return f"{error_text(code)}: {error_meaning(code)}"


def _list(value: object) -> list[object]:
    return list(value) if isinstance(value, list) else []
