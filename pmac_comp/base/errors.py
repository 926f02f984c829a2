"""The one error tree.

::

    PmacCompError(message, code, hint, context, left)
      ConfigError       exit 2   bad file, unknown key, unit missing
      LinkError         exit 3   ConnectFailed, LinkLost, ReplyTimeout, HostKeyRefused
      ProtocolError     exit 4   LocalProtocolError (our fault), RemoteProtocolError (the peer's)
      CommandRefused    exit 5   BELL/ERRnnn with the line, the command and its meaning
      SafetyRefusal     exit 6   AmplitudeExceeded, SlopeExceeded, MotorNotSafe,
                                 ForeignChange, LeaseHeld
      TableStateError   exit 7   UploadIncomplete, VerifyMismatch, FlashSuspect
                        exit 130 ChangeInterrupted (Ctrl-C)
      CaptureError      exit 8   GatherOverflow, SampleGap, StorageFull
      ModelError        exit 9   NotIdentifiable, DidNotConverge, NonFinite
      InternalError     exit 70  a bug; asks for the journal

What lives here: error classes only. ``message`` says what happened, ``hint`` what to do next,
``left`` the state in which a mutating call left the controller.
"""

from collections.abc import Mapping
from enum import Enum
from typing import ClassVar


class ControllerState(Enum):
    """Verdict of a call that changes the controller; there is no fourth word."""

    OLD = "OLD"
    NEW = "NEW"
    DISABLED = "DISABLED"


class PmacCompError(Exception):
    """Root of all errors that a user may see.

    Parameters
    ----------
    message : str
        What happened.
    code : str
        Stable identifier, e.g. ``PC-TBL-012``.
    hint : str
        What to do next.
    context : Mapping[str, object] or None
        Figures and names for ``--json``.
    left : ControllerState or None
        State of the controller after a failed mutating call.
    """

    exit_code: ClassVar[int] = 70

    def __init__(
        self,
        message: str,
        *,
        code: str = "",
        hint: str = "",
        context: Mapping[str, object] | None = None,
        left: ControllerState | None = None,
    ) -> None:
        super().__init__(message)
        self.message = message
        self.code = code
        self.hint = hint
        self.context: dict[str, object] = dict(context or {})
        self.left = left

    def __str__(self) -> str:
        text = f"{self.message} ({self.code})" if self.code else self.message
        if self.left is not None:
            text += f"\nThe controller was left: {self.left.value}."
        return f"{text}\n{self.hint}" if self.hint else text


class ConfigError(PmacCompError):
    """A file or option is wrong: unknown key, missing unit, value out of range."""

    exit_code = 2


class LinkError(PmacCompError):
    """The connection could not be made or was lost."""

    exit_code = 3


class ConnectFailed(LinkError):
    """Nobody answered at the address, or what answered is not a PMAC."""


class LinkLost(LinkError):
    """An open connection ended."""


class ReplyTimeout(LinkError):
    """No complete reply before the deadline."""


class HostKeyRefused(LinkError):
    """The SSH host key is unknown or has changed."""


class ProtocolError(PmacCompError):
    """Bytes that do not belong to the protocol."""

    exit_code = 4


class LocalProtocolError(ProtocolError):
    """We asked the protocol layer for something that cannot be said."""


class RemoteProtocolError(ProtocolError):
    """The peer said something that cannot be understood."""


class CommandRefused(PmacCompError):
    """The controller answered BELL/ERRnnn."""

    exit_code = 5


class SafetyRefusal(PmacCompError):
    """A safety rule forbids the request; ``refusals`` holds every rule that did.

    Parameters
    ----------
    refusals : tuple of SafetyRefusal
        All refusals of one pre-flight, reported together.
    """

    exit_code = 6

    def __init__(
        self,
        message: str,
        *,
        code: str = "",
        hint: str = "",
        context: Mapping[str, object] | None = None,
        left: ControllerState | None = None,
        refusals: tuple["SafetyRefusal", ...] = (),
    ) -> None:
        super().__init__(message, code=code, hint=hint, context=context, left=left)
        self.refusals = refusals

    def __str__(self) -> str:
        own = super().__str__()
        return "\n".join([own, *(f"  - {refusal}" for refusal in self.refusals)])


class AmplitudeExceeded(SafetyRefusal):
    """A correction is larger than the configured amplitude."""


class SlopeExceeded(SafetyRefusal):
    """A correction changes faster along the travel than configured."""


class MotorNotSafe(SafetyRefusal):
    """A motor concerned moves, is tripped or is in the wrong state."""


class ForeignChange(SafetyRefusal):
    """Somebody else changed what we were about to change."""


class LeaseHeld(SafetyRefusal):
    """Another writer holds the lease on this controller."""


class TableStateError(PmacCompError):
    """The controller does not hold the table or bank that was meant."""

    exit_code = 7


class UploadIncomplete(TableStateError):
    """An upload ended before its last step."""


class ChangeInterrupted(UploadIncomplete):
    """Somebody asked for an end while a controller was changed; it came at the next safe place."""

    exit_code = 130


class VerifyMismatch(TableStateError):
    """What was read back is not what was written."""


class FlashSuspect(TableStateError):
    """The controller came up with something else than its saved configuration."""


class CaptureError(PmacCompError):
    """A capture is incomplete or could not be stored."""

    exit_code = 8


class GatherOverflow(CaptureError):
    """The gather ring overran the host."""


class SampleGap(CaptureError):
    """Samples are missing or doubled."""


class StorageFull(CaptureError):
    """The disk took no more data."""


class ModelError(PmacCompError):
    """The data and the model do not give an answer."""

    exit_code = 9


class NotIdentifiable(ModelError):
    """The captures do not determine a parameter; the hint names the run that would."""


class DidNotConverge(ModelError):
    """An iteration ended without meeting its stop rule."""


class NonFinite(ModelError):
    """NaN or infinity in an input or a result."""


class InternalError(PmacCompError):
    """A bug of ours; the message asks for the journal."""

    exit_code = 70
