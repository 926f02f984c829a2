"""Section on a repeated motion: what the model alone gives, and what learning adds pass by pass."""

from pmac_comp.report import figures
from pmac_comp.report.page import Section, Table, sentence
from pmac_comp.workflow.verification.learning import Refinement


def learning_section(found: Refinement) -> Section:
    """Error without anything, with what learning began from and with its end; the passes."""
    learning = found.learning
    added = found.start_share + found.learning_share
    learned = f"with what was learned ({found.basis})"
    rows = [
        ("without compensation", f"{found.without_um:.2f}", "–"),
        (f"with {found.start}", f"{found.start_um:.2f}", f"{100 * found.start_share:.1f} %"),
        (learned, f"{found.confirmed_um:.2f}", f"{100 * added:.1f} %"),
    ]
    names = ("pass", "total error, um rms", f"below {learning.cutoff_Hz:.0f} Hz, um rms")
    passes = [
        (str(number), f"{left:.3f}", f"{part:.3f}")
        for number, (left, part) in enumerate(
            zip(learning.history_um, learning.learnable_um, strict=True)
        )
    ]
    return Section(
        "Learning on top of the model",
        points=[sentence(line) for line in found.lines()],
        tables=[
            Table(("total error with its rests, measured", "um rms", "taken away"), rows),
            Table(names, passes, f"Pass by pass; pass 0 is {found.start}"),
        ],
        figures=[
            (
                figures.learning_figure(learning.history_um, learning.learnable_um),
                "What is left pass by pass. Only what lies below the cutoff can be learned: its "
                "fall is the proof of convergence.",
            )
        ],
    )
