"""Lines that may be sent, and what an answer that is no answer becomes.

What lives here: the checks of a line before it is sent, and the errors a refused or garbled one
earns. Nothing is sent here.
"""

from collections.abc import Sequence

from pmac_comp.base.errors import CommandRefused, LocalProtocolError, RemoteProtocolError
from pmac_comp.machine.wire import ethernet
from pmac_comp.machine.wire.errors import error_meaning, error_text
from pmac_comp.machine.wire.replies import Reply

_ADVICE = {
    7: "A program buffer is open that was opened over another port, by a change that was cut or by "
    "somebody else. If nobody is loading a program, `pmac-comp terminal URL -c 'CLOSE ALL'` closes "
    "it; then run the command again.",
}


def encoded(text: str) -> bytes:
    """Bytes of a line, or LocalProtocolError if it cannot be sent as one."""
    if not text.isascii():
        raise LocalProtocolError(f"'{text}' holds characters that are not ASCII")
    if not text.isprintable():
        raise LocalProtocolError(f"{text!r} holds control characters; use control() for them")
    if len(text) > ethernet.MAX_COMMAND:
        raise LocalProtocolError(
            f"a line holds at most {ethernet.MAX_COMMAND} characters, not {len(text)}",
            hint="Split it into several lines.",
        )
    return text.encode("ascii")


def encoded_lines(lines: Sequence[str]) -> list[bytes]:
    """Bytes of lines; as ``encoded``, looking at all of them at once."""
    text = "".join(lines)
    fits = max(map(len, lines), default=0) <= ethernet.MAX_COMMAND
    if fits and text.isascii() and text.isprintable():
        return [line.encode("ascii") for line in lines]
    return [encoded(line) for line in lines]  # raises for the line that cannot be sent


def accepted(reply: Reply, text: str) -> list[str]:
    """Lines of an answer that is whole and no refusal, else the error it stands for."""
    if reply.faults:
        raise garbled(reply, text)
    if reply.error is not None:
        raise refused(reply.error, text, reply.lines)
    return list(reply.lines)


def garbled(reply: Reply, text: str) -> RemoteProtocolError:
    """Error for an answer that cannot be read."""
    return RemoteProtocolError(
        f"the answer to '{text}' is garbled: {'; '.join(reply.faults)}",
        hint="Check the cable. If the line was a command, it may have been carried out.",
        context={"command": text, "faults": list(reply.faults)},
    )


def refused(error: int, text: str, lines: Sequence[str]) -> CommandRefused:
    """Error for a line that the controller refused; ``lines`` came before the refusal."""
    return CommandRefused(
        f"the controller refused '{text}': {error_meaning(error)}",
        code=error_text(error),
        hint=_ADVICE.get(error, ""),
        context={"command": text, "error": error, "lines": list(lines)},
    )


def batch_refused(
    batch: Sequence[bytes], start: int, verdict: ethernet.BufferVerdict
) -> CommandRefused:
    """Error for a refused line of a download that began with line ``start``."""
    number = verdict.line_number
    # The manual does not say whether lines count from 0 or from 1; sometimes the figure tells.
    local = sorted({k for k in (number - 1, number) if 0 <= k < len(batch)})
    candidates = [start + k for k in local]
    texts = " or ".join(f"'{batch[k].decode('ascii')}'" for k in local) or f"line {number}"
    error = verdict.error
    return CommandRefused(
        f"the controller refused {texts} during a download: {error_meaning(error)}",
        code=error_text(error),
        hint=_ADVICE.get(error, ""),
        context={
            "error": error,
            "line_index": candidates[0] if len(candidates) == 1 else None,
            "candidates": candidates,
            "lines_accepted": start,
        },
    )
