"""What commands print: JSON, tables, progress and errors, all text escaped.

What lives here: rendering only. Standard output carries the result (a table, or one JSON
document), standard error carries progress (``progress``) and errors, so that results can be piped.
"""

import os
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from pmac_comp.base.documents import document, plain
from pmac_comp.base.errors import ConfigError, PmacCompError, SafetyRefusal
from pmac_comp.base.reading import why
from pmac_comp.cli.progress import LOCK, ProgressLines, end_line, printable

JSON_STDOUT = "--json=-"
_WHOLE_BELOW = 1e7  # counts are shown to the last one
_ROUNDED_FROM = 1e4  # of which fractions say nothing


def spell_out_json(words: list[str]) -> list[str]:
    """Words of the command line with a bare ``--json`` written as ``--json=-``.

    A following word is taken as the file only if it ends in ``.json``; then it is an output and
    never an input.
    """
    out: list[str] = []
    rest = iter(range(len(words)))
    for i in rest:
        if words[i] != "--json":
            out.append(words[i])
            continue
        following = words[i + 1] if i + 1 < len(words) else ""
        if following.endswith(".json") or following == "-":
            out.append(f"--json={following}")
            next(rest, None)
        else:
            out.append(JSON_STDOUT)
    return out


_LISTS = {
    "diagnose": ("--validate",),
    "compare": ("--validate",),
    "compensate": ("--slow", "--captures"),
    "verify": ("--before", "--after"),
}


def spell_out_lists(words: list[str]) -> list[str]:
    """Words of the command line with ``--validate A B`` written as ``--validate A --validate B``.

    What a shell makes of ``--validate runs/*.h5`` goes to that option as a whole. Without this its
    second file would silently be one more capture for fitting.
    """
    options = _LISTS.get(words[0], ()) if words else ()
    out: list[str] = []
    current, filled = "", False
    for word in words:
        if word.startswith("-") and word != "-":
            current, filled = (word if word in options else ""), False
        elif current and filled:
            out.append(current)
        else:
            filled = True
        out.append(word)
    return out


WRITTEN = ("out", "target", "report", "plot", "json_target")  # parameters that name a result


def refuse_one_file_twice(command: str, parameters: Mapping[str, Any]) -> None:
    """Refuse a result that would be written over a file that the same command is given.

    Raises
    ------
    ConfigError
        An output is an input as well, or two outputs are one file; nothing was read or written.
    """
    written = [path for _, path in _written(command, parameters)]
    given = [p for name, value in parameters.items() if name not in WRITTEN for p in _paths(value)]
    for i, path in enumerate(written):
        if (path in given and path.is_file()) or path in written[:i]:
            raise ConfigError(
                f"{path.name} is named twice: the result would be written over it.",
                code="PC-CLI-014",
                hint="Name another file for the result. Nothing was written.",
            )


def _written(command: str, parameters: Mapping[str, Any]) -> list[tuple[str, Path]]:
    """Files that a command will write, each with the parameter that names it."""
    found = [(name, path) for name in WRITTEN for path in _paths(parameters.get(name))]
    if command == "diagnose":  # the grown model lies beside its result
        results = _paths(parameters.get("json_target"))
        found += [("model", path.with_suffix(".model.json")) for path in results]
    return found


_FOLDERS = frozenset({"capture", "demo", "improve", "verify"})  # whose --out is one
# Files that a command replaces by a newer one of their kind.
_RENEWED = {
    ("compensate", "out"): "compensation",
    ("identify", "out"): "model",
    ("diagnose", "model"): "model",
}


def refuse_unusable_targets(command: str, parameters: Mapping[str, Any]) -> None:
    """Refuse a result that could not be written, before minutes of work are spent on it.

    Nothing is made yet: a command that is refused for another reason leaves nothing behind.
    """
    for name, path in _written(command, parameters):
        if name == "out" and command in _FOLDERS:
            continue
        _refuse_folder(path)
        place = next(above for above in path.parents if above.exists())
        if not place.is_dir() or not os.access(place, os.W_OK | os.X_OK):
            wrong = "this user may not write there" if place.is_dir() else "it is a file"
            raise _no_folder(place, wrong)
        _refuse_other_kind(path, _RENEWED.get((command, name), ""))


def _refuse_other_kind(path: Path, own: str) -> None:
    """Refuse to replace a file that others build on by something else; only its own kind may."""
    if not path.is_file():
        return
    from pmac_comp.files.kinds import kind_to_keep

    kind = kind_to_keep(path)
    if kind == "capture":
        raise _holds_runs(path)
    if kind not in {"", own}:
        raise ConfigError(
            f"There is a {kind} {path} already; the result would be written over it.",
            code="PC-CLI-040",
            hint="Name another file for the result, or remove that one first. Nothing was "
            "written over.",
        )


def _refuse_folder(path: Path) -> None:
    if path.is_dir():
        raise ConfigError(
            f"{path} is a folder, a file name is needed.",
            code="PC-CLI-002",
            hint="Name the file to be written.",
        )


def _no_folder(folder: Path, wrong: str) -> ConfigError:
    return ConfigError(
        f"The folder {folder} cannot be used: {wrong}.",
        code="PC-CLI-001",
        hint="Name a folder that can be written.",
    )


