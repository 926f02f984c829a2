"""Diagnosis: where simulation and measurement disagree, and which physical effect is missing."""

from pmac_comp.physics.diagnose.contenders import Rules
from pmac_comp.physics.diagnose.diagnose import diagnose
from pmac_comp.physics.diagnose.result import Diagnosis, Evidence, SeparatingExperiment

__all__ = ["Diagnosis", "Evidence", "Rules", "SeparatingExperiment", "diagnose"]
