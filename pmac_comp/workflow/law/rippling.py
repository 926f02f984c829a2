"""Torque that ripples by the turn, where runs show it: known while other findings are looked for.

What lives here: when it is looked for. What may not: how it is read (``physics.compensate.ripple``,
which reads it again for the law), its fit (``physics.identify.refit``).

A tenth of the torque that comes and goes by the turn moves motor and table by more than a scale
that is read late or a nut that lets go, and hides both.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from pmac_comp.base.progress import Progress
from pmac_comp.files.bench import Bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.compensate.ripple import RIPPLE, rippling_model

if TYPE_CHECKING:
    from pmac_comp.physics.model.drive import DriveModel


def rippling(
    bench: Bench,
    model: "DriveModel",
    captures: Sequence[Capture],
    progress: Progress | None = None,
) -> "DriveModel":
    """The model with the ripple that fast runs show beyond it, all of it fitted beside that.

    As it is where they show none or where held-out samples do not bear it out.
    """
    from pmac_comp.physics.identify.refit import fitted_beside

    if model.is_rigid or RIPPLE in model.effects or not captures:
        return model
    if progress is not None:
        progress("looking for torque that ripples", 0.0)
    grown = rippling_model(model, captures)
    return model if grown is None else fitted_beside(captures, bench, model, grown) or model
