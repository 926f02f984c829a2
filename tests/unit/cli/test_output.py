"""Rendering: two forms of --json, plain values, escaped text, errors as classes and codes."""

import json
from pathlib import Path

import pytest

from pmac_comp.base.errors import (
    AmplitudeExceeded,
    ControllerState,
    SafetyRefusal,
    TableStateError,
)
from pmac_comp.cli import output
from pmac_comp.cli.app import main


@pytest.mark.parametrize(
    ("words", "spelled"),
    [
        (["info", "u", "--json"], ["info", "u", "--json=-"]),
        (["diagnose", "a.h5", "--json", "out.json"], ["diagnose", "a.h5", "--json=out.json"]),
        (["diagnose", "--json", "a.h5"], ["diagnose", "--json=-", "a.h5"]),
        (["x", "--json", "-"], ["x", "--json=-"]),
        (["x", "--json=y.json"], ["x", "--json=y.json"]),
        (["x", "--json", "--yes"], ["x", "--json=-", "--yes"]),
    ],
)
def test_bare_json_goes_to_standard_output(words: list[str], spelled: list[str]) -> None:
    assert output.spell_out_json(words) == spelled


def test_text_of_a_controller_cannot_drive_the_terminal(
    capsys: pytest.CaptureFixture[str],
) -> None:
    output.table("", ("a",), [("\x1b[2J[red]x\x07",)])
    shown = capsys.readouterr().out
    assert "\x1b" not in shown
    assert "\x07" not in shown
    assert "[red]" in shown


def test_error_is_described_with_state_and_all_refusals() -> None:
    error = SafetyRefusal(
        "no", code="PC-X", hint="do", refusals=(AmplitudeExceeded("too large", code="PC-Y"),)
    )
    got = output.describe_error(error)
    assert got["exit_code"] == 6
    assert got["refusals"][0]["code"] == "PC-Y"
    left = output.describe_error(TableStateError("x", left=ControllerState.DISABLED))
    assert left["left"] == "DISABLED"


def test_json_file_is_written_whole_into_a_new_folder(tmp_path: Path) -> None:
    target = tmp_path / "new" / "r.json"
    output.write_json(str(target), {"a": 1})
    assert json.loads(target.read_text()) == {"a": 1}
    assert [p.name for p in target.parent.iterdir()] == ["r.json"]


@pytest.mark.parametrize(
    ("words", "spelled"),
    [
        (
            "diagnose a.h5 b.h5 --validate c.h5 d.h5 --bench paper",
            "diagnose a.h5 b.h5 --validate c.h5 --validate d.h5 --bench paper",
        ),
        ("diagnose a.h5 b.h5 --bench paper", "diagnose a.h5 b.h5 --bench paper"),
        ("diagnose a.h5 --validate c.h5 --json=-", "diagnose a.h5 --validate c.h5 --json=-"),
        (
            "verify --before a b --after c d -b paper",
            "verify --before a --before b --after c --after d -b paper",
        ),
        (
            "compensate -m m --slow a b --captures c d",
            "compensate -m m --slow a --slow b --captures c --captures d",
        ),
        ("capture sim:// --validate a b", "capture sim:// --validate a b"),
        ("", ""),
    ],
)
def test_several_files_after_one_option_all_belong_to_it(words: str, spelled: str) -> None:
    assert output.spell_out_lists(words.split()) == spelled.split()


def refused(words: str, capsys: pytest.CaptureFixture[str]) -> str:
    """What a command line that ends with an error says."""
    with pytest.raises(SystemExit) as left:
        main(words.split())
    assert left.value.code
    return capsys.readouterr().err


