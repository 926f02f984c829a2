"""Identification of friction and stiffness from captures, with honest intervals.

Imports ``physics.model``, ``files`` and ``base``; knows no controller.
"""

from pmac_comp.physics.identify.friction_form import identify_with_friction
from pmac_comp.physics.identify.joint import identify
from pmac_comp.physics.identify.persistence import model_from_file, to_model_file
from pmac_comp.physics.identify.result import (
    CaptureResiduals,
    Identification,
    NoiseLevels,
    ParameterEstimate,
    StaticMap,
)

__all__ = [
    "CaptureResiduals",
    "Identification",
    "NoiseLevels",
    "ParameterEstimate",
    "StaticMap",
    "identify",
    "identify_with_friction",
    "model_from_file",
    "to_model_file",
]
