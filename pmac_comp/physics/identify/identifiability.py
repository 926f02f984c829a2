"""What the captures determine and what they do not, in words, with the run that would help.

Imports this package, ``physics.model`` (specs) and ``base``.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.sparse.csgraph import connected_components

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.errors import NotIdentifiable
from pmac_comp.base.units import MM_PER_M, UM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.identify.covariance import root_of_inverse
from pmac_comp.physics.identify.normal_equations import BLOCK_s
from pmac_comp.physics.identify.output_error import Fit
from pmac_comp.physics.identify.persistence import file_key
from pmac_comp.physics.identify.records import Record
from pmac_comp.physics.identify.result import correlation_of
from pmac_comp.physics.model.chain import USUAL_ONLY
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.model.quasi_static import compliance_m_per_N, modes_Hz

# Functionals that compensation needs; sums where the parts cannot be told apart by design.
ESSENTIAL: Mapping[str, tuple[str, ...]] = {
    "Coulomb friction of the guide": ("coulomb.guide_N",),
    "viscous friction of the guide": ("viscous.guide_Ns_per_m",),
    "Coulomb friction of nut and front bearing together": ("coulomb.nut_Nm", "coulomb.motor_Nm"),
    "viscous friction of nut and front bearing together": (
        "viscous.nut_Nms_per_rad",
        "viscous.motor_Nms_per_rad",
    ),
    "axial stiffness": ("chain.axial_stiffness_N_per_m",),
}
_ADVICE = {
    "Coulomb friction of the guide": "slow runs in both directions at three places of the travel",
    "viscous friction of the guide": "constant speeds up to the highest, in both directions",
    "Coulomb friction of nut and front bearing together": "the torque command in slow runs in "
    "both directions",
    "viscous friction of nut and front bearing together": "the torque command at several constant "
    "speeds, in both directions",
    "axial stiffness": "sinusoids of 10 mm at 3 Hz near both ends of the travel, or load steps "
    "from the side screws at standstill",
}
_SEPARATORS = {
    frozenset({"coulomb.nut_Nm", "coulomb.motor_Nm"}): "an added mass or a side load would "
    "(the nut's share grows with the load, the bearing's does not)",
    frozenset({"viscous.nut_Nms_per_rad", "viscous.motor_Nms_per_rad"}): "uncoupling the motor "
    "would; compensation does not need the split",
    frozenset({"chain.current_bandwidth_Hz", "chain.actuator_delay_s"}): "a torque chirp beyond "
    "the current loop's bandwidth would",
    frozenset({"chain.motor_inertia_kgm2", "chain.screw_inertia_kgm2"}): "uncoupling the motor "
    "would; they act as their sum",
    frozenset({"chain.table_mass_kg", "chain.axial_stiffness_N_per_m"}): "a known added mass, or "
    "load steps from the side screws at standstill, would",
}
_UNDETERMINED = 0.5  # std over size: worse than this and the sign is all that is known
_USUAL = 0.5  # of the usual size, at least
_FAST = 0.6  # of the highest speed that the bench allows
_TIED = 0.95
_RESONANCE_FRAC = 0.05  # twice what tolerances of 5 % on the mass do to the frequency
_SURELY = 2.0  # standard deviations beyond the end of the tolerance
_FROM_BENCH = 0.5  # share of the prior's variance that remains


def require_table(captures: Sequence[Capture]) -> None:
    """Raise NotIdentifiable where no capture of an elastic drive holds the table's position.

    The motor's loop meets the sum of all friction and a mass that is hardly elastic for it: a fit
    to it alone divides them as its own small errors happen to fall.
    """
    if any(c.table_position_m is not None for c in captures):
        return
    raise NotIdentifiable(
        "Not identifiable from these captures: stiffness, and what friction acts at guide, nut and "
        "motor. None of them holds the position of the table.",
        code="PC-IDN-007",
        hint="Capture the runs with the scale at the table; or state the axis as one mass (no "
        "axial_stiffness_N_per_um in [nominal]): then its whole mass and friction are identified.",
    )


def require_long_enough(records: Sequence[Record]) -> None:
    """Raise NotIdentifiable where there are fewer stretches of time than quantities to determine.

    Intervals come from the scatter between stretches; with so few, there is none.
    """
    stretches = 0
    for record in records:
        size = max(round(BLOCK_s / record.period_s), 1)
        stretches += len(set(np.flatnonzero(record.valid) // size))
    if stretches < len(ESSENTIAL):
        raise NotIdentifiable(
            f"Not identifiable from these captures: {stretches} stretches of {BLOCK_s:g} s in "
            f"motion cannot determine {len(ESSENTIAL)} quantities (friction and stiffness).",
            code="PC-IDN-008",
            hint="Capture " + "; and ".join(dict.fromkeys(_ADVICE.values())) + ", some seconds "
            "each (`pmac-comp capture` has a default campaign).",
        )


def require_identifiable(
    fit: Fit, *, has_torque: bool, speed_m_per_s: float = 0.0
) -> tuple[str, ...]:
    """Raise NotIdentifiable where something that compensation needs is not determined.

    Parameters
    ----------
    fit : Fit
        The refinement.
    has_torque : bool
        Whether a capture holds the torque.
    speed_m_per_s : float
        Highest speed of the captures in m/s.

    Returns
    -------
    tuple of str
        Viscous friction that is open although the captures reach the highest speeds of the bench,
        in words: a small slow stage has no runs that would tell it.
    """
    stds = {
        what: std
        for what, names in ESSENTIAL.items()
        if (std := _open_std(fit, names)) and (has_torque or "nut and front" not in what)
    }
    fast = speed_m_per_s > _FAST * fit.model.bench.usable_speed_m_per_s
    open_points = [what for what in stds if not (fast and "viscous" in what)]
    if open_points:
        runs = [_ADVICE[what] for what in open_points]
        raise NotIdentifiable(
            "Not identifiable from these captures: " + "; ".join(open_points) + ".",
            code="PC-IDN-006",
            hint="Capture " + "; and ".join(runs) + ".",
            context={"parameters": [n for what in open_points for n in ESSENTIAL[what]]},
        )
    return tuple(
        f"The {what} is not determined, although the captures reach the highest speeds of the "
        f"bench file{_bend(fit, what, std, speed_m_per_s)}."
        for what, std in stds.items()
    )


def _bend(fit: Fit, what: str, std: float, speed_m_per_s: float) -> str:
    """How far two standard deviations of the guide's friction bend the drive, in words."""
    if "guide" not in what or fit.model.is_rigid:
        return ""
    travel = fit.model.bench.travel
    ends_m = np.array([travel.min_mm, travel.max_mm]) / MM_PER_M
    bend_m = 2.0 * std * speed_m_per_s * float(np.max(compliance_m_per_N(fit.model, ends_m)))
    return f": what it may be bends the drive by up to {bend_m * UM_PER_M:.2g} um there"