@pytest.mark.parametrize(
    "words",
    [
        "convert run.csv ./run.csv",
        "predict -b z.toml -m model.json -c run.csv --out run.csv",
        "identify run.csv --bench z.toml -o z.toml",
        "identify run.csv --bench z.toml --out=new.json --json=new.json",
        "report model.json --out model.json",
        "config check z.toml --json=z.toml",
        "diagnose run.csv -b z.toml --model old.model.json --json=old.json",
        "diagnose run.csv -b z.toml --model old.model.json --json old.json",
        "compensate -b z.toml --model compensation.json",
        "predict -b z.toml -m model.json -c run.csv -orun.csv",
        "diff tcp://h model.json --plot=z.toml -b z.toml",
        "verify --before new.csv run.csv --after new.csv --report run.csv -b z.toml",
    ],
)
def test_a_result_is_not_written_over_a_file_that_is_named_beside_it(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    names = ("run.csv", "z.toml", "model.json", "old.model.json", "compensation.json")
    for name in names:
        (tmp_path / name).write_text("kept")
    assert "named twice" in refused(words, capsys)
    assert {(tmp_path / name).read_text() for name in names} == {"kept"}


@pytest.mark.parametrize(
    "words",
    [
        "convert run.csv out.csv",
        "identify run.csv -b z.toml -o old.json --report r.html --json=new.json",
        "upload tcp://h model.json --bench z.toml --json=-",
        "verify --before runs --after runs --out runs -b z.toml",
        "",
    ],
)
def test_results_in_files_of_their_own_are_no_clash(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").mkdir()
    for name in ("run.csv", "z.toml", "old.json"):
        (tmp_path / name).write_text("kept")
    assert "named twice" not in refused(words, capsys)


def test_a_rounded_zero_has_no_sign(capsys: pytest.CaptureFixture[str]) -> None:
    output.table("", ("from mm",), [(-0.0,)])
    assert "-" not in capsys.readouterr().out.replace("from mm", "")


CAPTURE = "time_s,commanded_position_mm,motor_position_mm\n0,0,0\n0.001,1,1\n0.002,2,2\n"


@pytest.mark.parametrize(
    "words",
    [
        "convert new.csv run.csv",
        "predict -b paper -m model.json -c new.csv --out run.csv",
        "report model.json --out run.csv",
    ],
)
def test_no_result_is_written_over_a_captured_run(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "new.csv").write_text(CAPTURE.replace("2,2", "3,3"))
    (tmp_path / "run.csv").write_text(CAPTURE)
    (tmp_path / "model.json").write_text("{}")
    with pytest.raises(SystemExit) as left:
        main(words.split())
    assert left.value.code == 2
    assert "cannot be measured again" in capsys.readouterr().err
    assert (tmp_path / "run.csv").read_text() == CAPTURE


KEPT = {
    "law.json": '{"compensation_version": 1, "route": "law"}',
    "model.json": '{"model_version": 1, "parameters": {}}',
    "backup.json": '{"sha256": "00", "body": "{}"}',
    "axis.toml": "# of the axis\nconfig_version = 1\n",
    "run.csv": CAPTURE,
}


@pytest.mark.parametrize("kept", KEPT)
@pytest.mark.parametrize(
    "words",
    [
        "identify new.csv -b paper --report FILE",
        "identify new.csv -b paper --json=FILE",
        "verify -b paper --before new.csv --after new.csv --report FILE",
        "verify -b paper --before new.csv --after new.csv --json=FILE",
        "diff tcp://127.0.0.1:9 new.json --json=FILE",
        "status tcp://127.0.0.1:9 --json=FILE",
        "report new.json --out FILE",
        "identify new.csv -b paper --out FILE",
        "compensate -b paper --model new.json --out FILE",
    ],
)
def test_no_result_is_written_over_a_file_of_another_kind(
    *,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: str,
    kept: str,
) -> None:
    """Nor is the error that the command ends with."""
    own = {"identify": "model.json", "compensate": "law.json"}
    monkeypatch.chdir(tmp_path)
    (tmp_path / "new.csv").write_text(CAPTURE)
    (tmp_path / kept).write_text(KEPT[kept])
    said = refused(words.replace("FILE", kept), capsys)
    is_renewed = "--out" in words and own.get(words.split(maxsplit=1)[0]) == kept
    told = ("There is a " in said) and ("PC-CLI-040" in said or "PC-CLI-015" in said)
    assert told is not is_renewed
    assert (tmp_path / kept).read_text() == KEPT[kept]


def test_the_grown_model_of_a_diagnosis_replaces_a_model_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    beside = tmp_path / "found.model.json"
    for name, is_kept in (("law.json", True), ("model.json", False)):
        beside.write_text(KEPT[name])
        said = refused("diagnose none.csv -b paper --json=found.json", capsys)
        assert ("PC-CLI-040" in said) is is_kept


@pytest.mark.parametrize(
    "content",
    [
        '{"kind": "identification", "model_version": 1}',
        '{"verdict": "NEW"}',
        "[1, 2]",
        "{half",
        "<html><pre>\nconfig_version = 1\n</pre></html>",
        "",
    ],
)
def test_a_result_may_be_written_anew(tmp_path: Path, content: str) -> None:
    target = tmp_path / "old"
    target.write_text(content)
    output.refuse_unusable_targets("verify", {"report": target})
