"""A scale that is read late: found, taken out of captures, and said.

What lives here: when its time is looked for, how the compensation file keeps it, captures whose
two readings belong together, the words for people. What may not: the fit
(``physics.identify.scale_age``).

A law that took this lag for an error of the table would make the table lead its command.
"""

from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pmac_comp.base.progress import Progress
from pmac_comp.base.units import US_PER_S
from pmac_comp.files.bench import Bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.compensate.law import CompensationLaw

if TYPE_CHECKING:
    from pmac_comp.physics.model.drive import DriveModel

_KEY = "scale_age"
_SKEW = "channel_skew"
_TIME = "time_s"


def noted_age(
    bench: Bench,
    model: "DriveModel",
    captures: Sequence[Capture],
    progress: Progress | None = None,
) -> dict[str, Any]:
    """What a law keeps of the age of the scale's samples in its provenance; empty for none.

    It is the model's own (``channel_skew``), or what fast runs show beyond the model.
    """
    from pmac_comp.physics.identify.scale_age import measured_scale_age

    if _SKEW in model.effects:
        return {_KEY: model.values_of(_SKEW)}
    if progress is not None and captures:
        progress("looking for a scale that is read late", 0.0)
    found = measured_scale_age(captures, bench, model)
    return {} if found is None else {_KEY: asdict(found)}


def scale_age_s(noted: dict[str, Any]) -> float:
    """Time in s by which the scale is read after the encoder; 0 where nothing is noted."""
    return float(noted.get(_KEY, {}).get(_TIME, 0.0))


def read_together(capture: Capture, age_s: float) -> Capture:
    """The capture as a scale that is not read late would have given it."""
    table_m = capture.table_position_m
    if age_s == 0.0 or table_m is None:
        return capture
    time_s = capture.time_s
    return replace(capture, table_position_m=np.interp(time_s + age_s, time_s, table_m))


def in_time(model: "DriveModel", noted: dict[str, Any]) -> "DriveModel":
    """The drive behind a scale that is read late: without that time, as it was fitted beside it."""
    if _SKEW in model.effects:
        model = model.without_effect(_SKEW)
    values = noted.get(_KEY, {}).get("values", {})
    return model.with_parameters({k: v for k, v in values.items() if k in model.parameters})


def scale_remarks(law: CompensationLaw) -> list[str]:
    """What was found, for people."""
    noted = law.provenance.get(_KEY)
    if noted is None:
        return []
    time_us = noted[_TIME] * US_PER_S
    when = "after" if time_us > 0.0 else "before"
    said = f"the scale is read {abs(time_us):.1f} us {when} the encoder"
    if "std_s" in noted:
        said += (
            f" (+- {2.0 * noted['std_s'] * US_PER_S:.1f}; on stretches that were not fitted "
            f"{noted['without_um']:.2f} um rms of table minus motor stay without it, "
            f"{noted['with_um']:.2f} with it)"
        )
    return [
        f"{said}: it lags by speed times that, which is no error of the table. The law leaves it "
        "alone, and `verify` takes it out of what the scale says"
    ]
