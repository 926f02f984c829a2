"""The dynamic law of a drive for a route: the model's, with what captures show of its turn.

What lives here: which delays belong to a door, and the order of the two steps. What may not: the
arithmetic of either (``physics.compensate``), files, controllers.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.progress import Progress
from pmac_comp.base.units import MM_PER_M, UM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.compensate.clearance import given_m
from pmac_comp.physics.compensate.constant import (
    BY_PLACE,
    LOAD,
    UNEVEN,
    with_constant_torque,
    with_load,
)
from pmac_comp.physics.compensate.creep import CREEP, Creep
from pmac_comp.physics.compensate.delay import drive_delay_s
from pmac_comp.physics.compensate.design import (
    NutGap,
    SmoothFriction,
    Stribeck,
    SwungBed,
    design_law,
)
from pmac_comp.physics.compensate.grip import (
    GRIP,
    gripping_law,
    gripping_model,
    gripping_torque,
    slides,
)
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.compensate.lead import LeadMap, LeadWave
from pmac_comp.physics.compensate.loop import (
    LoopRunner,
    constant_load_N,
    load_torque_Nm,
    model_loop,
)
from pmac_comp.physics.compensate.ripple import RIPPLE, turn_torque, with_turn_torque
from pmac_comp.physics.compensate.trim import DRAG
from pmac_comp.physics.compensate.unmodelled import (
    noting_unmodelled,
    turn_torque_Nm,
    unmodelled,
)
from pmac_comp.physics.model import slots
from pmac_comp.physics.model.effect import split_name
from pmac_comp.workflow.law.routes import LATENCY_CYCLES, TORQUE_ROUTES

if TYPE_CHECKING:
    from pmac_comp.physics.model.drive import DriveModel

_EXTENSION_STEPS = 32.0  # 1/T extension resolves 1/32 count
_SHARP_m = 0.5e-6  # in which a law's friction follows a model whose friction does so at once
_FED_FORWARD = frozenset({"cogging", "friction_per_rev", "friction_asymmetry", RIPPLE})
GAVE_WAY = "turn_gave_way"  # in a law's provenance
NO_TIME_FOR_DRAG = "no_time_for_drag_m"  # the same: a drag that PLC 0 has no time for


def dynamic_law(
    bench: Bench,
    model: "DriveModel",
    route: str,
    captures: Sequence[Capture] = (),
    *,
    every_cycles: int = 1,
    faster: CompensationLaw | None = None,
    provenance: dict[str, Any] | None = None,
    progress: Progress | None = None,
) -> CompensationLaw:
    """Law of a model for a route.

    Parameters
    ----------
    bench, model
        What is known, and the identified drive.
    route : str
        One of ``ROUTES``; only ``law`` and ``servo`` carry torque.
    captures : sequence of Capture
        Runs without compensation, slow ones included: cogging, friction per turn, a constant load
        and the distance over which friction grips are read from them, which the model need not
        hold.
    every_cycles : int
        Servo cycles between two passes of the law.
    faster : CompensationLaw, optional
        Law of the same model and route with fewer cycles between two passes.
    provenance : dict, optional
        Kept with the law.
    progress : callable, optional
        Called with a step and a fraction.
    """
    loop = model_loop(without_fed_forward(model))

    def designed(model: "DriveModel", loop: LoopRunner, noted: dict[str, Any]) -> CompensationLaw:
        return design_law(
            bench,
            loop,
            delay_s=drive_delay_s(model),
            latency_cycles=LATENCY_CYCLES[route],
            with_torque=route in TORQUE_ROUTES,
            every_cycles=every_cycles,
            gap=nut_gap(model),
            bed=swung_bed(model),
            stribeck=stribeck_friction(model),
            load_Nm=load_torque_Nm(model),
            faster=faster,
            provenance={**(provenance or {}), **noted},
            progress=progress,
        )

    law = designed(model, loop, {})
    if not captures:
        return _with_own_cable(law, model)
    if progress is not None:
        progress("reading friction and cogging from the captures", 0.3)
    if route not in TORQUE_ROUTES:
        return _noting_grip(law, model, loop, captures)
    gripping, grip = gripping_law(law, loop, captures)
    if grip > 0.0 and not slides(model, gripping.torque_breakaway_m):
        # What grips late also lets go of the table late: the whole law is fitted anew with it.
        noted = {GRIP: gripping.torque_breakaway_m}
        model = gripping_model(model, replace(law, provenance=noted))
        loop = model_loop(without_fed_forward(model))
        law = designed(model, loop, noted)
    else:
        law = gripping
    found = turn_torque(law, loop, captures, drive_delay_s=drive_delay_s(model))
    law = with_turn_torque(law, found)
    law = with_constant_torque(law, loop, captures)
    if not {LOAD, BY_PLACE} & law.provenance.keys():
        law = _with_own_cable(law, model)
    return law.noting({"turn_explained": found.explained, "grip_explained": grip})


def _with_own_cable(law: CompensationLaw, model: "DriveModel") -> CompensationLaw:
    """Law with the torque of the cable that a model holds, where no captures tell it."""
    if "cable_drag" not in model.effects or law.torque_limit_Nm == 0.0:
        return law
    own = model.values_of("cable_drag")
    slope = own["stiffness_N_per_m"] * model.bench.lead_m_per_rad
    return with_load(
        law, constant_Nm=slope * (law.origin_m - own["centre_m"]), slope_Nm_per_m=slope
    )


def _noting_grip(
    law: CompensationLaw, model: "DriveModel", loop: LoopRunner, captures: Sequence[Capture]
) -> CompensationLaw:
    """A law without torque with the distance over which friction grips, for what is promised."""
    friction = law.with_values(torque_coulomb_Nm=_friction_Nm(model), torque_breakaway_m=_SHARP_m)
    found, grip = gripping_law(friction, loop, captures)
    if grip == 0.0 or slides(model, found.torque_breakaway_m):
        return law
    return law.noting({GRIP: found.torque_breakaway_m})


def _friction_Nm(model: "DriveModel") -> float:
    """Coulomb friction of a model at the motor, N m."""
    own = model.parameters
    turning = own.get("coulomb.motor_Nm", 0.0) + own.get("coulomb.nut_Nm", 0.0)
    return turning + own.get("coulomb.guide_N", 0.0) * model.bench.lead_m_per_rad


def turn_errors(
    bench: Bench,
    model: "DriveModel",
    law: CompensationLaw,
    captures: Sequence[Capture],
    slow: Sequence[Capture],
) -> list[FloatArray]:
    """What the torque per turn makes of table minus motor in slow runs, m, one array per run.

    Cogging shakes the table at any speed, and more where it passes the first mode: a table that
    took it for a lead error of the screw would shake the axis anew at all other speeds.
    """
    loop, delay_s = model_loop(without_fed_forward(model)), drive_delay_s(model)
    if law.torque_limit_Nm == 0.0 and captures:  # a route without torque has not looked for it
        found = turn_torque(law, loop, (*captures, *slow), drive_delay_s=delay_s)
        law = with_turn_torque(law, found)
    if law == law.without_turn():
        return [np.zeros(run.n) for run in slow]
    turn = law.with_values(lookahead_s=delay_s, torque_limit_Nm=bench.drive.torque_limit_Nm)
    turn = replace(turn, every_cycles=1)
    return [_turn_error(turn, loop, run, gripping_torque(law, run)) for run in slow]


def _turn_error(
    turn: CompensationLaw, loop: LoopRunner, run: Capture, grip_Nm: FloatArray
) -> FloatArray:
    r = run.commanded_position_m
    shaken = loop(r, None, grip_Nm - turn_torque_Nm(turn, r, run.sample_period_s))
    plain = loop(r, None, grip_Nm)
    return np.asarray(
        shaken.table_position_m
        - shaken.motor_position_m
        - (plain.table_position_m - plain.motor_position_m)
    )


def nut_gap(model: "DriveModel") -> NutGap | None:
    """Clearance of a model's nut; None without one.

    A soft zone of the nut counts as the clearance that it has beyond the stiff spring, all of it
    taken up at the zone's edge.
    """
    half_m, edge_N, rest = 0.0, 0.0, without_fed_forward(model)
    chain = model.kernel_vector()
    for name in model.effects:
        bare, place = split_name(name)
        if bare == "backlash":
            half_m += 0.5 * model.parameters["backlash.gap_m"]
        elif bare == "preload_loss" and place != "beyond":
            ratio = model.parameters["preload_loss.stiffness_ratio"]
            zone_m = model.parameters["preload_loss.half_width_m"]
            half_m += given_m(zone_m, ratio)
            edge_N = ratio * zone_m * chain[slots.K_NUT]
        else:
            continue
        rest = rest.without_effect(name)
    if half_m <= 0.0:
        return None
    mass_kg = chain[slots.M_TABLE]
    load_m_per_s2 = constant_load_N(model) / mass_kg
    return NutGap(half_m, edge_N / mass_kg, load_m_per_s2, model_loop(rest))


def swung_bed(model: "DriveModel") -> SwungBed | None:
    """Bed of a model that swings; None without one.

    Source
    ------
    Newton for bed and table together: (M_bed + M) y" = -M x" - M_bed (2 zeta omega y' + omega^2 y).
    """
    if "base_mode" not in model.effects:
        return None
    own = model.values_of("base_mode")
    share = own["mass_ratio"] / (1.0 + own["mass_ratio"])
    if share <= 0.0:
        return None
    omega = 2.0 * math.pi * own["frequency_Hz"]
    return SwungBed(
        share=share,
        damping_per_s=(1.0 - share) * 2.0 * own["damping_ratio"] * omega,
        stiffness_per_s2=(1.0 - share) * omega**2,
        torque_Nm_s2_per_m=model.kernel_vector()[slots.M_TABLE] * model.bench.lead_m_per_rad,
    )


def _turns_over_m_per_s(model: "DriveModel") -> float:
    """Speed over which smooth friction of a model turns over, by its torque at guide and screw."""
    own = model.values_of("smooth_coulomb")
    guide_Nm = model.parameters["coulomb.guide_N"] * model.bench.lead_m_per_rad
    share = guide_Nm / max(_friction_Nm(model), 1e-30)
    rotary_m_per_s = own.get("rotary_m_per_s", own["speed_m_per_s"])
    return share * own["speed_m_per_s"] + (1.0 - share) * rotary_m_per_s


def stribeck_friction(model: "DriveModel") -> Stribeck | SmoothFriction | None:
    """Friction of a model that is another near standstill; None without it."""
    if "smooth_coulomb" in model.effects:
        return SmoothFriction(_turns_over_m_per_s(model))
    if "stribeck.speed_m_per_s" not in model.parameters:
        return None
    own = model.values_of("stribeck")
    guide_N, excess_N = model.parameters["coulomb.guide_N"], own.get("excess_N", 0.0)
    torque_Nm = own.get("excess_Nm", 0.0) + excess_N * model.bench.lead_m_per_rad
    if torque_Nm <= 0.0:
        return None
    return Stribeck(
        guide_frac=excess_N / guide_N if guide_N > 0.0 else 0.0,
        torque_Nm=torque_Nm,
        speed_m_per_s=own["speed_m_per_s"],
    )


def without_fed_forward(model: "DriveModel", *, but: str = "") -> "DriveModel":
    """The model without the torque, per turn or more one way, that captures show, ``but`` one.

    It is fed forward from them.

    A model that holds the effect explains it, and nothing would be left in the captures to read.
    """
    for name in model.effects:
        if split_name(name)[0] in _FED_FORWARD - {but}:
            model = model.without_effect(name)
    return model


def with_unmodelled(
    bench: Bench,
    law: CompensationLaw,
    model: "DriveModel",
    captures: Sequence[Capture],
    lead: LeadMap | None,
) -> CompensationLaw:
    """The law with what the captures show beyond the model, which widens its promise."""
    fine = _EXTENSION_STEPS if bench.encoder.extension == "1/T" else 1.0
    rest = unmodelled(
        law,
        model_loop(without_fed_forward(model), wobble_of(bench, lead)),
        captures,
        lead,
        motor_step_m=bench.motor_resolution_m / fine,
        table_step_m=bench.scale_resolution_m or 0.0,
    )
    return law if rest is None else noting_unmodelled(law, rest)


def wobble_of(bench: Bench, lead: LeadMap | None) -> LeadWave | None:
    """Wobble of the lead that shakes a table; None without a map or one."""
    return None if lead is None else lead.wave(bench.pitch_m)


def wobble_remarks(law: CompensationLaw) -> list[str]:
    """That a wave of the torque gave its place to one against the wobble of the lead."""
    if GAVE_WAY not in law.provenance:
        return []
    return [
        f"the wobble of the lead, {law.turn_order:.0f} times a turn, shakes fast moves more than "
        "the torque by the turn does that the runs show: the law has room for one of the two, and "
        "sends what the loop lacks to follow the table"
    ]


def drag_remarks(law: CompensationLaw) -> list[str]:
    """What drags at the table by the captures, and whether the law holds it, for people."""
    left_m = law.provenance.get(NO_TIME_FOR_DRAG, 0.0)
    size_m = law.drag_m or left_m
    if size_m == 0.0:
        return []
    shown = (
        f"the runs show a drag at the table of {size_m * UM_PER_M:.2f} um each side that turns "
        "over within millimetres, as of a cable chain, a cover or a wiper: "
    )
    if left_m == 0.0:
        share = 100.0 * law.provenance[DRAG]
        return [
            f"{shown}the law holds it (within {law.drag_distance_m * MM_PER_M:.0f} mm; {share:.0f} "
            "% less is left of the mechanical error that the model does not explain)"
        ]
    return [
        f"{shown}PLC 0 has no time for it in this rhythm; `--every {law.every_cycles + 1}` or "
        "`--route servo` takes it along"
    ]


def law_remarks(
    model: "DriveModel", route: str, *, has_captures: bool, has_slow: bool = False
) -> list[str]:
    """What the law of a route cannot do for this drive, or was not given, for people."""
    if route not in TORQUE_ROUTES:
        return []
    remarks: list[str] = []
    if not has_captures:
        turn = (
            "cogging and friction per turn are those of the slow runs, how friction grips is"
            if has_slow
            else "cogging, friction per turn and how friction grips are"
        )
        remarks.append(
            f"no calibration runs were given (--captures): {turn} not in the law, nothing trims "
            "it, and the promise is the model's alone"
        )
    if any(split_name(name)[0] == "backlash" for name in model.effects):
        gap_um = model.parameters["backlash.gap_m"] * UM_PER_M
        remarks.append(
            f"the model holds backlash: the law takes {gap_um:.1f} um up as the force in the nut "
            "turns; while the table crosses the gap freely the law is wrong by a part of it"
        )
    return remarks


def constant_remarks(bench: Bench, law: CompensationLaw) -> list[str]:
    """What load the captures showed that the model does not hold, for people."""
    noted = law.provenance.get(LOAD)
    by_place = _by_place_remarks(bench, law) + _uneven_remarks(law)
    if noted is None:
        return by_place
    torque_Nm = noted["torque_Nm"]
    force_N = torque_Nm / bench.lead_m_per_rad
    return [
        f"in both directions the runs need {torque_Nm:+.3f} +- {noted['two_std_Nm']:.1g} N m "
        f"beside the model's dynamics ({force_N:+.0f} N at the table): a load, not friction. The "
        "law sends it; "
        "should the load change, capture and compute again",
        *by_place,
    ]


def creep_remarks(law: CompensationLaw) -> list[str]:
    """That the drive does not stay where it rests, for people."""
    noted = law.provenance.get(CREEP)
    if noted is None:
        return []
    found = Creep(**noted)
    speed, two_std = (MM_PER_M * v for v in (found.speed_m_per_s, found.two_std_m_per_s))
    return [
        f"at rest the runs creep, by {speed:.2g} +- {two_std:.1g} mm/s where friction's torque "
        "pushes: friction does not hold this drive, as the model's does (`pmac-comp identify` fits "
        "such friction where it predicts the runs). The law lets go of its friction torque as a "
        "rest begins"
    ]


def _uneven_remarks(law: CompensationLaw) -> list[str]:
    """That friction rises faster with the speed one way than the other."""
    noted = law.provenance.get(UNEVEN)
    if noted is None:
        return []
    per_speed, fastest = noted["torque_Nm_s_per_m"], noted["speed_m_per_s"]
    more, less = ("positive", "negative") if per_speed > 0.0 else ("negative", "positive")
    return [
        f"friction rises faster with the speed in {more} direction: at {fastest * MM_PER_M:.0f} "
        f"mm/s the runs need {abs(per_speed) * fastest:.2g} +- "
        f"{noted['two_std_Nm_s_per_m'] * fastest:.1g} N m more there than the mean of both, and as "
        f"much less in {less} direction. The law sends it"
    ]


def _by_place_remarks(bench: Bench, law: CompensationLaw) -> list[str]:
    """That the runs need a torque that changes along the travel."""
    noted = law.provenance.get(BY_PLACE)
    if noted is None:
        return []
    slope, reach_m = noted["slope_Nm_per_m"], noted["reach_m"]
    return [
        f"in both directions the torque that the runs need beside the model's dynamics changes by "
        f"{slope * reach_m:+.2g} +- {noted['two_std_Nm_per_m'] * reach_m:.1g} N m along the "
        f"{reach_m * MM_PER_M:.0f} mm of the runs ({slope / bench.lead_m_per_rad:+.0f} N per m at "
        "the table), as of a spring or a cable. The law sends it, also where it leads on beyond "
        "the runs; should the spring change, capture and compute again"
    ]
