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

What lives here: error classes and a group of them only. ``message`` says what happened, ``hint``
what to do next, ``left`` the state in which a mutating call left the controller. An error that is
raised without a hint gives the advice of its class, and one without a code that of its class; codes
never change.
"""

from collections.abc import Mapping
from enum import Enum
from typing import ClassVar, Final

USER_CODE_ERRORS: Final = (
    ArithmeticError,
    AssertionError,
    AttributeError,
    ImportError,
    LookupError,
    NameError,
    OSError,
    RuntimeError,
    SyntaxError,
    TypeError,
    ValueError,
)
"""What code of a user's own (a plant, an effect) raises when it is wrong."""


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
        Stable identifier of what happened, e.g. ``PC-TBL-012``; where none is given, that of the
        class.
    hint : str
        What to do next; where nothing is given, the usual advice of the class is.
    context : Mapping[str, object] or None
        Figures and names for ``--json``.
    left : ControllerState or None
        State of the controller after a failed mutating call.
    """

    exit_code: ClassVar[int] = 70
    usual_code: ClassVar[str] = "PC-BUG-000"
    usual_advice: ClassVar[str] = ""

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
        self.code = code or self.usual_code
        self.hint = hint
        self.context: dict[str, object] = dict(context or {})
        self.left = left

    @property
    def advice(self) -> str:
        """What to do next: the hint of this error, or what usually helps with its kind."""
        return self.hint or self.usual_advice

    def described(self, advice: str) -> str:
        """What happened, what was left and the advice given, each on a line of its own."""
        text = f"{self.message} ({self.code})"
        if self.left is not None:
            # Nothing was touched: tables of an earlier upload may be NEW, and stand.
            as_found = ", as before this command" if self.context.get("untouched") else ""
            is_old = self.left is ControllerState.OLD
            text += f"\nThe controller was left: {self.left.value}{as_found if is_old else ''}."
        return f"{text}\n{advice}" if advice else text

    def __str__(self) -> str:
        return self.described(self.advice)


class ConfigError(PmacCompError):
    """A file or option is wrong: unknown key, missing unit, value out of range."""

    exit_code = 2
    usual_code = "PC-CFG-000"
    usual_advice = "Correct the file or option named and run the command again."


class LinkError(PmacCompError):
    """The connection could not be made or was lost."""

    exit_code = 3
    usual_code = "PC-LNK-000"
    usual_advice = (
        "`pmac-comp info URL` tells whether the controller answers; check address, cable and power."
    )


class ConnectFailed(LinkError):
    """Nobody answered at the address, or what answered is not a PMAC."""

    usual_code = "PC-LNK-001"


class LinkLost(LinkError):
    """An open connection ended."""

    usual_code = "PC-LNK-002"
    usual_advice = (
        "Check cable and power. If the controller was being changed, run `pmac-comp recover`; "
        "otherwise run the command again."
    )


class ReplyTimeout(LinkError):
    """No complete reply before the deadline."""

    usual_code = "PC-LNK-003"
    usual_advice = (
        "`pmac-comp info URL` tells whether the controller still answers. If it was being "
        "changed, run `pmac-comp recover`."
    )


class HostKeyRefused(LinkError):
    """The SSH host key is unknown or has changed."""

    usual_code = "PC-LNK-004"


class ProtocolError(PmacCompError):
    """Bytes that do not belong to the protocol."""

    exit_code = 4
    usual_code = "PC-PRO-000"
    usual_advice = (
        "Run the command again with `?record=FILE` behind the URL: the session kept there "
        "shows what was said."
    )


class LocalProtocolError(ProtocolError):
    """We asked the protocol layer for something that cannot be said."""

    usual_code = "PC-PRO-001"
    usual_advice = "Correct the line or value; nothing of it was sent."


class RemoteProtocolError(ProtocolError):
    """The peer said something that cannot be understood."""

    usual_code = "PC-PRO-002"


class CommandRefused(PmacCompError):
    """The controller answered BELL/ERRnnn."""

    exit_code = 5
    usual_code = "PC-ERR-000"
    usual_advice = (
        "`pmac-comp status URL` shows the state of motors and buffers that the controller "
        "refuses it in."
    )


class SafetyRefusal(PmacCompError):
    """A safety rule forbids the request; ``refusals`` holds every rule that did.

    Parameters
    ----------
    refusals : tuple of SafetyRefusal
        All refusals of one pre-flight, reported together.
    """

    exit_code = 6
    usual_code = "PC-SAF-000"
    usual_advice = "Remove the reason; the limits stand in [safety] and [travel] of the bench file."

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
        # With several refusals, each says what is special about it; general advice stands once.
        each = [
            refusal.described(refusal.hint).replace("\n", "\n    ") for refusal in self.refusals
        ]
        return "\n".join([super().__str__(), *(f"  - {text}" for text in each)])


class AmplitudeExceeded(SafetyRefusal):
    """A correction is larger than the configured amplitude."""


class SlopeExceeded(SafetyRefusal):
    """A correction changes faster along the travel than configured."""


class MotorNotSafe(SafetyRefusal):
    """A motor concerned moves, is tripped or is in the wrong state."""

    usual_advice = (
        "`pmac-comp status URL` shows the motors; bring them into the state that is asked for."
    )


class ForeignChange(SafetyRefusal):
    """Somebody else changed what we were about to change."""

    usual_advice = "Find out who else writes to this controller, then run the command again."


class LeaseHeld(SafetyRefusal):
    """Another writer holds the lease on this controller."""

    usual_advice = "`pmac-comp status URL` says who holds the lease; wait until that is done."


class TableStateError(PmacCompError):
    """The controller does not hold the table or bank that was meant."""

    exit_code = 7
    usual_code = "PC-TBL-000"
    usual_advice = (
        "`pmac-comp status URL` shows what stands; `pmac-comp recover` settles an unfinished "
        "change."
    )


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
    usual_code = "PC-CAP-000"
    usual_advice = "Capture again, or check that the file is the one meant and whole."


class GatherOverflow(CaptureError):
    """The gather ring overran the host."""


class SampleGap(CaptureError):
    """Samples are missing or doubled."""


class StorageFull(CaptureError):
    """The disk took no more data."""


class ModelError(PmacCompError):
    """The data and the model do not give an answer."""

    exit_code = 9
    usual_code = "PC-MOD-000"
    usual_advice = (
        "Check that captures, model and bench file belong together; `pmac-comp config check` "
        "looks at the bench file."
    )


class NotIdentifiable(ModelError):
    """The captures do not determine a parameter; the hint names the run that would."""


class DidNotConverge(ModelError):
    """An iteration ended without meeting its stop rule."""


class NonFinite(ModelError):
    """NaN or infinity in an input or a result."""


class InternalError(PmacCompError):
    """A bug of ours; the message asks for the journal."""

    exit_code = 70
