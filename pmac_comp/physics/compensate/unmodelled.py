"""What a model and its law leave of measured errors: the part of a promise that no model makes.

What lives here: the rest of the mechanical and of the total error of captures, after the model,
the lead map and the torque per turn, and how it widens a promise. What may not: controllers.

How much of what a model does not hold comes back in runs with compensation is open: a force that
it lacks goes through the loop the same way, while what sticks at reversals is gone where the law
carries friction across. A promise therefore reaches from the model's word alone to that with the
largest rest of the captures on top, and names the middle of both in proportion. By how much the
model's errors are off in size, in the captures, widens it on either side.

The upper end adds plainly: in the worst case what the model lacks runs with what the law leaves.
In squares, 13 of 348 promises of the law for simulated drives with two to four effects that the
model does not hold were missed by up to 14 %; plainly none, by the same runs.

Where an axis stops inside its friction, hairs of the bearings' and the guide's stick decide how far
screw and table stay wound up, and the next run of the same motion ends elsewhere. The model stops
in one place. A drive with rolling elements that stick over 0.1 um, where the model's does over
0.03, missed e_r of short moves by up to 28 %, all of it at rest and as the moves began; that part
is as large as friction's own, joins in squares, and belongs to e_r alone.

In the middle, what the model lacks runs with what it has: friction that is a little larger adds to
the error of friction itself. Where a compensation takes the model's error away, that is gone, and
what is left of both adds in squares; where it leaves the error as it was, both add plainly. So the
share of the model's error that stays stands for how far both run together.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.units import UM_PER_M
from pmac_comp.files.capture import Capture
from pmac_comp.physics.compensate.evaluation import evaluate_law
from pmac_comp.physics.compensate.grip import gripping_torque
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.compensate.lead import LeadMap
from pmac_comp.physics.compensate.loop import LoopRunner
from pmac_comp.physics.compensate.promise import MotionPromise
from pmac_comp.physics.compensate.starts import held_at_start_Nm

_NOTE = "unmodelled"  # of a law's provenance
# Fresh motions are not those of the captures: the worst of a handful is not the worst there is.
_BEYOND_WORST = 1.25
_MOST_OFF = 0.9


@dataclass(frozen=True)
class Unmodelled:
    """Rest of captures in um rms: least, typical and largest of the runs.

    Parameters
    ----------
    mechanical_um, total_um : tuple of three float
        Of table minus motor and of table minus command, sensor noise taken out.
    off_frac : tuple of two float
        Two standard deviations of the rms that the model gives these two, relative to what the
        captures have.
    """

    mechanical_um: tuple[float, float, float]
    total_um: tuple[float, float, float]
    off_frac: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def from_mapping(cls, values: Mapping[str, Sequence[float]]) -> "Unmodelled":
        """From what ``as_mapping`` gave, read back from a file."""
        low, mid, high = (float(v) for v in values["mechanical_um"])
        least, typical, most = (float(v) for v in values["total_um"])
        mechanical, total = (float(v) for v in values.get("off_frac", (0.0, 0.0)))
        return cls((low, mid, high), (least, typical, most), (mechanical, total))

    def as_mapping(self) -> dict[str, list[float]]:
        """For a file."""
        return {name: list(value) for name, value in asdict(self).items()}


def noting_unmodelled(law: CompensationLaw, rest: Unmodelled) -> CompensationLaw:
    """The law with what captures showed beyond its model, which widens its promise."""
    return law.noting({_NOTE: rest.as_mapping()})


def noted_unmodelled(law: CompensationLaw) -> Unmodelled | None:
    """What captures showed beyond the model of a law, as it keeps that; None without captures."""
    noted = law.provenance.get(_NOTE)
    return None if noted is None else Unmodelled.from_mapping(noted)


def unmodelled(
    law: CompensationLaw,
    loop: LoopRunner,
    captures: Sequence[Capture],
    lead: LeadMap | None,
    *,
    motor_step_m: float,
    table_step_m: float,
) -> Unmodelled | None:
    """What a model with its law leaves of captures; None without captures at the table.

    Parameters
    ----------
    law : CompensationLaw
        With its torque per turn, and with its ``trim`` where captures moved it.
    loop : LoopRunner
        Closed loop of the model.
    captures : sequence of Capture
        Runs without compensation.
    lead : LeadMap or None
        Static error.
    motor_step_m, table_step_m : float
        Steps of encoder and scale.
    """
    rests = [_rests(law, loop, c, lead) for c in captures if c.table_position_m is not None]
    if not rests:
        return None
    scale_um = table_step_m / math.sqrt(12.0) * UM_PER_M
    both_um = math.hypot(motor_step_m, table_step_m) / math.sqrt(12.0) * UM_PER_M
    return Unmodelled(
        _three([rest.mechanical_um for rest in rests], both_um),
        _three([rest.total_um for rest in rests], scale_um),
        (
            _off([rest.mechanical_sizes_um for rest in rests], both_um),
            _off([rest.total_sizes_um for rest in rests], scale_um),
        ),
    )


@dataclass(frozen=True)
class _Rest:
    """Standard deviations in um of one run: what is left, and the model's and the run's own."""

    mechanical_um: float
    total_um: float
    mechanical_sizes_um: tuple[float, float]
    total_sizes_um: tuple[float, float]


def _off(sizes_um: Sequence[tuple[float, float]], floor_um: float) -> float:
    """Two standard deviations of the model's size over the measured one, less one."""
    own, measured = np.array(sizes_um).T
    clean = np.sqrt(np.maximum(measured**2 - floor_um**2, 1e-6))
    return float(min(_MOST_OFF, 2.0 * np.sqrt(np.mean((own / clean - 1.0) ** 2))))


