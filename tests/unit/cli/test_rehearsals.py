"""A rehearsal of what is refused: the reasons are what is told, and the exit code is theirs."""

import json
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import pytest

from pmac_comp.cli.app import main
from pmac_comp.files.bench import load_bench
from pmac_comp.workflow import previews
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.context import context_of
from pmac_comp.workflow.capture.simulated import embedded, make_card
from pmac_comp.workflow.compensation.file import Compensation, write_compensation
from pmac_comp.workflow.controller import removal, upload_flow, upload_plan
from pmac_comp.workflow.controller.deploy import deploy
from pmac_comp.workflow.controller.removal import remove_from, standing_on
from tests.compensations import friction_law, lead_map

PAPER = load_bench("paper")
REFUSED, TABLES = 6, 7


def ended(words: list[str]) -> int:
    with pytest.raises(SystemExit) as left:
        main(words)
    return int(str(left.value.code or 0))


@pytest.mark.parametrize("dry", [["--dry-run"], []])
def test_a_forbidden_upload_tells_reasons_instead_of_a_plan(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    dry: list[str],
) -> None:
    lead = lead_map(20.0)
    new = Compensation("table", friction_law(), replace(lead, error_m=50.0 * lead.error_m))
    write_compensation(tmp_path / "c.json", new)
    with embedded(make_card(PAPER)) as link:
        axis = Axis(link, PAPER, "test", simulated=True)
        monkeypatch.setattr(upload_plan, "open_axis", lambda _url, _bench: nullcontext(axis))
        words = ["upload", "tcp://card:1", str(tmp_path / "c.json"), "--bench", "paper"]
        assert ended([*words, "--journal", str(tmp_path / "kept"), *dry]) == REFUSED
        said = capsys.readouterr()
        assert said.out == ""
        assert "PC-SAF-001" in said.err
        assert ended([*words, "--json", *dry]) == REFUSED
        assert json.loads(capsys.readouterr().out)["error"]["exit_code"] == REFUSED


def test_rehearsals_of_a_rollback_and_a_recovery_end_as_they_would(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with embedded(make_card(PAPER)) as link:
        axis = Axis(link, PAPER, "test", simulated=True)
        for module in (previews, upload_flow, removal):
            monkeypatch.setattr(module, "open_axis", lambda _url, _bench: nullcontext(axis))
        here, elsewhere = (context_of(axis, tmp_path / name) for name in ("here", "elsewhere"))
        deploy(axis, Compensation("table", friction_law(), lead_map(20.0)), here)
        words = ["tcp://card:1", "--bench", "paper", "--journal", str(here.store), "--dry-run"]
        assert ended(["rollback", *words]) == 0
        remove_from(axis, elsewhere, standing_on(axis))
        capsys.readouterr()
        assert ended(["rollback", *words]) == REFUSED
        assert "refused: Another folder" in capsys.readouterr().out
        assert ended(["recover", *words]) == 0


def test_a_rehearsed_verification_wants_its_compensation_on_the_card(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with embedded(make_card(PAPER)) as link:
        axis = Axis(link, PAPER, "test", simulated=True)
        monkeypatch.setattr(previews, "open_axis", lambda _url, _bench: nullcontext(axis))
        stands, other = (Compensation("table", friction_law(), lead_map(um)) for um in (20.0, 9.0))
        deploy(axis, stands, context_of(axis, tmp_path / "kept"))
        words = ["verify", "tcp://card:1", "--bench", "paper", "--dry-run", "--compensation"]
        for name, compensation in (("stands", stands), ("other", other)):
            write_compensation(tmp_path / f"{name}.json", compensation)
        assert ended([*words, str(tmp_path / "stands.json")]) == 0
        assert capsys.readouterr().out.endswith("nothing was changed\n")
        assert ended([*words, str(tmp_path / "other.json")]) == TABLES
        said = capsys.readouterr()
        assert "PC-VER-005" in said.err
        assert said.out == ""
