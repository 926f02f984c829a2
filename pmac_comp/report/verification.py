"""Sections of a report on a verification: before and after, motion by motion, static, ringing."""

from typing import Any

from pmac_comp.base.units import UM_PER_M
from pmac_comp.report import figures
from pmac_comp.report.page import Section, Table
from pmac_comp.workflow.outcome import MotionOutcome, error_signals
from pmac_comp.workflow.ringing import RingingOutcome
from pmac_comp.workflow.routes import MOTION_ROUTES
from pmac_comp.workflow.static_check import StaticOutcome
from pmac_comp.workflow.verification import Verification


def headline(verification: Verification) -> list[tuple[str, str]]:
    """Figures that a reader wants first; a known motion is judged by its total error."""
    motions = verification.motions
    out: list[tuple[str, str]] = []
    if motions:
        pairs = [
            ("mechanical error, measured rms", "e_before", "e_r_after", 2),
            ("control tracking error, measured rms", "e_c_before", "e_c_after", 1),
            ("total error at the table, measured rms", "total_before", "total_after", 1),
        ]
        if verification.route in MOTION_ROUTES:
            pairs = pairs[2:]
        for name, before, after, digits in pairs:
            values = [_mean([getattr(m, key).value for m in motions]) for key in (before, after)]
            out.append((f"{values[0]:.{digits}f} → {values[1]:.{digits}f} um", name))
    out += _true_headline(verification)
    if verification.static is not None and len(verification.static.sides) > 1:
        accuracy = [side.figures().accuracy_m * UM_PER_M for _, side in verification.static.sides]
        out.append((f"{accuracy[0]:.1f} → {accuracy[1]:.1f} um", "accuracy A after ISO 230-2"))
    return out


def _true_headline(verification: Verification) -> list[tuple[str, str]]:
    truths = [m.truth for m in verification.motions if m.truth is not None]
    if not truths:
        return []
    known = verification.route in MOTION_ROUTES
    keys = ("total_before_um", "total_after_um") if known else ("e_before_um", "e_r_after_um")
    before, after = (_mean([truth[key] for truth in truths]) for key in keys)
    what = "total" if known else "mechanical"
    return [(f"{before:.2f} → {after:.2f} um", f"{what} error, true positions of the plant")]


def _mean(values: list[float]) -> float:
    """Quadratic mean over motions."""
    return float((sum(v * v for v in values) / max(len(values), 1)) ** 0.5)


def verification_sections(verification: Verification) -> list[Section]:
    """Tables and figures of before and after."""
    sections = [
        Section(
            "Before and after",
            text=[
                "Mechanical error: table minus motor, plus the correction where compensation is "
                "on; the lead error is taken out of both. Control error: motor minus desired "
                "position. Total: table minus command. The mean of each run is taken out. "
                f"The sensors' own quantisation is {verification.floor_um:.2f} um rms. Intervals "
                "are 95 % by drawing blocks of the runs anew.",
                *(
                    f"{line[0].upper()}{line[1:]}."
                    for line in (
                        *verification.reached(),
                        *verification.judged(),
                        *verification.remarks,
                    )
                ),
            ],
            tables=[
                *_main_tables(verification.motions),
                *_promise_tables(verification.motions),
                *_interval_tables(verification),
            ],
            figures=[_summary(verification)],
        )
    ]
    sections += [_motion_section(verification, m) for m in verification.motions]
    if verification.lead is not None:
        summary = verification.lead.summary()
        rows = [(name.replace("_", " "), value) for name, value in summary.items()]
        sections.append(
            Section(
                "Static lead error",
                tables=[
                    Table(
                        ("quantity", "value"),
                        rows,
                    )
                ],
                figures=[
                    (
                        figures.lead_figure(verification.lead, verification.table_correction),
                        "Mean of both directions after the dynamic part was removed; below, the "
                        "direction-dependent remainder.",
                    )
                ],
            )
        )
    if verification.static is not None:
        sections.append(_static_section(verification.static))
    if verification.ringing is not None:
        sections.append(_ringing_section(verification.ringing))
    return sections


