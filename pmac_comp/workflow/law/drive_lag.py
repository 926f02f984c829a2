"""A drive that acts earlier or later than its bench file says: looked ahead for, and said.

What lives here: when it is looked for, how the compensation file keeps it, the words for people.
What may not: the fit (``physics.identify.drive_lag``).
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from pmac_comp.base.progress import Progress
from pmac_comp.base.units import US_PER_S
from pmac_comp.files.bench import Bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.compensate.law import CompensationLaw

if TYPE_CHECKING:
    from pmac_comp.physics.identify.drive_lag import DriveLag
    from pmac_comp.physics.model.drive import DriveModel

_KEY = "drive_lag"


def found_drive_lag(
    bench: Bench,
    model: "DriveModel",
    captures: Sequence[Capture],
    progress: Progress | None = None,
) -> "DriveLag | None":
    """Lag of the drive that fast runs show against the bench file; None where they do not."""
    from pmac_comp.physics.identify.drive_lag import measured_drive_lag

    if progress is not None and captures:
        progress("holding the drive's lag against the captures", 0.0)
    return measured_drive_lag(captures, bench, model)


def lag_note(found: "DriveLag") -> dict[str, Any]:
    """What a law keeps of it in its provenance; the model is kept with all else."""
    names = ("lag_s", "std_s", "held_s", "without_um", "with_um")
    return {_KEY: {name: getattr(found, name) for name in names}}


def lag_remarks(law: CompensationLaw) -> list[str]:
    """What was found, for people."""
    noted = law.provenance.get(_KEY)
    if noted is None:
        return []
    lag_us, two_std_us, held_us = (
        US_PER_S * part for part in (noted["lag_s"], 2.0 * noted["std_s"], noted["held_s"])
    )
    when = "earlier" if lag_us < held_us else "later"
    return [
        f"the drive's torque comes {abs(held_us - lag_us):.0f} us {when} than dead time and "
        f"bandwidth of the bench file make it ({lag_us:.0f} +- {two_std_us:.0f} us, and not "
        f"{held_us:.0f}): on stretches that were not fitted {noted['with_um']:.2f} um rms of the "
        f"motor's position stay with that, {noted['without_um']:.2f} without. The law looks ahead "
        "by what was found; correct actuator_delay_us and current_bandwidth_Hz, or raise their "
        "tolerance, and identify again"
    ]
