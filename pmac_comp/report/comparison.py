"""Report of a comparison: rival models, and what one would do instead of compensation."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pmac_comp import __version__
from pmac_comp.report import figures
from pmac_comp.report.page import Page, Section, Table, write_page


def write_comparison_report(result: Mapping[str, Any], path: Path) -> Path:
    """Report of ``compare`` as one page, from its result."""
    models, ways = result["models"], result["alternatives"]["rows"]
    basis = result["alternatives"]["basis"]
    bench = f"{result['bench']} – " if result.get("bench") else ""
    sources = "; ".join(result.get("sources", ())) or "not stated"
    left_out = "".join(f" ({remark})" for remark in result.get("remarks", ()))
    page = Page(
        title="What each leaves uncorrected",
        subtitle=f"{bench}rival models, and what one would do otherwise",
        notice=f"Source of the captures: {sources}. "
        f"Models: judged on {result['judged_on']} positions of captures that were not used "
        f"for fitting{left_out}. Other ways: {basis}.",
        headline=[
            (f"{models[-1]['left_rms_um']:.3g} um", "mechanical error that the full model leaves"),
            (f"{models[-1]['error_rms_um']:.3g} um", "mechanical error as it is"),
        ],
        sections=[_figure(models, ways), _models(models), _ways(ways, basis)],
        facts={"pmac-comp": __version__},
    )
    return write_page(page, path)


def _figure(models: list[Mapping[str, Any]], ways: list[Mapping[str, Any]]) -> Section:
    groups = [
        (
            "mechanical error left by each model",
            [(r["name"], r["left_rms_um"]) for r in models],
        )
    ]
    shown = [(r["name"], r["total_rms_um"]) for r in ways if r["total_rms_um"] is not None]
    if shown:
        groups.append(("total error at the table, simulated with the identified model", shown))
    return Section("At a glance", figures=[(figures.ranking(groups), "Shorter is better.")])


def _models(models: list[Mapping[str, Any]]) -> Section:
    columns = ("model", "left um", "of um", "parameters", "source")
    keys = ("name", "left_rms_um", "error_rms_um", "n_parameters", "source")
    return Section("Models", tables=[Table(columns, [[r[k] for k in keys] for r in models])])


def _ways(ways: list[Mapping[str, Any]], basis: str) -> Section:
    if not ways:
        return Section("Other ways", text=["The identified model is rigid: nothing to compare."])
    columns = ("way", "total um", "table - motor um", "... + correction um", "how")
    keys = ("name", "total_rms_um", "mechanical_rms_um", "residual_rms_um", "how")
    text = [
        f"This table is {basis}.",
        "Scale feedback alone takes position and velocity of the loop from the scale; with its "
        "velocity loop on the motor only the position. A correction by learning also holds what "
        "the loop lags behind, so its last figure is no mechanical error.",
    ]
    rows = [[r[k] for k in keys] for r in ways]
    return Section("Other ways, simulated", text=text, tables=[Table(columns, rows)])