def _summary(verification: Verification) -> tuple[str, str]:
    """Bars of the error that is judged, per motion; of a known motion that is the total one."""
    known = verification.route in MOTION_ROUTES
    what, before, after = (
        ("total", "total_before", "total_after")
        if known
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
    image = figures.summary_bars(bars, 0.0 if known else verification.floor_um, what)
    return image, (
        f"{what.capitalize()} error per motion, measured; the promise is that of the model, "
        "without the steps of encoder and scale."
    )


def _static_section(static: StaticOutcome) -> Section:
    """Positioning after ISO 230-2 with its run scheme."""
    targets = static.sides[0][1].target_m
    runs = ", ".join(f"{side.up_m.shape[0]} runs {name}" for name, side in static.sides)
    return Section(
        "Positioning after ISO 230-2",
        text=[
            f"{targets.size} targets, each approached upwards and downwards; {runs}, in turns. "
            "Deviation: table minus target, mean of the last part of each rest. The offset between "
            "scale and encoder cancels in all figures."
        ],
        tables=[Table(("um", "before", "after"), static.rows(), "Measured")],
        figures=[
            (
                figures.static_figure(static),
                "Deviation at the targets less its mean: points are runs, lines their means; "
                "arrows up and down are the directions of approach.",
            )
        ],
    )


def _ringing_section(ringing: RingingOutcome) -> Section:
    """What rings after steps of the acceleration, before and after."""
    rows = [
        (name, s.value, f"{s.lower95:.3f} – {s.upper95:.3f}", s.peak)
        for name, s in (("before", ringing.before), ("after", ringing.after))
    ]
    half = len(ringing.captures) // 2
    pair = (ringing.captures[0], ringing.captures[half])
    shown = [(figures.ringing_figure(*pair, ringing.lowest_Hz), _RINGING)]
    return Section(
        "Ringing after steps of the acceleration",
        text=[
            f"A move without S-curve time rings at {ringing.frequency_Hz:.0f} Hz: "
            f"{ringing.says}. Rms of the total error above half the resonance, in the "
            "windows after the corners of the speed."
        ],
        tables=[Table(("um", "rms", "95 % interval", "peak"), rows, "Measured")],
        figures=shown if half else [],
    )


_RINGING = "Total error above half the resonance, measured."


def _main_tables(motions: tuple[MotionOutcome, ...]) -> list[Table]:
    mechanical = [
        (
            m.name,
            m.e_before.value,
            m.e_r_after.value,
            f"{m.e_r_after.lower95:.2f} – {m.e_r_after.upper95:.2f}",
            m.mechanical.value,
            f"{m.mechanical.lower95:.3f} – {m.mechanical.upper95:.3f}",
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
            ("um", "e rms before", "e_r rms after", "95 % interval", "ratio", "95 % interval",
             "peak before", "peak after"),
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
                texts = (f"{values[name]:.2f}" for name, _ in names)
                rows.append((f"{motion.name}: {label}", *texts))
    if not rows:
        return []
    caption = "What the model promised"
    if any(motion.truth is not None for motion in motions):
        caption += ", and what the simulated plant really did"
    return [Table(("um rms", *(label for _, label in names)), rows, caption)]


def _interval_tables(verification: Verification) -> list[Table]:
    """Promised intervals beside what was measured, per motion and quantity."""
    rows: list[tuple[Any, ...]] = [
        (
            f"{motion.name}: {j.quantity}",
            f"{j.lower_um:.2f} to {j.upper_um:.2f}",
            f"{j.most_um:.2f}",
            f"{j.measured_um:.2f}",
            "kept" if j.is_kept else "missed",
        )
        for motion in verification.motions
        for j in motion.judged(verification.floor_um)
    ]
    if not rows:
        return []
    caption = (
        "Promised intervals, and their upper end with the sensors' own steps of "
        f"{verification.floor_um:.2f} um; kept: measured at most that"
    )
    columns = ("um rms", "promised", "with steps, up to", "measured", "promise")
    return [Table(columns, rows, caption)]


def _motion_section(verification: Verification, motion: MotionOutcome) -> Section:
    index = verification.motions.index(motion)
    first = sum(m.n_pairs for m in verification.motions[:index])
    if first >= min(len(verification.before), len(verification.after)):
        return Section(motion.name, text=["The captures are not at hand."], open=False)
    a, b = verification.before[first], verification.after[first]
    n = min(a.n, b.n)
    lead, table, age_s = verification.lead, verification.table_correction, verification.scale_age_s
    before = error_signals(a.slice(0, n), lead, None, age_s)
    after = error_signals(b.slice(0, n), lead, table, age_s)
    command = b.commanded_position_m[:n]
    return Section(
        motion.name,
        figures=[
            (figures.error_traces(before, after, command), "Errors over time, measured."),
            (figures.spectra(before, after), "Amplitude spectral densities, measured."),
        ],
    )
