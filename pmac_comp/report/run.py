"""Reports of a whole run and of a verification."""

from pathlib import Path
from typing import Any

from pmac_comp import __version__
from pmac_comp.report import figures
from pmac_comp.report.page import Page, Section, Table, write_page
from pmac_comp.workflow.computing import describe
from pmac_comp.workflow.demo import RunResult
from pmac_comp.workflow.outcome import MotionOutcome, error_signals
from pmac_comp.workflow.verification import Verification

SIMULATED = (
    "The controller and the drive behind it are simulated. Figures marked 'measured' are what the "
    "simulated sensors read through the wire protocol, quantised as on the bench; figures marked "
    "'true' are the plant's unquantised positions, which no sensor of a real axis sees; figures "
    "marked 'promised' come from the identified model alone."
)
MEASURED = "All figures marked 'measured' come from captures; 'promised' ones from the model."


def write_run_report(result: RunResult, path: Path) -> Path:
    """Report of a whole job."""
    page = Page(
        title=result.title,
        subtitle=f"{result.bench.name or 'bench'} – {result.controller}",
        notice=SIMULATED,
        headline=_headline(result.verification),
        sections=[
            *verification_sections(result.verification),
            _model_section(result),
            _compensation_section(result),
            _time_section(result),
        ],
        facts={
            "pmac-comp": __version__,
            "bench digest": result.bench.digest,
            "servo period us": result.bench.servo_period_s * 1e6,
        },
    )
    return write_page(page, path)


def write_verification_report(verification: Verification, path: Path) -> Path:
    """Report of a verification alone."""
    page = Page(
        title="Verification: before and after compensation",
        subtitle=f"{len(verification.motions)} motion" + "s" * (len(verification.motions) != 1),
        notice=SIMULATED if verification.simulated else MEASURED,
        headline=_headline(verification),
        sections=verification_sections(verification),
        facts={"pmac-comp": __version__, "sensor floor um rms": verification.floor_um},
    )
    return write_page(page, path)


def _headline(verification: Verification) -> list[tuple[str, str]]:
    motions = verification.motions
    before = _mean([m.e_before.value for m in motions])
    after = _mean([m.e_r_after.value for m in motions])
    out = [
        (f"{before:.2f} → {after:.2f} um", "mechanical error, measured rms"),
        (
            f"{_mean([m.e_c_before.value for m in motions]):.1f} → "
            f"{_mean([m.e_c_after.value for m in motions]):.1f} um",
            "control tracking error, measured rms",
        ),
        (
            f"{_mean([m.total_before.value for m in motions]):.1f} → "
            f"{_mean([m.total_after.value for m in motions]):.1f} um",
            "total error at the table, measured rms",
        ),
    ]
    truths = [m.truth for m in motions if m.truth is not None]
    if truths:
        out.append(
            (
                f"{_mean([t['e_before_um'] for t in truths]):.2f} → "
                f"{_mean([t['e_r_after_um'] for t in truths]):.2f} um",
                "mechanical error, true positions of the plant",
            )
        )
    return out


def _mean(values: list[float]) -> float:
    """Quadratic mean over motions."""
    return float((sum(v * v for v in values) / max(len(values), 1)) ** 0.5)


def verification_sections(verification: Verification) -> list[Section]:
    """Tables and figures of before and after."""
    bars = [
        (
            m.name,
            m.e_before.value,
            m.e_r_after.value,
            None if m.promise is None else m.promise["e_r_after_um"],
        )
        for m in verification.motions
    ]
    sections = [
        Section(
            "Before and after",
            text=[
                "Mechanical error: table minus motor, plus the correction where compensation is "
                "on; the lead error is taken out of both. Control error: motor minus desired "
                "position. Total: table minus command. The mean of each run is taken out. "
                f"The sensors' own quantisation is {verification.floor_um:.2f} um rms.",
                *verification.remarks,
            ],
            tables=[*_main_tables(verification.motions), *_promise_tables(verification.motions)],
            figures=[(figures.summary_bars(bars), "Mechanical error per motion, measured.")],
        )
    ]
    sections += [_motion_section(verification, m) for m in verification.motions]
    if verification.lead is not None:
        summary = verification.lead.summary()
        sections.append(
            Section(
                "Static lead error",
                tables=[Table(("quantity", "value"), list(summary.items()))],
                figures=[
                    (
                        figures.lead_figure(verification.lead, verification.table_correction),
                        "Mean of both directions after the dynamic part was removed; below, the "
                        "direction-dependent remainder.",
                    )
                ],
            )
        )
    return sections


