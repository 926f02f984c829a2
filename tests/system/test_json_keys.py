"""The keys of ``--json`` that other programs read: kept in ``tests/golden/json_keys.json``."""

import json
from pathlib import Path
from typing import Any

import pytest

from tests.system.command import run

pytestmark = [pytest.mark.system, pytest.mark.timeout(900)]
GOLDEN = Path(__file__).resolve().parent.parent / "golden" / "json_keys.json"
MOTION = "sine:amplitude_mm=12,frequency_Hz=3.5,cycles=4"


def result_of(cwd: Path, *words: str) -> dict[str, Any]:
    done = run(*words, "--json", cwd=cwd)
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def keys_at(result: Any, place: str) -> list[str]:
    """Keys of the mapping at a place: ``name/*`` is any item of a list or mapping."""
    for step in filter(None, place.split("/")):
        if step != "*":
            result = result[step]
        else:
            items = result if isinstance(result, list) else list(result.values())
            assert items, f"nothing at {place}"
            result = items[0]
    return sorted(result)


def test_json_has_the_agreed_keys(tmp_path: Path) -> None:
    bench = ("--bench", "paper")
    run, again = (
        result_of(tmp_path, "capture", "sim://", *bench, "--motion", MOTION, "--yes", "--out", out)
        for out in ("runs", "again")
    )
    run, again = run["files"][0], again["files"][0]
    found = {
        "identify": result_of(tmp_path, "identify", run, *bench, "--out", "m.json"),
        "diagnose": result_of(tmp_path, "diagnose", run, *bench),
        "verify": result_of(tmp_path, "verify", *bench, "--before", run, "--after", again),
    }
    result_of(tmp_path, "compensate", *bench, "--model", "m.json", "--out", "c.json")
    found["upload"] = result_of(tmp_path, "upload", "sim://", "c.json", *bench, "--yes")
    golden = json.loads(GOLDEN.read_text(encoding="utf-8"))
    assert sorted(golden) == sorted(found)
    for command, places in golden.items():
        for place, keys in places.items():
            assert keys_at(found[command], place) == keys, f"{command} {place}"
