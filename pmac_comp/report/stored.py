"""Reports of stored results: what ``verify`` and ``demo`` left in a folder."""

import json
from pathlib import Path
from typing import Any

from pmac_comp import __version__
from pmac_comp.base.errors import ConfigError
from pmac_comp.base.reading import why
from pmac_comp.report.page import Page, Section, Table, write_page

_MOST_DEPTH = 6
_MOST_COLUMNS = 8  # of a table on a page; records with more are shown side by side
_TO_CENTI = 1e3  # from here on four digits would hide hundredths
_FIGURES = (
    "This page lists the stored figures. The page with plots and the sheet of ISO 230-2 is made "
    "from the runs: `pmac-comp verify --before FOLDER --after FOLDER --bench FILE "
    "--compensation FILE --model FILE --report FILE`."
)
_MOST_SHOWN = 20  # of a list in one cell
_HINT = "Give the JSON file that verify, demo, identify, compare, improve or diagnose wrote."
_MARKS = {"kind", "verdict"}  # each result has one of them


def report_from_file(source: Path, out: Path) -> Path:
    """HTML page of a stored JSON result; every figure of the file is in it.

    Raises
    ------
    ConfigError
        Not a JSON result of this program.
    """
    try:
        data = json.loads(source.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"{source} is not a stored result: {why(error)}.",
            code="PC-REP-001",
            hint=_HINT,
        ) from error
    if not isinstance(data, dict) or not _MARKS & data.keys():
        raise ConfigError(
            f"{source} is JSON, but not a result that was stored with --json (a model or a "
            "compensation file is none).",
            code="PC-REP-002",
            hint=_HINT,
        )
    simple = {k: v for k, v in data.items() if not isinstance(v, (dict, list))}
    result = Table(("item", "value"), list(simple.items()))
    text = [_FIGURES] if data.get("kind") == "verification" else []
    sections = [Section("Result", text=text, tables=[result])]
    sections += [
        Section(name, tables=_tables(value, 0), open=name != "files")
        for name, value in data.items()
        if isinstance(value, (dict, list)) and value
    ]
    page = Page(
        title=str(data.get("kind", data.get("verdict", "result"))).capitalize(),
        subtitle=source.name,
        notice=_notice(data),
        sections=sections,
        facts={"pmac-comp": __version__, "file": str(source)},
    )
    return write_page(page, out)


def _notice(data: dict[str, Any]) -> str:
    """Where the figures of a result come from, as far as it says so."""
    sources = data.get("sources")
    if isinstance(sources, list) and any(sources):
        return f"Source of the captures: {'; '.join(str(s) for s in sources if s)}."
    return "Simulated controller and drive." if _is_simulated(data) else ""


def _is_simulated(value: Any) -> bool:
    """Whether a result, or a part of it, says that it is simulated.

    What one would do otherwise is always simulated, beside captures of a real axis too.
    """
    if isinstance(value, dict):
        parts = (part for key, part in value.items() if key != "alternatives")
        return value.get("simulated") is True or any(_is_simulated(part) for part in parts)
    return False


def _tables(value: Any, depth: int, caption: str = "") -> list[Table]:
    """Tables of a part of a result: what is nested gets a table of its own under its name."""
    if depth > _MOST_DEPTH:
        return []
    if isinstance(value, list):
        if value and all(isinstance(item, dict) for item in value):
            return [_records([_spread(item) for item in value], caption)]
        return [Table(("value",), [(_flat(item),) for item in value], caption)]
    rows_of: dict[str, Any] = dict(value)
    if rows_of and all(isinstance(v, dict) for v in rows_of.values()):
        return [_records([{"name": k, **_spread(v)} for k, v in rows_of.items()], caption)]
    nested = {k: v for k, v in rows_of.items() if isinstance(v, (dict, list)) and v}
    simple = [(k, _flat(v)) for k, v in rows_of.items() if k not in nested]
    tables = [Table(("item", "value"), simple, caption)] if simple else []
    for name, inner in nested.items():
        tables += _tables(inner, depth + 1, f"{caption}: {name}" if caption else name)
    return tables


def _records(records: list[dict[str, Any]], caption: str) -> Table:
    columns = list(dict.fromkeys(key for record in records for key in record))
    if len(columns) > _MOST_COLUMNS and len(records) < _MOST_COLUMNS:
        names = [_flat(r.get(columns[0])) for r in records]
        rows = [[key, *(_flat(r.get(key)) for r in records)] for key in columns[1:]]
        return Table((columns[0], *names), rows, caption)
    return Table(columns, [[_flat(r.get(key)) for key in columns] for r in records], caption)


def _spread(record: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """A record with the entries of its nested mappings as columns of their own."""
    out: dict[str, Any] = {}
    for key, value in record.items():
        name = f"{prefix}{key}"
        out |= _spread(value, f"{name}: ") if isinstance(value, dict) else {name: value}
    return out


def _flat(value: Any) -> Any:
    if isinstance(value, dict):
        return ", ".join(f"{k} {_flat(v)}" for k, v in value.items())
    if isinstance(value, list):
        shown = ", ".join(str(_flat(item)) for item in value[:_MOST_SHOWN])
        more = len(value) - _MOST_SHOWN
        return f"{shown} and {more} more" if more > 0 else shown
    if isinstance(value, float):
        return f"{value:.2f}" if abs(value) >= _TO_CENTI else f"{value:.4g}"
    return value