def informed_frac(fit: Fit) -> FloatArray:
    """Share of each prior's standard deviation that the captures removed, shape (p,), 0..1."""
    prior_std = fit.scales / np.sqrt(np.where(fit.prior > 0.0, fit.prior, np.nan))
    share = 1.0 - np.sqrt(np.diag(fit.covariance)) / prior_std
    return np.asarray(np.clip(np.nan_to_num(share, nan=1.0), 0.0, 1.0))


def statements(fit: Fit) -> tuple[str, ...]:
    """Identifiability in words."""
    return (*_tied(fit), *_from_bench(fit), *_outside_tolerance(fit))


def _open_std(fit: Fit, names: tuple[str, ...]) -> float:
    """Standard deviation of a sum that the captures leave open, 0 where they determine it."""
    index = [fit.names.index(name) for name in names if name in fit.names]
    if len(index) < len(names):
        return 0.0
    # What the runs excite decides, not what the model misfits: that widens the intervals instead.
    root, _ = root_of_inverse(fit.information + np.diag(fit.prior))
    std = float(np.linalg.norm(fit.scales[index] @ root[index]))
    # A value that something unnamed has pushed to nothing is no less determined than it was before.
    size = max(
        sum(abs(fit.model.parameters[name]) for name in names),
        _USUAL * float(fit.scales[index].sum()),
    )
    return std if std > _UNDETERMINED * size else 0.0