def _main_tables(motions: tuple[MotionOutcome, ...]) -> list[Table]:
    mechanical = [
        (
            m.name,
            m.e_before.value,
            m.e_r_after.value,
            f"{m.e_r_after.lower95:.2f} – {m.e_r_after.upper95:.2f}",
            m.mechanical.value,
            m.e_before.peak,
            m.e_r_after.peak,
        )
        for m in motions
    ]
    others = [
        (
            m.name,
            m.e_c_before.value,
            m.e_c_after.value,
            m.total_before.value,
            m.total_after.value,
            m.total.value,
            m.total_before.peak,
            m.total_after.peak,
        )
        for m in motions
    ]
    return [
        Table(
            ("um", "e rms before", "e_r rms after", "95 % interval", "ratio", "peak before",
             "peak after"),
            mechanical,
            "Mechanical error, measured",
        ),
        Table(
            ("um", "e_c rms before", "e_c rms after", "total rms before", "total rms after",
             "ratio", "peak before", "peak after"),
            others,
            "Control tracking error and total error, measured",
        ),
    ]  # fmt: skip


def _promise_tables(motions: tuple[MotionOutcome, ...]) -> list[Table]:
    names = (
        ("e_before_um", "e before"), ("e_r_after_um", "e_r after"),
        ("e_c_before_um", "e_c before"), ("e_c_after_um", "e_c after"),
        ("total_before_um", "total before"), ("total_after_um", "total after"),
    )  # fmt: skip
    rows: list[tuple[Any, ...]] = []
    for motion in motions:
        for label, values in (("promised", motion.promise), ("true", motion.truth)):
            if values is not None:
                rows.append((f"{motion.name}: {label}", *(values[name] for name, _ in names)))
    if not rows:
        return []
    caption = "What the model promised, and what the plant really did (simulated cards only)"
    return [Table(("um rms", *(label for _, label in names)), rows, caption)]


def _motion_section(verification: Verification, motion: MotionOutcome) -> Section:
    index = verification.motions.index(motion)
    first = sum(m.n_pairs for m in verification.motions[:index])
    if first >= min(len(verification.before), len(verification.after)):
        return Section(motion.name, text=["The captures are not at hand."], open=False)
    a, b = verification.before[first], verification.after[first]
    n = min(a.n, b.n)
    before = error_signals(a.slice(0, n), verification.lead)
    after = error_signals(b.slice(0, n), verification.lead, verification.table_correction)
    command = b.commanded_position_m[:n]
    return Section(
        motion.name,
        figures=[
            (figures.error_traces(before, after, command), "Errors over time, measured."),
            (figures.spectra(before, after), "Amplitude spectral densities, measured."),
        ],
    )


def _model_section(result: RunResult) -> Section:
    return Section(
        "Identified model",
        text=[
            f"Effects: {', '.join(result.identified.model_file.effects) or 'base'}. The host knew "
            "the bench file only.",
            *result.identified.statements(),
        ],
        tables=[
            Table(
                ("parameter", "value", "unit", "std", "lower 95 %", "upper 95 %", "bench file"),
                result.identified.rows(),
            )
        ],
    )


def _compensation_section(result: RunResult) -> Section:
    parts = [
        (p.route, p.verdict.value, f"{p.crc_old:08x}", f"{p.crc_new:08x}", p.disabled_s)
        for p in result.deployment.parts
    ]
    described = describe(result.bench, result.compensation)
    return Section(
        "Compensation and upload",
        text=[
            f"The upload ended in {result.deployment.verdict.value}.",
            *result.deployment.notes,
            *result.remarks,
        ],
        tables=[
            Table(("item", "value"), list(described.items())),
            Table(("part", "verdict", "old checksum", "new checksum", "off for s"), parts),
        ],
    )


def _time_section(result: RunResult) -> Section:
    tables = [Table(("step", "s"), [(s.name, round(s.seconds, 1)) for s in result.steps])]
    text = []
    if result.plant_notes:
        text = [
            "The simulated drive holds, unknown to the host: " + "; ".join(result.plant_notes) + "."
        ]
    return Section("What ran", text=text, tables=tables, open=False)
