"""What the torque lacks at the same places of the axis in every run, where something has no name.

What lives here: the torque that a model leaves, foretold by place from the other runs, and the
sentence on it. May import ``growth``, ``place`` and ``remainder``.

A loop hides from positions what its integrator takes up: friction that is higher on a stretch of
the guide leaves its derivative in the residual of the table, and its own shape in the torque.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pmac_comp.base.arrays import BoolArray, FloatArray
from pmac_comp.base.units import UM_PER_M
from pmac_comp.physics.diagnose.growth import Grown
from pmac_comp.physics.diagnose.place import place_pattern
from pmac_comp.physics.diagnose.remainder import Remainder

_BY_CHANCE = 1e-3
_LEAST_SHARE = 0.03  # of the square of what the torque lacks
_CREEP_m_per_s = 1e-3  # below it friction has any value within its level
# What it is with the sign of the motion taken out, and as it is.
_FRICTION = (
    "friction differs by place",
    "against the motion, whichever way it goes",
    "a guide, a wiper or a nut that is tight, worn or dirty there. It has no name in the library; "
    "`configs/effect_worn_stretch.py` is an effect of that kind to give with `--effects`",
)
_FORCE = (
    "a force differs by place",
    "up the travel, in both directions alike",
    "a cable, a cover or a counterweight",
)


@dataclass(frozen=True)
class TorqueLeft:
    """Torque that a model leaves of one run.

    Parameters
    ----------
    left_Nm, position_m, speed_m_per_s : ndarray, shape (n,)
        Recorded less simulated torque command, and the simulated motion of the motor.
    counted : ndarray of bool, shape (n,)
        Samples that evidence may come from.
    """

    left_Nm: FloatArray
    position_m: FloatArray
    speed_m_per_s: FloatArray
    counted: BoolArray

    @property
    def moving(self) -> BoolArray:
        """Counted samples in motion, shape (n,)."""
        return np.asarray(self.counted & (np.abs(self.speed_m_per_s) > _CREEP_m_per_s))


def told_by_torque(grown: Grown, left: Remainder) -> tuple[str, ...]:
    """A sentence on torque that comes back by place; none where nothing without a name is left."""
    workbench = grown.workbench
    if not left.unexplained or any(r.torque_Nm is None for r in workbench.records):
        return ()
    runs = []
    for record, counted in zip(workbench.records, workbench.counted, strict=True):
        if record.torque_Nm is None:
            continue
        response = record.response(grown.final.model)
        position_m = record.coarsen(response.motor_position_m)
        runs.append(
            TorqueLeft(
                record.coarsen(record.torque_Nm - response.torque_command_Nm),
                position_m,
                np.gradient(position_m, record.coarse_period_s),
                counted,
            )
        )
    block = max(1, round(workbench.block_s / workbench.records[0].coarse_period_s))
    return sentences(runs, pitch_m=grown.final.model.bench.pitch_m, block=block)


def sentences(runs: Sequence[TorqueLeft], *, pitch_m: float, block: int) -> tuple[str, ...]:
    """What the runs share by place: friction, or a force, whichever explains more of the torque.

    Parameters
    ----------
    runs : sequence of TorqueLeft
        All runs.
    pitch_m : float
        Travel per revolution: the shortest place.
    block : int
        Samples that are judged together.

    Returns
    -------
    tuple of str
        Nothing where runs do not foretell each other.
    """
    positions, moving = [r.position_m for r in runs], [r.moving for r in runs]
    found = []
    for words, signed in (
        (_FRICTION, [r.left_Nm * np.sign(r.speed_m_per_s) for r in runs]),
        (_FORCE, [r.left_Nm for r in runs]),
    ):
        pattern = place_pattern(signed, positions, moving, pitch_m=pitch_m, block=block)
        if pattern is None or pattern.p_value > _BY_CHANCE:
            continue
        if pattern.region.share > _LEAST_SHARE:
            found.append((pattern.region, words))
    if not found:
        return ()
    region, (what, way, causes) = max(found, key=lambda f: f[0].share)
    shape_Nm = np.asarray(region.means_um) / UM_PER_M
    worst = int(np.argmax(np.abs(shape_Nm)))
    return (
        f"In the torque {what} ({100 * region.share:.0f} % of what it lacks): around "
        f"{region.centres[worst]:.4g} mm by {shape_Nm[worst]:+.2g} N m at the motor, {way}, over "
        f"the travel from {shape_Nm.min():+.2g} to {shape_Nm.max():+.2g}: {causes}.",
    )