def _tied(fit: Fit) -> list[str]:
    """One sentence per group of parameters that these runs move together."""
    tied = np.abs(correlation_of(fit.covariance)) > _TIED
    _, group = connected_components(tied, directed=False)
    found = []
    for label in dict.fromkeys(group):
        members = [fit.names[i] for i in np.flatnonzero(group == label)]
        if len(members) > 1:
            listed = ", ".join(_in_files(fit, name) for name in members[:-1])
            found.append(
                f"{listed} and {_in_files(fit, members[-1])} cannot be told apart on these runs; "
                f"{_separator(members)}."
            )
    return found


def _separator(members: Sequence[str]) -> str:
    """What would tell the members of a group apart."""
    known = [text for pair, text in _SEPARATORS.items() if pair <= set(members)]
    return "; ".join(known) or "runs that move them differently would"


def _from_bench(fit: Fit) -> list[str]:
    share = informed_frac(fit)
    names = [
        name
        for name, part in zip(fit.names, share, strict=True)
        if part < _FROM_BENCH and fit.model.spec(name).kind == "known"
    ]
    stated = ", ".join(_in_files(fit, name) for name in names if name != USUAL_ONLY)
    found = []
    if stated:
        found.append(f"These values rest mainly on the bench file, not on the captures: {stated}.")
    if USUAL_ONLY in names:
        usual = _in_files(fit, USUAL_ONLY)
        found.append(f"{usual} rests mainly on what is usual of drives, not on the captures.")
    return found


def _outside_tolerance(fit: Fit) -> list[str]:
    """Known values that the captures put clearly outside what the bench file allows."""
    found = []
    for i, name in enumerate(fit.names):
        spec = fit.model.spec(name)
        if spec.kind != "known" or spec.tolerance_frac is None or name == USUAL_ONLY:
            continue
        off = fit.model.parameters[name] - spec.nominal
        beyond = abs(off) - spec.tolerance_frac * abs(spec.nominal)
        if beyond > _SURELY * float(np.sqrt(fit.covariance[i, i])):
            percent = 100.0 * off / spec.nominal
            found.append(f"{_in_files(fit, name)} ({percent:+.0f} %)")
    if not found:
        return []
    return [
        "The captures put these values outside the tolerances of the bench file: "
        + ", ".join(found)
        + ". Check them there, and pitch_mm, counts_per_rev and torque_per_dac_Nm, which scale "
        "them all; or something is missing in the model (`pmac-comp diagnose`)."
    ]


def _in_files(fit: Fit, name: str) -> str:
    """Name of a parameter as the table and the model file have it."""
    return file_key(fit.model.spec(name), rigid=fit.model.is_rigid)


def resonance_statement(model: DriveModel, bench: Bench) -> tuple[str, ...]:
    """What the measured resonance of the bench file says of the fitted chain, if it states one."""
    stated, at_mm = bench.known.resonance_Hz, bench.known.resonance_at_mm or 0.0
    if stated is None or model.is_rigid:
        return ()
    found = float(modes_Hz(model, at_mm / MM_PER_M)[0])
    text = (
        f"First resonance at {at_mm:g} mm: {found:.1f} Hz from the identified chain, {stated:g} Hz "
        "stated in the bench file"
    )
    if abs(found / stated - 1.0) < _RESONANCE_FRAC:
        return (f"{text}.",)
    return (
        f"{text}. They do not agree: check table_mass_kg and the stiffnesses in [nominal], or "
        "whether the load was another when it was measured.",
    )
