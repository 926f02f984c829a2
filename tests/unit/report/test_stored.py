"""Reports of stored results: any result of ours, nothing else."""

import json
from pathlib import Path

import pytest

from pmac_comp.base.errors import ConfigError
from pmac_comp.report.stored import report_from_file


@pytest.mark.parametrize("text", ["{}", "[]", "no json", '{"model_version": 1, "parameters": {}}'])
def test_what_is_no_result_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "bad.json").write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        report_from_file(tmp_path / "bad.json", tmp_path / "report.html")
    assert "verify, demo, identify" in caught.value.hint
    assert not (tmp_path / "report.html").exists()


@pytest.mark.parametrize("mark", [{"kind": "verification"}, {"verdict": "named"}])
def test_a_result_becomes_a_page_with_its_figures(tmp_path: Path, mark: dict[str, str]) -> None:
    result = {**mark, "motions": [{"name": "sine", "e_r_um": 0.25}]}
    (tmp_path / "r.json").write_text(json.dumps(result), encoding="utf-8")
    page = report_from_file(tmp_path / "r.json", tmp_path / "report.html")
    assert "0.25" in page.read_text(encoding="utf-8")


def test_the_page_says_where_its_captures_come_from(tmp_path: Path) -> None:
    told = {"kind": "identification", "sources": ["simulated controller and drive"]}
    ways = {"kind": "comparison", "alternatives": {"simulated": True, "rows": [{"name": "a"}]}}
    for name, result, said in (
        ("a", told, "Source of the captures: simulated controller and drive."),
        ("b", {**ways, "sources": ["gathered at the servo rate"]}, "gathered at the servo rate."),
        ("c", {**ways, "sources": []}, ""),
    ):
        (tmp_path / f"{name}.json").write_text(json.dumps(result), encoding="utf-8")
        page = report_from_file(tmp_path / f"{name}.json", tmp_path / f"{name}.html")
        text = page.read_text(encoding="utf-8")
        assert said in text
        assert "Simulated controller and drive." not in text


def test_many_figures_of_few_motions_stand_side_by_side(tmp_path: Path) -> None:
    """Thirty columns went off the page, and 9988.12 um was shown as 9988, the next as 1e+04."""
    figures = {f"figure_{i}_um": float(i) for i in range(12)}
    motions = [{"name": name, **figures} for name in ("sine", "move")]
    places = {"before": {"name": "before", "mean_up_um": [9988.125, 10001.5]}}
    result = {"kind": "verification", "motions": motions, "static": places, "files": ["a.h5"]}
    (tmp_path / "r.json").write_text(json.dumps(result), encoding="utf-8")
    text = report_from_file(tmp_path / "r.json", tmp_path / "report.html").read_text("utf-8")
    assert "<th>name</th><th>sine</th><th>move</th>" in text
    assert "9988.12, 10001.50" in text
    assert "--before FOLDER --after FOLDER" in text
    assert "<details><summary>show</summary>" in text


def test_what_is_nested_is_a_table_of_its_own_and_no_line_of_a_page_width(tmp_path: Path) -> None:
    motion = {"name": "sine", "e_rms_um": {"value": 0.25, "upper95": 0.31}}
    part = {"simulated": True, "motions": [motion], "remarks": ["warm"]}
    result = {"kind": "improvement", "first_model": part}
    (tmp_path / "r.json").write_text(json.dumps(result), encoding="utf-8")
    page = report_from_file(tmp_path / "r.json", tmp_path / "report.html")
    text = page.read_text(encoding="utf-8")
    assert "e_rms_um: upper95" in text
    assert "value 0.25, upper95" not in text
    assert "Simulated controller and drive." in text


def test_a_list_that_is_cut_says_how_much_is_left_out(tmp_path: Path) -> None:
    result = {"kind": "run", "residual": {"um": {"values": list(range(30))}}}
    (tmp_path / "r.json").write_text(json.dumps(result), encoding="utf-8")
    page = report_from_file(tmp_path / "r.json", tmp_path / "report.html")
    assert "19 and 10 more" in page.read_text(encoding="utf-8")
