"""Sections of a report on a verification: before and after, motion by motion, static, ringing."""

from typing import Any

from pmac_comp.base.units import UM_PER_M
from pmac_comp.report import figures
from pmac_comp.report.page import Section, Table, sentence
from pmac_comp.report.positioning import lead_section, positioning_section
from pmac_comp.report.repeated import learning_section
from pmac_comp.workflow.accuracy.outcome import (
    MotionOutcome,
    Ratio,
    Spread,
    error_signals,
    quadratic_mean,
)
from pmac_comp.workflow.accuracy.ringing import RingingOutcome
from pmac_comp.workflow.law.routes import MOTION_ROUTES
from pmac_comp.workflow.verification.result import Verification


def headline(verification: Verification) -> list[tuple[str, str]]:
    """Figures that a reader wants first; a known motion is judged by its total error."""
    motions = verification.motions
    out: list[tuple[str, str]] = []
    if motions:
        total, mechanical = verification.total, verification.mechanical
        kinds = [
            ("mechanical error, measured rms", "e_before", "e_r_after", 2, mechanical),
            ("control tracking error, measured rms", "e_c_before", "e_c_after", 1, None),
            ("total error at the table, measured rms", "total_before", "total_after", 1, total),
        ]
        if _is_total_judged(verification):
            kinds = kinds[2:]
        for name, before, after, digits, left in kinds:
            values = [
                quadratic_mean([getattr(m, key).value for m in motions]) for key in (before, after)
            ]
            share = "" if left is None else f"; after/before {_share(left)}"
            out.append((f"{values[0]:.{digits}f} → {values[1]:.{digits}f} um", f"{name}{share}"))
    out += _true_headline(verification)
    if verification.static is not None and len(verification.static.sides) > 1:
        accuracy = [side.figures().accuracy_m * UM_PER_M for _, side in verification.static.sides]
        out.append((f"{accuracy[0]:.1f} → {accuracy[1]:.1f} um", "accuracy A by ISO 230-2"))
    return out


def _is_total_judged(verification: Verification) -> bool:
    """Whether the total error is shown first: a known motion, or e_r is not known."""
    return verification.route in MOTION_ROUTES or not verification.tells_mechanics


def _true_headline(verification: Verification) -> list[tuple[str, str]]:
    truths = [m.truth for m in verification.motions if m.truth is not None]
    if not truths:
        return []
    known = verification.route in MOTION_ROUTES
    keys = ("total_before_um", "total_after_um") if known else ("e_before_um", "e_r_after_um")
    before, after = (quadratic_mean([truth[key] for truth in truths]) for key in keys)
    what = "total" if known else "mechanical"
    return [(f"{before:.2f} → {after:.2f} um", f"{what} error, true positions of the plant")]


def verification_sections(verification: Verification) -> list[Section]:
    """Tables and figures of before and after: what a customer is handed first, then the traces."""
    sections = [_before_and_after(verification)]
    if verification.static is not None:
        sections.append(positioning_section(verification.static))
    if verification.lead is not None:
        sections.append(lead_section(verification.lead, verification.table_correction))
    if verification.learning is not None:
        sections.append(learning_section(verification.learning))
    if verification.motions:
        sections += [_errors_section(verification), _promise_section(verification)]
    sections += [_motion_section(verification, m) for m in verification.motions]
    if verification.ringing is not None:
        sections.append(_ringing_section(verification.ringing))
    return sections


def _before_and_after(verification: Verification) -> Section:
    """What was reached, at a glance, and what a person should know beside it."""
    said = (*verification.reached(), *verification.judged(), *verification.remarks)
    return Section(
        "Before and after",
        points=[sentence(line) for line in said],
        figures=[_summary(verification)] if verification.motions else [],
    )