def _holds_runs(path: Path) -> ConfigError:
    return ConfigError(
        f"There is a capture {path} already; the run that it holds cannot be measured again.",
        code="PC-CLI-015",
        hint="Name another file for the result, or remove that one first. Nothing was "
        "written over.",
    )


def _paths(value: Any) -> list[Path]:
    """What a parameter may name as files: one, several or none."""
    values = value if isinstance(value, (list, tuple)) else [value]
    return [Path(v).resolve() for v in values if isinstance(v, (str, Path)) and v not in {"", "-"}]


def write_json(target: str, result: Any) -> None:
    """One JSON document to standard output (``-``) or whole into a file."""
    text = document(result)
    if target == "-":
        sys.stdout.write(text)
        sys.stdout.flush()
        return
    from pmac_comp.base.atomic import atomic_write_text

    atomic_write_text(checked_target(Path(target)), text)


def checked_target(path: Path) -> Path:
    """Path of an output whose folder exists; parents are made.

    Raises
    ------
    ConfigError
        The folder cannot be made, the path is a folder, or a file there holds a captured run.
    """
    from pmac_comp.files.capture import holds_runs

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _no_folder(path.parent, why(error)) from error
    _refuse_folder(path)
    if holds_runs(path):
        raise _holds_runs(path)
    return path


def finish(result: Any, json_target: str, show: Callable[[], None]) -> None:
    """Result as JSON where asked for; the table for people unless standard output is taken."""
    if json_target:
        write_json(json_target, result)
    if json_target != "-":
        show()


def finish_with_report(
    result: Any, lines: Callable[[], Iterable[str]], json_target: str, report: Path | None
) -> None:
    """Result as ``finish`` gives it, for people as lines and the name of the report written."""

    def show() -> None:
        echo_all(lines())
        if report is not None:
            echo(f"report: {report}")

    finish(result, json_target, show)


def say(text: str) -> None:
    """One line for people on standard error, below a progress line that stands there."""
    with LOCK:
        if ProgressLines.is_open:
            end_line()
        sys.stderr.write(printable(text) + "\n")
        sys.stderr.flush()


def echo(text: str = "") -> None:
    """One line of the result on standard output."""
    sys.stdout.write(printable(text) + "\n")


def echo_all(lines: Iterable[str]) -> None:
    """Lines of the result on standard output."""
    for line in lines:
        echo(line)


def echo_now(lines: Iterable[str]) -> None:
    """Lines of the result that somebody behind a pipe waits for."""
    echo_all(lines)
    sys.stdout.flush()


def table(title: str, columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Plain aligned table on standard output; works in a pipe as in a terminal."""
    cells = [[printable(_cell(value)) for value in row] for row in rows]
    widths = [max([len(name), *(len(row[i]) for row in cells)]) for i, name in enumerate(columns)]
    if title:
        echo(title)
    echo("  " + "  ".join(name.ljust(w) for name, w in zip(columns, widths, strict=True)).rstrip())
    for row in cells:
        line = "  ".join(text.ljust(w) for text, w in zip(row, widths, strict=True))
        echo("  " + line.rstrip())


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        whole = value.is_integer() and abs(value) < _WHOLE_BELOW
        large = _ROUNDED_FROM <= abs(value) < _WHOLE_BELOW
        return f"{value:z.0f}" if whole or large else f"{value:.4g}"
    return str(value)


def show_error(error: PmacCompError, as_json: bool) -> None:
    """Error as what happened and what to do; as JSON on standard output where that was asked."""
    ProgressLines.stop()
    say(f"error: {error}")
    for note in getattr(error, "__notes__", []):
        say(f"  {note}")
    if as_json:
        write_json("-", {"error": describe_error(error)})


_UNUSABLE = frozenset({"PC-CLI-001", "PC-CLI-002", "PC-CLI-014", "PC-CLI-015", "PC-CLI-040"})


def keep_error(error: PmacCompError, words: Iterable[str]) -> None:
    """Error as JSON in the file of ``--json``: an earlier result there would be taken for this one.

    Not where the error is that this file cannot be used, or is an input. With wrong usage nobody
    has looked at that yet.
    """
    targets = [word.removeprefix("--json=") for word in words if word.startswith("--json=")]
    others = [word.rpartition("=")[2] for word in words if not word.startswith("--json=")]
    if not targets or targets[-1] == "-" or error.code in _UNUSABLE:
        return
    with suppress(PmacCompError, OSError):
        target = Path(targets[-1])
        if target.resolve() not in _paths(others):
            _refuse_other_kind(target, "")
            write_json(targets[-1], {"error": describe_error(error)})


def describe_error(error: PmacCompError) -> dict[str, Any]:
    """Error as a mapping for ``--json``."""
    described: dict[str, Any] = {
        "class": type(error).__name__,
        "code": error.code,
        "message": error.message,
        "hint": error.advice,
        "exit_code": error.exit_code,
        "left": None if error.left is None else error.left.value,
        "context": plain(error.context),
    }
    if isinstance(error, SafetyRefusal) and error.refusals:
        described["refusals"] = [describe_error(item) for item in error.refusals]
    return described
