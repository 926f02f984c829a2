"""The model that a law was made with: the model file's, with what the runs showed beyond it."""

from typing import TYPE_CHECKING

from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.workflow.late_scale import in_time
from pmac_comp.workflow.loose_nut import loosened
from pmac_comp.workflow.swinging_bed import on_bed

if TYPE_CHECKING:
    from pmac_comp.physics.model.drive import DriveModel


def made_with(model: "DriveModel", law: CompensationLaw) -> "DriveModel":
    """The model that a law was made with, from the model that it was computed from."""
    return loosened(on_bed(in_time(model, law.provenance), law.provenance), law)