def _errors_section(verification: Verification) -> Section:
    """The errors of each motion, with what the words mean."""
    lead = (
        "the lead error is taken out of both"
        if verification.lead is not None
        else "the lead error is still in it, for no map of it was given"
    )
    return Section(
        "Errors, motion by motion",
        text=[
            f"Mechanical error (e before, e_r after): table minus motor, plus the correction where "
            f"compensation is on; {lead}. Control error (e_c): motor minus desired position. "
            "Total error: table minus command. The mean of each run is taken out. In brackets: "
            "95 % intervals, by drawing blocks of the runs anew. Peaks are the largest of all "
            f"samples. The steps of the sensors alone make {verification.floor_um:.2f} um rms of "
            "every mechanical error."
        ],
        tables=_main_tables(verification.motions),
    )


def _summary(verification: Verification) -> tuple[str, str]:
    """Bars of the error that is judged, per motion."""
    is_total = _is_total_judged(verification)
    what, before, after = (
        ("total", "total_before", "total_after")
        if is_total
        else ("mechanical", "e_before", "e_r_after")
    )
    bars = [
        (
            m.name,
            getattr(m, before).value,
            getattr(m, after).value,
            None if m.promise is None else m.promise[f"{after}_um"],
        )
        for m in verification.motions
    ]
    # The floor is that of table against motor, whose steps a total error has not.
    image = figures.summary_marks(bars, 0.0 if is_total else verification.floor_um, what)
    promised = any(bar[3] is not None for bar in bars)
    return image, (
        f"{what.capitalize()} error per motion, measured."
        + " The promise is that of the model, without the steps of the sensors." * promised
    )


def _ringing_section(ringing: RingingOutcome) -> Section:
    """What rings after steps of the acceleration, before and after."""
    rows = [
        (name, f"{s.value:.2f} ({s.lower95:.2f} – {s.upper95:.2f})", f"{s.peak:.2f}")
        for name, s in (("before", ringing.before), ("after", ringing.after))
    ]
    half = len(ringing.captures) // 2
    pair = (ringing.captures[0], ringing.captures[half])
    shown = [(figures.ringing_figure(*pair, ringing.lowest_Hz), _RINGING)]
    return Section(
        "Ringing after steps of the acceleration",
        text=[
            f"A move without S-curve time rings at {ringing.frequency_Hz:.0f} Hz: "
            f"{ringing.says}. Rms of the total error above half the resonance "
            f"({ringing.lowest_Hz:.0f} Hz), in the windows after the corners of the speed."
        ],
        tables=[Table(("um", "rms (95 %)", "peak"), rows, "Measured")],
        figures=shown if half else [],
    )


_RINGING = "Total error above half the resonance, measured, one run each."


def _main_tables(motions: tuple[MotionOutcome, ...]) -> list[Table]:
    """Mechanical, control and total error: rms with intervals, what is left of it, peaks."""
    kinds: tuple[tuple[str, str, str, str | None], ...] = (
        ("Mechanical error, measured", "e_before", "e_r_after", "mechanical"),
        ("Control tracking error, measured", "e_c_before", "e_c_after", None),
        ("Total error at the table, measured", "total_before", "total_after", "total"),
    )
    tables = []
    for caption, before, after, ratio in kinds:
        sides = [(m, getattr(m, before), getattr(m, after)) for m in motions]
        rows = [
            (
                m.name,
                _spread(a),
                *_after_cells(a, b, None if ratio is None else getattr(m, ratio)),
                f"{a.peak:.1f}",
                f"{b.peak:.2f}" if b.is_known else None,
            )
            for m, a, b in sides
        ]
        columns = ("um", "rms before", "rms after", "after / before", "peak before", "peak after")
        tables.append(Table(columns, rows, caption))
    return tables


def _after_cells(
    before: Spread, after: Spread, ratio: Ratio | None
) -> tuple[str | None, str | None]:
    """Rms with compensation and what is left of that without; None where they are not known."""
    if not after.is_known:
        return None, None
    left = after.value / max(before.value, 1e-12) if ratio is None else ratio
    return _spread(after), _share(left)


def _rms(spread: Spread) -> str | None:
    return f"{spread.value:.2f}" if spread.is_known else None


def _spread(spread: Spread) -> str:
    return f"{spread.value:.2f} ({spread.lower95:.2f} – {spread.upper95:.2f})"


