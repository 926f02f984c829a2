"""Report of a comparison: says what is simulated, leaves out of the figure what is unstable."""

from pathlib import Path
from typing import Any

from pmac_comp.report.comparison import write_comparison_report


def result(ways: list[dict[str, Any]]) -> dict[str, Any]:
    model = {"name": "full", "left_rms_um": 0.2, "error_rms_um": 5.0, "n_parameters": 9,
             "source": "here"}  # fmt: skip
    alternatives = {"simulated": True, "basis": "simulated, not measured", "rows": ways}
    return {"bench": "Z axis", "sources": ["simulated controller and drive"],
            "judged_on": "measured", "models": [model], "alternatives": alternatives}  # fmt: skip


def way(name: str, total_um: float | None) -> dict[str, Any]:
    return {"name": name, "how": "as it is", "total_rms_um": total_um,
            "mechanical_rms_um": total_um, "residual_rms_um": None}  # fmt: skip


def test_figure_and_table_of_the_ways(tmp_path: Path) -> None:
    given = result([way("baseline way", 12.25), way("unstable way", None)])
    page = write_comparison_report(given, tmp_path / "c.html").read_text(encoding="utf-8")
    assert "simulated, not measured" in page
    assert "Source of the captures: simulated controller and drive." in page
    assert "Z axis – rival models" in page
    figure = page[page.index("<svg") : page.index("</svg>")]
    assert "baseline way" in figure
    assert "unstable way" not in figure
    assert "unstable way" in page
    assert "12.25" in page


def test_a_rigid_drive_has_models_only(tmp_path: Path) -> None:
    page = write_comparison_report(result([]), tmp_path / "c.html").read_text(encoding="utf-8")
    assert "The identified model is rigid" in page
    assert "total error at the table" not in page