def _three(values_um: Sequence[float], floor_um: float) -> tuple[float, float, float]:
    clean = np.sqrt(np.maximum(np.square(values_um) - floor_um**2, 0.0))
    typical = float(np.sqrt(np.mean(clean**2)))
    return float(clean.min()), typical, _BEYOND_WORST * float(clean.max())


def _rests(law: CompensationLaw, loop: LoopRunner, capture: Capture, lead: LeadMap | None) -> _Rest:
    """What is left of the mechanical and the total error of a run."""
    r, period = capture.commanded_position_m, capture.sample_period_s
    per_turn = turn_torque_Nm(law, r, period)
    load_Nm = law.torque_place_Nm_per_m * (r - r[0])  # at the start the integrator holds it
    speed = np.gradient(r, period)
    uneven_Nm = law.torque_uneven_Nm_s_per_m * np.abs(speed)
    added_Nm = gripping_torque(law, capture) - per_turn - load_Nm - uneven_Nm
    signals = loop(r, None, added_Nm, held_at_start_Nm(capture))
    table = capture.table_position_m if capture.table_position_m is not None else r
    static = 0.0 if lead is None else lead.at(r)
    measured = table - capture.motor_position_m - static
    simulated = signals.table_position_m - signals.motor_position_m
    own = model_law(law)
    if own != law:
        moved = evaluate_law(law.without_torque(), r, period).correction_m
        simulated = simulated - moved + evaluate_law(own.without_torque(), r, period).correction_m
    total, expected = table - static - r, signals.table_position_m - r
    use = capture.mask  # with the flank on which a nut with a gap began, as in runs to come
    return _Rest(
        _std_um((measured - simulated)[use]),
        _std_um((total - expected)[use]),
        (_std_um(simulated[use]), _std_um(measured[use])),
        (_std_um(expected[use]), _std_um(total[use])),
    )


def _std_um(values: FloatArray) -> float:
    return float(np.std(values) * UM_PER_M)


def turn_torque_Nm(law: CompensationLaw, position_m: FloatArray, period_s: float) -> FloatArray:
    """What of its torque a law sends by the turn along a commanded position, shape (n,)."""
    whole, others = (
        evaluate_law(one, position_m, period_s).torque_Nm for one in (law, law.without_turn())
    )
    return np.asarray(whole - others)


def model_law(law: CompensationLaw) -> CompensationLaw:
    """The law as the model alone gives it: without what captures added to it."""
    own = {name: getattr(law, name) - change for name, change in law.trim.items()}
    return law.without_turn().with_values(**own)


def open_at_rest_um(law: CompensationLaw, position_m: FloatArray) -> float:
    """What friction leaves open of e_r over a motion, um rms: at rest it may hold anything.

    As likely anywhere between its level in one direction and in the other, while the command
    stands; shape (n,).
    """
    rests = np.diff(position_m, prepend=position_m[0]) == 0.0
    holds_um = (abs(law.coulomb_m) + law.stribeck_m) * UM_PER_M
    return holds_um / math.sqrt(3.0) * math.sqrt(float(np.mean(rests)))


def widened(
    promise: MotionPromise, rest: Unmodelled | None, at_rest_um: float = 0.0
) -> dict[str, float]:
    """A promise with its interval: what the model expects, and what it does not hold beside it.

    Parameters
    ----------
    promise : MotionPromise
        Of the model.
    rest : Unmodelled or None
        What captures showed beyond the model; None leaves the promise without an interval.
    at_rest_um : float
        What friction leaves open at rest (``open_at_rest_um``), for the upper end of e_r.

    Returns
    -------
    dict
        Fields of the promise with ``e_r_after`` and ``total_after`` in the middle between the
        model's word and that with the typical rest, their bounds as ``..._lower_um`` and
        ``..._upper_um``, and the model's own word as ``model_..._um``.
    """
    out = asdict(promise)
    for name in ("e_r_after", "total_after"):
        out[f"model_{name}_um"] = out[f"{name}_um"]
    if rest is None:
        return out
    parts = (
        ("e_r_after", "e_before", rest.mechanical_um),
        ("total_after", "total_before", rest.total_um),
    )
    for (name, before, (_, typical, most)), off in zip(parts, rest.off_frac, strict=True):
        own, whole = float(out[f"{name}_um"]), float(out[f"{before}_um"])
        out[f"{name}_um"] = math.sqrt(own * joined_um(own, typical, own, whole))
        out[f"{name}_lower_um"] = own * (1.0 - off)
        out[f"{name}_upper_um"] = own * (1.0 + off) + most
    out["e_r_after_upper_um"] = math.hypot(out["e_r_after_upper_um"], at_rest_um)
    return out


def joined_um(own_um: float, rest_um: float, after_um: float, before_um: float) -> float:
    """Rms in um of the model's error and a rest, which run together as far as the error stays.

    Parameters
    ----------
    own_um, rest_um : float
        The two, rms.
    after_um, before_um : float
        The model's error with and without compensation, rms.
    """
    together = min(1.0, after_um / before_um) if before_um > 0.0 else 1.0
    return math.sqrt(own_um**2 + rest_um**2 + 2.0 * together * own_um * rest_um)
