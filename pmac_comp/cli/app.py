"""The command line: parse, call ``workflow``, render. No logic and no numbers here.

What lives here: the list of commands, the way errors become exit codes, and the option ``--json``
that every command has. Commands sit in one module per group and load the rest on use, so that
``--help`` stays quick.
"""

import errno
import io
import signal
import sys
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, NoReturn

import typer
from typer.core import TyperCommand

from pmac_comp import __version__
from pmac_comp.base.errors import (
    ChangeInterrupted,
    ConfigError,
    InternalError,
    PmacCompError,
    StorageFull,
)
from pmac_comp.base.reading import why
from pmac_comp.cli import compensation, controller, drive, output, simulation, tools
from pmac_comp.cli.progress import ProgressLines

_INTERRUPTED = 130
CHANGING = frozenset(
    {"upload", "recover", "rollback", "restore", "improve", "verify", "capture", "setup", "remove"}
)
# Ctrl-C meets them measuring: an upload of `improve` that it ends tells itself what was left.
_MOVING = frozenset({"capture", "verify", "improve"})
app = typer.Typer(
    name="pmac-comp",
    help="Make a ball-screw axis on a Turbo PMAC follow its command at the table.",
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog="First try: `pmac-comp demo`. Controllers are named by URL: sim:// tcp://host:1025 "
    "udp://host:1025 serial:///dev/ttyS0?baud=38400 ssh://user@gateway/host:1025\n\n"
    "Exit codes: 0 done, 2 usage or configuration, 3 connection, 4 protocol, 5 command refused, "
    "6 safety, 7 state of tables, 8 capture, 9 model, 70 bug, 130 interrupted. An error says what "
    "happened, its code (PC-...) and what to do; with --json it is a document too.",
)


class _Command(TyperCommand):
    """A command that is refused before it begins where its result could not be kept."""

    def invoke(self, ctx: Any) -> Any:
        output.refuse_one_file_twice(self.name or "", ctx.params)
        output.refuse_unusable_targets(self.name or "", ctx.params)
        return super().invoke(ctx)


for group in (simulation, controller, drive, compensation, tools):
    group.register(app)
for command in (*app.registered_commands, *tools.config_app.registered_commands):
    command.cls = _Command


@app.callback(invoke_without_command=True)
def _root(
    version: bool = typer.Option(False, "--version", help="Print the version and stop."),
) -> None:
    if version:
        typer.echo(__version__)
        raise typer.Exit