def _share(ratio: Ratio | float) -> str:
    if isinstance(ratio, float):
        return f"{ratio:.3f}"
    return f"{ratio.value:.3f} ({ratio.lower95:.3f} – {ratio.upper95:.3f})"


def _promise_section(verification: Verification) -> Section:
    """What the model promised beside what was measured, and what the plant really did."""
    motions, floor = verification.motions, verification.floor_um
    tables = [*_promise_tables(motions, floor), *_truth_tables(motions)]
    if not tables:
        return Section(
            "What the model promised",
            text=["No promise: name model and compensation with --model and --compensation."],
        )
    text = [
        "A promise is a simulation of the run by the identified model, before it is measured. It "
        "is kept where the measured value is at most the upper end of its interval, to which the "
        f"sensors' own steps ({floor:.2f} um rms) are added."
    ]
    return Section("What the model promised", text=text, tables=tables)


_QUANTITIES = (
    ("mechanical", "e_before", "e_r_after"),
    ("control", "e_c_before", "e_c_after"),
    ("total", "total_before", "total_after"),
)


def _promise_tables(motions: tuple[MotionOutcome, ...], floor_um: float) -> list[Table]:
    """Promised beside measured, per motion and quantity; only some have an interval."""
    rows: list[tuple[Any, ...]] = []
    for motion in (m for m in motions if m.promise is not None):
        promise = motion.promise or {}
        judged = {f"{j.quantity}_after": j for j in motion.judged(floor_um)}
        for name, before, after in _QUANTITIES:
            j = judged.get(after)
            rows.append(
                (
                    f"{motion.name}: {name}",
                    f"{promise[f'{before}_um']:.2f}",
                    f"{getattr(motion, before).value:.2f}",
                    f"{promise[f'{after}_um']:.2f}",
                    None if j is None else f"{j.lower_um:.2f} – {j.upper_um:.2f}",
                    None if j is None else f"{j.most_um:.2f}",
                    _rms(getattr(motion, after)),
                    None if j is None else "kept" if j.is_kept else "MISSED",
                )
            )
    columns = (
        "um rms", "before, by the model", "before, measured", "after, promised", "interval",
        "at most, with steps", "after, measured", "promise",
    )  # fmt: skip
    return [Table(columns, rows, "Promised and measured")] if rows else []


def _truth_tables(motions: tuple[MotionOutcome, ...]) -> list[Table]:
    """The same errors on the plant's unquantised positions, of simulated cards only."""
    rows = [
        (m.name, *(f"{m.truth[f'{k}_um']:.2f}" for _, a, b in _QUANTITIES for k in (a, b)))
        for m in motions
        if m.truth is not None
    ]
    columns = ("um rms", "e before", "e_r after", "e_c before", "e_c after", "total before",
               "total after")  # fmt: skip
    return [Table(columns, rows, "What the simulated plant really did (true)")] if rows else []


def _motion_section(verification: Verification, motion: MotionOutcome) -> Section:
    index = verification.motions.index(motion)
    first = sum(m.n_pairs for m in verification.motions[:index])
    if first >= min(len(verification.before), len(verification.after)):
        return Section(motion.name, text=["The captures are not at hand."], open=False)
    a, b = verification.before[first], verification.after[first]
    if not motion.e_r_after.is_known:
        said = "What the compensation added is not known, so its errors cannot be told apart."
        return Section(motion.name, text=[said], open=False)
    n = min(a.n, b.n)
    lead, table, age_s = verification.lead, verification.table_correction, verification.scale_age_s
    before = error_signals(a.slice(0, n), lead, None, age_s)
    after = error_signals(b.slice(0, n), lead, table, age_s)
    command = b.commanded_position_m[:n]
    return Section(
        motion.name,
        figures=[
            (
                figures.error_traces(before, after, command),
                f"Errors over time, measured, their means taken out: the first of {motion.n_pairs} "
                "pair(s) of runs.",
            ),
            (figures.spectra(before, after), "Amplitude spectral densities of the same runs."),
        ],
    )
