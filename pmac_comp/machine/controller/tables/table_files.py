"""Tables in files: as JSON values, as sealed backups, and as journals name them."""

import time
from pathlib import Path

from pmac_comp.base.errors import ConfigError
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.change.journals import DONE, ChangeKind, journals
from pmac_comp.machine.controller.change.sealed_json import read_sealed_json, write_sealed_json
from pmac_comp.machine.controller.contents.comp_table import (
    BacklashTable,
    CompTable,
    Table,
    TableKind,
    TorqueTable,
)
from pmac_comp.machine.controller.contents.table_set import TableSet


def write_table_backup(path: Path, tables: TableSet, *, enabled: bool) -> None:
    """Store a set with its switch; synced, read again and compared."""
    write_sealed_json(
        path,
        {
            "kind": "tables",
            "enabled": int(enabled),
            "crc": tables.crc,
            "written_utc": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
            "tables": [table_to_json(t) for t in tables],
        },
    )


def table_to_json(table: Table) -> dict[str, object]:
    """A table as JSON; its entries as the card lists them, which is at hand and half as long."""
    data: dict[str, object] = {
        "kind": table.kind.value,
        "motor": table.motor,
        "span_ct": table.span_ct,
        "wrap": int(table.wrap),
        "entries": table.listed,
    }
    if isinstance(table, CompTable):
        data |= {
            "source": table.source,
            "target": table.target,
            "by_desired": int(table.by_desired),
        }
    return data


def table_from_json(data: object) -> Table:
    """A table from JSON, its entries as text or as a list; ConfigError on anything unexpected."""
    try:
        item = dict(data)  # type: ignore[call-overload]
        kind = TableKind(item["kind"])
        listed = item["entries"]
        entries = tuple(map(int, listed.split() if isinstance(listed, str) else listed))
        common = (int(item["motor"]), entries, int(item["span_ct"]), bool(item["wrap"]))
        if kind is TableKind.COMP:
            return CompTable(
                *common,
                source=int(item["source"]),
                target=int(item["target"]),
                by_desired=bool(item["by_desired"]),
            )
    except (KeyError, TypeError, ValueError) as error:
        raise ConfigError(
            f"A stored table is not understood: {error}.",
            code="PC-UPL-017",
            hint="The file is damaged or of another version; use another backup.",
        ) from error
    return BacklashTable(*common) if kind is TableKind.BLCOMP else TorqueTable(*common)


def read_table_backup(path: Path) -> tuple[TableSet, bool]:
    """Tables of a backup and whether they acted; the digest is checked."""
    data = read_sealed_json(path)
    stored = data.get("tables")
    if data.get("kind") != "tables" or not isinstance(stored, list):
        raise ConfigError(
            f"{path} is no backup of tables.",
            code="PC-UPL-014",
            hint="The folder of journals was changed by hand; name the right one with --journal.",
        )
    return TableSet(tuple(table_from_json(t) for t in stored)), bool(data["enabled"])


def put_last(context: Context) -> TableSet:
    """All tables of the card as the last upload of this folder meant them; none if it was undone.

    Raises ConfigError if its journal was changed by hand.
    """
    kind = ChangeKind.TABLES.value
    journal = next((j for j in reversed(journals(context)) if j.kind == kind), None)
    intent = None if journal is None else journal.last("intent")
    if journal is None or intent is None or journal.last(DONE) is None:
        return TableSet()
    tables = intent.data["new"]
    return TableSet(tuple(table_from_json(t) for t in tables))  # type: ignore[attr-defined]
