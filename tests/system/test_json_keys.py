"""The keys of ``--json`` that other programs read: kept in ``tests/golden/json_keys.json``."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pmac_comp.cli.app import main
from pmac_comp.files.capture import write_capture
from pmac_comp.physics.compensate.exact import Learning
from pmac_comp.workflow.verification.learning import Refinement
from tests.unit.workflow.accuracy.test_static_and_ringing import rings, staircase_run
from tools.bench_wire import served_card

pytestmark = [pytest.mark.system, pytest.mark.timeout(900)]
GOLDEN = json.loads(
    (Path(__file__).resolve().parent.parent / "golden" / "json_keys.json").read_text("utf-8")
)
BENCH = ("--bench", "paper")
SLOW = "sine:amplitude_mm=12,frequency_Hz=3.5,cycles=4"
FAST = "sine:amplitude_mm=5,frequency_Hz=5,cycles=4"
Found = dict[str, Any]


def result_of(*words: str) -> Any:
    """What a command writes for other programs."""
    out = Path("result.json")
    with pytest.raises(SystemExit) as done:
        main([*words, "--json", str(out)])
    result = json.loads(out.read_text("utf-8"))
    assert not done.value.code, result
    return result


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


def looked() -> Found:
    """Commands that look at a card or a bench file."""
    return {
        "info": result_of("info", "sim://"),
        "doctor": result_of("doctor", "sim://", *BENCH),
        "backup": result_of("backup", "sim://", "--out", "backup.json"),
        "restore": result_of("restore", "sim://", "backup.json", *BENCH, "--yes"),
        "setup": result_of("setup", "sim://", *BENCH, "--yes"),
        "config show": result_of("config", "show", "paper"),
        "config check": result_of("config", "check", "paper"),
    }


def computed() -> Found:
    """Commands that work on captures, and what they were captured with."""
    motions = ("--motion", SLOW, "--motion", FAST)
    captured = result_of("capture", "sim://", *BENCH, *motions, "--yes", "--out", "runs")
    run, other = captured["files"]
    (again,) = result_of("capture", "sim://", *BENCH, *motions[:2], "--yes", "--out", "2")["files"]
    found = {
        "capture": captured,
        "identify": result_of("identify", run, *BENCH, "--out", "m.json"),
        "diagnose": result_of("diagnose", run, *BENCH),
        "compare": result_of("compare", run, other, *BENCH),
        "convert": result_of("convert", run, "run.csv"),
        "verify": verified(run, again),
    }
    Path("result.json").rename("verified.json")
    found["report"] = result_of("report", "verified.json", "--out", "page.html")
    words = (*BENCH, "--model", "m.json", "--out")
    found["predict"] = result_of("predict", "--command", run, *words, "p.csv")
    found["compensate"] = result_of("compensate", *words, "c.json")
    return found


def verified(run: str, again: str) -> Any:
    """``verify`` with all its parts: runs of ISO 230-2, of ringing and of learning too."""
    sides = {}
    for side, reversal_um, moved in (("before", 3.0, run), ("after", 0.5, again)):
        runs = [staircase_run(offset_um, reversal_um, 20.0) for offset_um in (0.0, 0.1)]
        runs.append(rings(reversal_um, 1))
        folder = Path(side)
        folder.mkdir()
        for k, capture in enumerate(runs):
            whole = replace(capture, desired_position_m=capture.commanded_position_m)
            write_capture(folder / f"{side}_{k}.h5", whole)
        (folder / f"{side}_9.h5").write_bytes(Path(moved).read_bytes())
        sides[side] = folder
    result = result_of(
        "verify", *BENCH, "--before", str(sides["before"]), "--after", str(sides["after"])
    )
    # Learning moves an axis for minutes; what `verify` tells of it is told by this value.
    learning = Learning(np.zeros(50), (2.0, 0.6), converged=True, confirmed_um=(0.6,))
    return {**result, "learning": Refinement("sine", 9.0, 2.0, learning).as_result()}


def changed() -> Found:
    """Commands that change one card, in turn."""
    with served_card() as port:
        at = (f"tcp://127.0.0.1:{port}",)
        return {
            "upload": result_of("upload", *at, "c.json", *BENCH, "--yes"),
            "status": result_of("status", *at, *BENCH),
            "diff": result_of("diff", *at, "c.json", *BENCH),
            "remove": result_of("remove", *at, *BENCH, "--yes"),
            "rollback": result_of("rollback", *at, *BENCH, "--yes"),
            "recover": result_of("recover", *at, *BENCH),
        }


def test_json_has_the_agreed_keys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of every command that ends by itself: one test, since each needs what others wrote."""
    monkeypatch.chdir(tmp_path)
    found = {**looked(), **computed(), **changed()}
    assert sorted(GOLDEN) == sorted(found)
    wanted = {(name, place): GOLDEN[name][place] for name in GOLDEN for place in GOLDEN[name]}
    assert {at: keys_at(found[at[0]], at[1]) for at in wanted} == wanted
