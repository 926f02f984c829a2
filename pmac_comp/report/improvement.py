"""Page of an improvement: what the first and the grown model's compensation leave, side by side."""

from dataclasses import replace
from pathlib import Path

from pmac_comp import __version__
from pmac_comp.report.page import Page, Section, Table, sentence, write_page
from pmac_comp.report.run import notice_of
from pmac_comp.report.verification import verification_sections
from pmac_comp.workflow.improve import Improvement
from pmac_comp.workflow.verification.result import Verification


def write_improvement_report(result: Improvement, path: Path) -> Path:
    """Page of an improvement, beside that of its diagnosis."""
    first, grown = result.before_growth, result.after_growth
    sections = [
        _outcome(result),
        Section("What the diagnosis said", points=result.diagnosis.lines()),
    ]
    sections += _details("with the compensation of the first model", first)
    if grown is not None:
        sections += _details("with the compensation of the grown model", grown)
    page = Page(
        title="Improvement: the model grown, the error measured again",
        subtitle=f"kept: the compensation of the {result.kept} model",
        notice=notice_of(first),
        headline=[
            (f"{before:.2f} → {after:.2f} um", f"{name} error, measured rms, first → grown model")
            for name, before, after in result.means()
        ],
        sections=sections,
        facts={"pmac-comp": __version__, "sensor floor um rms": first.floor_um},
    )
    return write_page(page, path)


def _outcome(result: Improvement) -> Section:
    """What each compensation leaves of the mechanical and the total error, motion by motion."""
    totals = [_in_um(*row) for row in result.total_rows()]
    mechanical = [_in_um(*row) for row in result.rows()]
    columns = ("um rms", "no compensation", "first model", "grown model")
    return Section(
        "What was measured",
        points=[sentence(line) for line in result.judged()],
        tables=[
            Table(columns, mechanical, "Mechanical error, measured"),
            Table(columns, totals, "Total error at the table, measured"),
        ],
    )


def _in_um(name: str, *values_um: float | None) -> tuple[str, ...]:
    """Row of a motion with hundredths of um, a dash for what was not measured."""
    return name, *("–" if value is None else f"{value:.2f}" for value in values_um)


def _details(name: str, verification: Verification) -> list[Section]:
    """Tables and figures of one verification, folded."""
    return [
        replace(s, title=f"{s.title}, {name}", open=False)
        for s in verification_sections(verification)
    ]
