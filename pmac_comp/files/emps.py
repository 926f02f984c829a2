"""The EMPS record: the prismatic axis that identification is tried on with real data.

The record itself is not part of this project; its MAT file is read where a user has it.
"""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from pmac_comp.base.units import lead_m_per_rad
from pmac_comp.files.capture import Capture

VARIABLES: Final = frozenset({"t", "qg", "qm", "vir", "gtau"})
_PITCH_m: Final = 2.5e-3  # 50 000 counts of 50 nm per revolution


def emps_capture(data: Mapping[str, Any]) -> Capture:
    """Capture from the variables of the record's MAT file.

    The record has the drive voltage and the force gain; the force is stored at the screw as a
    torque with the record's pitch.
    """
    lead_m = lead_m_per_rad(_PITCH_m)
    voltage_V = np.asarray(data["vir"], dtype=np.float64)
    return Capture(
        time_s=np.asarray(data["t"], dtype=np.float64),
        commanded_position_m=np.asarray(data["qg"], dtype=np.float64),
        motor_position_m=np.asarray(data["qm"], dtype=np.float64),
        torque_command_Nm=float(data["gtau"]) * voltage_V * lead_m,
        extra={"drive_voltage_V": voltage_V},
        attributes={
            "source": "EMPS record (Janot, Gautier, Brunot 2019)",
            "gain_N_per_V": float(data["gtau"]),
            "lead_m_per_rad": lead_m,
        },
    )
