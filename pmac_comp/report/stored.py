"""Reports of stored results: what ``verify`` and ``demo`` left in a folder."""

import json
from pathlib import Path
from typing import Any

from pmac_comp import __version__
from pmac_comp.base.errors import ConfigError
from pmac_comp.report.page import Page, Section, Table, write_page

_MOST_DEPTH = 6
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
            f"{source} is not a stored result: {error}.",
            code="PC-REP-001",
            hint="Give the JSON file that verify, demo, identify or diagnose wrote.",
        ) from error
    if not isinstance(data, dict) or not _MARKS & data.keys():
        raise ConfigError(
            f"{source} is JSON, but not a result of this program.",
            code="PC-REP-002",
            hint="Give the JSON file that verify, demo, identify, compare, improve or diagnose "
            "wrote.",
        )
    simple = {k: v for k, v in data.items() if not isinstance(v, (dict, list))}
    sections = [Section("Result", tables=[Table(("item", "value"), list(simple.items()))])]
    sections += [
        Section(name, tables=_tables(value, 0))
        for name, value in data.items()
        if isinstance(value, (dict, list)) and value
    ]
    simulated = "Simulated controller and drive." if data.get("simulated") else ""
    page = Page(
        title=str(data.get("kind", data.get("verdict", "result"))).capitalize(),
        subtitle=source.name,
        notice=simulated,
        sections=sections,
        facts={"pmac-comp": __version__, "file": str(source)},
    )
    return write_page(page, out)


def _tables(value: Any, depth: int) -> list[Table]:
    if depth > _MOST_DEPTH:
        return []
    if isinstance(value, list):
        if all(isinstance(item, dict) for item in value) and value:
            columns = list(dict.fromkeys(key for item in value for key in item))
            rows = [[_flat(item.get(key)) for key in columns] for item in value]
            return [Table(columns, rows)]
        return [Table(("value",), [(_flat(item),) for item in value])]
    rows_of: dict[str, Any] = dict(value)
    if rows_of and all(isinstance(v, dict) for v in rows_of.values()):
        columns = list(dict.fromkeys(key for item in rows_of.values() for key in item))
        body = [[name, *(_flat(v.get(key)) for key in columns)] for name, v in rows_of.items()]
        return [Table(("name", *columns), body)]
    return [Table(("item", "value"), [(k, _flat(v)) for k, v in rows_of.items()])]


def _flat(value: Any) -> Any:
    if isinstance(value, dict):
        return ", ".join(f"{k} {_flat(v)}" for k, v in value.items())
    if isinstance(value, list):
        return ", ".join(str(_flat(item)) for item in value[:20])
    return f"{value:.4g}" if isinstance(value, float) else value