def _interrupted(words: Sequence[str]) -> str:
    command = next(iter(words), "")
    if command not in CHANGING:
        return "interrupted"
    if "--dry-run" in words:
        return "interrupted; a rehearsal changes nothing"
    if command in _MOVING:
        return (
            "interrupted; the axis was stopped and is left as `pmac-comp status` shows it. If it "
            "does not answer or says that something is left open: `pmac-comp recover`, with the "
            "same URL, bench and journal."
        )
    return (
        "interrupted at once. If the change had begun, what the controller was left with is "
        "unconfirmed: run `pmac-comp status`, then `pmac-comp recover`, with the same URL, bench "
        "and journal."
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command and leave with its exit code (0 done, 2..9 and 70 by error class)."""
    words = output.spell_out_json(list(sys.argv[1:] if arguments is None else arguments))
    words = output.spell_out_lists(words)
    _end_in_order()
    try:
        try:
            app(args=words, prog_name="pmac-comp")
        finally:
            sys.stdout.flush()
    except PmacCompError as error:
        _fail(error, words)
    except KeyboardInterrupt as ended:
        _say_interrupted(words, ended)
        sys.exit(_INTERRUPTED)
    except SystemExit as left:
        if left.code == _INTERRUPTED:  # typer has taken the Ctrl-C and says nothing
            _say_interrupted(words, left)
        if isinstance(left.__context__, BrokenPipeError):  # typer leaves with 1 then
            _end_unread(words)
        if left.code == ConfigError.exit_code:
            _write_usage(left.__context__, words)
        raise
    except BrokenPipeError:
        _end_unread(words)
    except OSError as error:
        _fail(_as_refusal(error) if _is_of_the_user(error) else _as_bug(error), words)
    except Exception as error:
        _fail(_as_bug(error), words)


def _fail(error: PmacCompError, words: Sequence[str]) -> NoReturn:
    """End with an error, for people and where ``--json`` asks for it."""
    output.show_error(error, output.JSON_STDOUT in words)
    output.keep_error(error, words)
    sys.exit(error.exit_code)


def _write_usage(error: BaseException | None, words: Sequence[str]) -> None:
    """What typer has said of wrong usage, as the document that ``--json`` asks for."""
    told = getattr(error, "format_message", None)
    if told is None:
        return
    refused = ConfigError(told(), code="PC-CLI-005", hint="`--help` tells the usage.")
    if output.JSON_STDOUT in words:
        output.write_json("-", {"error": output.describe_error(refused)})
    output.keep_error(refused, words)


def _say_interrupted(words: Sequence[str], ended: BaseException) -> None:
    """What an interruption left: what holds for the command, then what this one noted."""
    ProgressLines.stop()
    told = [_interrupted(words)]
    cause: BaseException | None = ended
    while cause is not None:
        told += [f"  {note}" for note in getattr(cause, "__notes__", [])]
        cause = cause.__cause__ or cause.__context__
    for line in told:
        output.say(line)
    hint = "" if next(iter(words), "") in CHANGING else "Run it again: nothing was changed."
    error = ChangeInterrupted("\n".join(told), code="PC-CLI-006", hint=hint)
    if output.JSON_STDOUT in words:
        output.write_json("-", {"error": output.describe_error(error)})
    output.keep_error(error, words)


def _end_unread(words: Sequence[str]) -> NoReturn:
    """End where nobody reads on: the command may have been stopped on its way."""
    ProgressLines.stop()
    # What is still in the buffer would fail once more when Python ends.
    sys.stdout = io.StringIO()
    if next(iter(words), "") in CHANGING:
        with suppress(OSError):
            output.say(_interrupted(words))
    sys.exit(_INTERRUPTED)


def _end_in_order() -> None:
    """SIGTERM and a closed terminal end as by Ctrl-C; ``nohup`` keeps its meaning."""
    for name in ("SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, signal.default_int_handler)


_FULL = frozenset({errno.ENOSPC, errno.EDQUOT})
_OF_THE_FOLDER = _FULL | {errno.EROFS, errno.ENAMETOOLONG, errno.EFBIG, errno.ELOOP}


def _is_of_the_user(error: OSError) -> bool:
    """Whether a path, a right or a disk is at fault, and not the program."""
    by_class = (
        FileExistsError,
        FileNotFoundError,
        IsADirectoryError,
        NotADirectoryError,
        PermissionError,
    )
    return isinstance(error, by_class) or error.errno in _OF_THE_FOLDER


def _as_refusal(error: OSError) -> PmacCompError:
    """A file that cannot be used as asked: the user's to settle, not a bug."""
    if error.errno in _FULL:
        return StorageFull(
            f"{error.filename or 'A file'} could not be written: {why(error)}.",
            code="PC-CLI-013",
            hint="Free space or name another folder, and run the command again.",
        )
    return ConfigError(
        f"{error.filename or 'A file'} cannot be used: {why(error)}.",
        code="PC-CLI-003",
        hint="Check the path and its permissions.",
    )


def _as_bug(error: Exception) -> InternalError:
    """The unforeseen as a bug report: where it happened, without a page of traceback."""
    place: Any = error.__traceback__
    while place is not None and place.tb_next is not None:
        place = place.tb_next
    where = f"{place.tb_frame.f_code.co_filename}:{place.tb_lineno}" if place else "unknown place"
    return InternalError(
        f"{type(error).__name__} at {where}: {error}",
        code="PC-BUG-001",
        hint="This is a bug of pmac-comp. Please report it with this line and, after an upload, "
        "the journal.",
    )
