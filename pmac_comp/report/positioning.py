"""Sections on the static part: the sheet of ISO 230-2 with its run scheme, the lead-error map."""

from collections.abc import Callable

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.units import MM_PER_M
from pmac_comp.physics.compensate.lead import LeadMap
from pmac_comp.report import figures
from pmac_comp.report.page import Section, Table
from pmac_comp.workflow.accuracy.positioning_sheet import by_target, run_scheme, sheet_rows
from pmac_comp.workflow.accuracy.static_check import Approaches, StaticOutcome


def positioning_section(static: StaticOutcome) -> Section:
    """Figures before and after, how they were measured, and the deviations target by target."""
    rows = [(name, _um(before), _um(after)) for name, before, after in sheet_rows(static)]
    return Section(
        "Positioning by ISO 230-2",
        text=[
            "Deviation: table minus target. The offset between scale and encoder is unknown and "
            "cancels in all figures. The measuring device is the linear scale of the axis itself: "
            "its own deviations, and those of a tool that is not at the scale, are in no figure."
        ],
        tables=[
            Table(("um", "before", "after"), rows, _ARROWS),
            Table(("run scheme", "value"), run_scheme(static), in_words=True),
            *(_target_table(name, side) for name, side in static.sides),
        ],
        figures=[
            (
                figures.static_figure(static),
                "Deviation at the targets less its mean. Lines: means of the runs with two "
                "standard deviations on each side; points: single runs. The two scales differ.",
            )
        ],
    )


_ARROWS = "Measured; ↑ and ↓: approached upwards only, downwards only"


def _target_table(name: str, side: Approaches) -> Table:
    """Mean and standard deviation of each target in both directions."""
    rows = [
        (f"{t.target_mm:.3f}", *(_um(value) for value in t.figures_um)) for t in by_target(side)
    ]
    columns = ("target mm", "mean ↑ um", "std ↑ um", "mean ↓ um", "std ↓ um", "reversal um")
    caption = f"Target by target, {name}: deviation less the mean of all"
    return Table(columns, rows, caption)


def _um(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}"


_LEAD_NAMES = {
    "lead_peak_to_peak_um": ("lead error, peak to peak", "um"),
    "lead_slope_um_per_m": ("its slope along the travel", "um/m"),
    "mean_reversal_um": ("upwards minus downwards, mean", "um"),
    "knot_noise_um": ("noise of one knot of the map, std", "um"),
}


def lead_section(lead: LeadMap, table: Callable[[FloatArray], FloatArray] | None) -> Section:
    """The lead-error map of the slow runs, in both directions and with the table."""
    rows = [
        (*_LEAD_NAMES.get(key, (key, "")), f"{value:.3f}") for key, value in lead.summary().items()
    ]
    rows.append(("distance of knots", "mm", f"{lead.spacing_m * MM_PER_M:.4g}"))
    return Section(
        "Lead-error map",
        text=[
            "Static error of the table against the motor, from the slow runs in both directions "
            "with which the compensation was computed; the dynamic part is taken out."
        ],
        tables=[Table(("quantity", "unit", "value"), rows)],
        figures=[
            (
                figures.lead_figure(lead, table),
                "Top: the error in each direction, measured. Middle: what the table's rounding "
                "leaves of the mean, computed. Bottom: the difference of the directions.",
            )
        ],
    )
