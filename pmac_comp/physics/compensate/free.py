"""Which coefficients of a law are free, the size of a typical change of each, and their bounds.

What lives here: what fit and search change alike. What may not: how they do (``design``,
``search``).
"""

from collections.abc import Sequence

from pmac_comp.base.arrays import FloatArray
from pmac_comp.physics.compensate.law import CompensationLaw

LEAST_COULOMB_m = 0.05e-6  # of a law with a gap: it tells the flank
# Of a fit by squares: a model knows when the force turns to the sample, a drive's friction does
# not, and where the model likes it best a tenth more of plants was left. The search that follows
# goes further. On a light axis friction winds up less than this, and a flank that it cannot fill
# would never be reached.
_LEAST_WIDTH_m = 0.3e-6
_LEAST_WIDTH_FRAC = 0.3  # of what friction winds up

# Free coefficients with the size of a typical change.
_OFFSET_SCALES = {
    "inertia_s2": 2e-6,
    "viscous_s": 4e-6,
    "coulomb_m": 1e-6,
    "compliance_slope_per_m": 1.0,
    "jerk_s3": 1e-9,
    "breakaway_m": 1e-5,
}
_TORQUE_SCALES = {
    "torque_inertia_Nm_s2_per_m": 0.02,
    "torque_jerk_Nm_s3_per_m": 5e-4,
    "torque_impulse_Nm_s3_per_m": 1e-3,
    "torque_viscous_Nm_s_per_m": 0.2,
    "torque_coulomb_Nm": 0.2,
    "torque_load_Nm_s2_per_m": 0.02,
    "torque_breakaway_m": 1e-5,
    "torque_constant_Nm": 0.02,
    "rest_fade_per_s": 5.0,
}
# Left to the search: a fit by squares would give away how fast friction fades at a rest for these.
TURNING_SCALES = {"torque_turning_Nm_s": 2e-5, "torque_turned_Nm_s": 2e-5}
LAG_SCALES = {"coulomb_lag_s": 1e-4}
_GAP_SCALES = {"gap_half_m": 1e-6, "gap_width_m": 0.5e-6, "gap_lag_s": 1e-3}
_GAP_TORQUE_SCALES = {"gap_torque_Nm": 0.1}
_GAP_LOAD_SCALES = {"gap_load_m": 0.5e-6}
_STRIBECK_SCALES = {"stribeck_m": 0.5e-6, "stribeck_speed_m_per_s": 5e-3}
_STRIBECK_TORQUE_SCALES = {"torque_stribeck_Nm": 0.05}
_SMOOTH_SCALES, _SLOWEST_SMOOTH = {"stribeck_speed_m_per_s": 1e-3}, 5e-5
_BED_TORQUE_SCALES = {"torque_bed_Nm_s2_per_m": 0.02}
_LOWEST = {
    "breakaway_m": 0.5e-6,
    "torque_breakaway_m": 0.5e-6,
    "rest_fade_per_s": 4.5,  # 0.82 are left: with all of it the motor creeps on
    "gap_half_m": 0.0,
    "gap_lag_s": 0.0,
    "coulomb_lag_s": 0.0,
    "stribeck_m": 0.0,
    "torque_stribeck_Nm": 0.0,
    "stribeck_speed_m_per_s": 1e-3,
}
# Gone in ten servo cycles; a pass that takes away more than there is would swing.
FASTEST_FADE_per_s = 400.0


def free_coefficients(start: CompensationLaw) -> tuple[dict[str, float], dict[str, float]]:
    """Coefficients of a law that are fitted, with the size of a typical change, and their bounds.

    Of a term that the law begins without, none is free.
    """
    has_torque = start.torque_limit_Nm > 0.0
    sizes = {**_OFFSET_SCALES, **(_TORQUE_SCALES | TURNING_SCALES if has_torque else {})}
    if start.torque_constant_Nm == 0.0:
        # A drive without load is the same both ways: a constant would fit the motions, not it.
        sizes.pop("torque_constant_Nm", None)
    lowest = dict(_LOWEST)
    if start.gap_half_m > 0.0:
        sizes |= _GAP_SCALES | (_GAP_TORQUE_SCALES if has_torque else {})
        sizes |= _GAP_LOAD_SCALES if start.gap_load_m != 0.0 else {}
        lowest["coulomb_m"] = LEAST_COULOMB_m
        lowest["gap_width_m"] = min(_LEAST_WIDTH_m, _LEAST_WIDTH_FRAC * start.coulomb_m)
    if start.bed_share > 0.0:
        sizes |= _BED_TORQUE_SCALES if has_torque else {}
    else:
        sizes |= LAG_SCALES
    if start.is_smooth:
        sizes |= _SMOOTH_SCALES
        sizes.pop("rest_fade_per_s", None)  # there is nothing at rest
        lowest["stribeck_speed_m_per_s"] = _SLOWEST_SMOOTH
    elif start.has_stribeck:
        sizes |= _STRIBECK_SCALES | (_STRIBECK_TORQUE_SCALES if has_torque else {})
    return sizes, lowest


def with_free(law: CompensationLaw, names: Sequence[str], values: FloatArray) -> CompensationLaw:
    """The law with the named coefficients of these values, shape (n,)."""
    given = dict(zip(names, values.tolist(), strict=True))
    # A limit here and none of the fit: near one that is not even reached it ends elsewhere.
    fade = min(given.get("rest_fade_per_s", law.rest_fade_per_s), FASTEST_FADE_per_s)
    return law.with_values(**given | {"rest_fade_per_s": fade})
