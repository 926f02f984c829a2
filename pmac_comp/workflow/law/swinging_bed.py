"""A machine bed that the runs show to swing and the model does not hold: in the law, and said.

What lives here: when it is looked for, how the compensation file keeps it, the words for people.
What may not: the fit (``physics.identify.swinging_bed``).
"""

from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from pmac_comp.base.progress import Progress
from pmac_comp.files.bench import Bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.compensate.law import CompensationLaw

if TYPE_CHECKING:
    from pmac_comp.physics.model.drive import DriveModel

_KEY = "bed"
_EFFECT = "base_mode"
_OWN = ("frequency_Hz", "mass_ratio", "damping_ratio")


def noted_bed(
    bench: Bench,
    model: "DriveModel",
    captures: Sequence[Capture],
    progress: Progress | None = None,
) -> dict[str, Any]:
    """What a law keeps of a bed that swings in its provenance; empty for none.

    A model that holds one (``base_mode``) is taken at its word.
    """
    from pmac_comp.physics.identify.swinging_bed import measured_bed

    if _EFFECT in model.effects:
        return {}
    if progress is not None and captures:
        progress("looking for a bed that swings", 0.0)
    found = measured_bed(captures, bench, model)
    return {} if found is None else {_KEY: asdict(found)}


def on_bed(model: "DriveModel", noted: dict[str, Any]) -> "DriveModel":
    """The drive on the bed that the runs showed, as it was fitted beside it."""
    bed = noted.get(_KEY)
    if bed is None or _EFFECT in model.effects:
        return model
    own = {name: bed[name] for name in _OWN}
    known = {k: v for k, v in bed["values"].items() if k in model.parameters}
    return model.with_parameters(known).with_effect(_EFFECT, own)


def bed_remarks(law: CompensationLaw) -> list[str]:
    """What was found, for people."""
    bed = law.provenance.get(_KEY)
    if bed is None:
        return []
    return [
        f"the bed, or a mass that hangs on the table, swings at {bed['frequency_Hz']:.1f} Hz as "
        f"the table accelerates (table mass over bed mass {bed['mass_ratio']:.3f} +- "
        f"{2.0 * bed['mass_ratio_std']:.3f}, damping ratio "
        f"{bed['damping_ratio']:.3f}), which the model does not hold: on stretches that were not "
        f"fitted {bed['without_um']:.2f} um rms of table minus motor stay without it, "
        f"{bed['with_um']:.2f} with it. The law undoes what the table feels of it; `pmac-comp "
        "diagnose` tells what it is, and stiffer feet, or a stiffer mount, end it"
    ]
