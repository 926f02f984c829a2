"""A person's conversation with a controller: any line, refusals shown as text, nothing repeated.

Control characters are written ``^K``. Imports the commander and, for a Power PMAC, gpascii.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager

from pmac_comp.base.errors import CommandRefused, ReplyTimeout
from pmac_comp.machine.client.commander import Commander
from pmac_comp.machine.transport.url import parse_url
from pmac_comp.machine.wire.errors import error_meaning, error_text


class Answer(list[str]):
    """Lines to show.

    Parameters
    ----------
    lines : iterable of str
        The lines.
    is_refusal : bool
        Whether the controller refused the command.
    """

    def __init__(self, lines: Iterable[str] = (), *, is_refusal: bool = False) -> None:
        super().__init__(lines)
        self.is_refusal = is_refusal


Ask = Callable[[str], Answer]


def terminal_of(commander: Commander) -> Ask:
    """A function that takes what a person typed and gives the lines to show.

    Parameters
    ----------
    commander : Commander
        Conversation to use. The line is sent once, whatever it is.
    """

    def ask(line: str) -> Answer:
        if not line.strip():
            return Answer()
        if len(line.strip()) == 2 and line.strip()[0] == "^":
            answer = commander.control(line.strip()[1])
            return Answer([answer] if answer else [])
        refused = False
        try:
            shown = commander.command(line)
        except ReplyTimeout:
            if not line.strip().startswith("$$$"):
                raise
            shown = ["(no card acknowledges a reset; it may take some seconds)"]
        except CommandRefused as error:
            refused = True
            shown = [str(text) for text in _list(error.context["lines"])]
            shown.append(_refusal(error))
        unasked = (f"<{text}>" for text in commander.take_unsolicited())
        return Answer([*unasked, *shown], is_refusal=refused)

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


def _forgiving(query: Callable[[str], list[str]]) -> Ask:
    def ask(line: str) -> Answer:
        try:
            return Answer(query(line) if line.strip() else [])
        except CommandRefused as error:
            lines = (str(text) for text in _list(error.context["lines"]))
            return Answer(lines, is_refusal=True)

    return ask


def _refusal(error: CommandRefused) -> str:
    number = error.context["error"]
    code = number if isinstance(number, int) else 0
    return f"{error_text(code)}: {error_meaning(code)}"


def _list(value: object) -> list[object]:
    return list(value) if isinstance(value, list) else []
