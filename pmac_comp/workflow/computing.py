"""From a model and slow runs to a compensation: compute, limit, describe, say what it costs.

What lives here: the order of the steps and the words for people. What may not: the design of the
law (``physics.compensate``), registers, conversations.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.errors import (
    ConfigError,
)
from pmac_comp.base.units import UM_PER_M, US_PER_S
from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.files.capture import read_capture
from pmac_comp.machine.controller import law_upload
from pmac_comp.physics.compensate.design import design_law, model_loop
from pmac_comp.physics.compensate.exact import Learning, exact_correction
from pmac_comp.physics.compensate.law import CompensationLaw, coefficient_names
from pmac_comp.physics.compensate.lead import lead_map
from pmac_comp.physics.compensate.trim import trimmed_law
from pmac_comp.workflow.compensation_file import (
    Compensation,
    check_route,
    write_compensation,
)
from pmac_comp.workflow.motions import Motion

Progress = Callable[[str, float], None]
LATENCY_CYCLES = {"law": 1, "servo": 0, "table": 0, "cam": 0, "program": 0}
TORQUE_ROUTES = ("law", "servo")
MOTION_ROUTES = ("cam", "program")  # for one known motion
_CHEAP_SHARE = 0.25


def compute_compensation(
    bench: Bench,
    model: Any,
    *,
    route: str,
    slow: tuple[Any, ...] = (),
    captures: tuple[Any, ...] = (),
    motion: Motion | None = None,
    provenance: dict[str, Any] | None = None,
    progress: Progress | None = None,
) -> Compensation:
    """Law and lead map of a model and slow runs for a route.

    ``cam`` is for one ``motion``. With ``captures`` (relaxed runs without
    compensation) the law's offset terms are corrected by what the model leaves of them.
    """
    check_route(route)
    law = design_law(
        bench,
        model_loop(model),
        latency_cycles=LATENCY_CYCLES[route],
        with_torque=route in TORQUE_ROUTES,
        provenance=provenance,
        progress=progress,
    )
    # The lead runs are read without torque and without lead time: only the static part counts.
    lead = lead_map(slow, law.with_values(lead_s=0.0, lead2_s2=0.0)) if slow else None
    if motion is not None and route == "cam":
        exact = _exact(bench, model, motion.position_m)
        return Compensation(
            route,
            law,
            lead,
            motion_time_s=motion.trajectory.time_s,
            motion_position_m=motion.position_m,
            motion_correction_m=exact.correction_m,
        )
    if captures:
        trimmed, explained = trimmed_law(law, model_loop(model), captures, lead)
        trim = {
            name: getattr(trimmed, name) - getattr(law, name)
            for name in coefficient_names()
            if getattr(trimmed, name) != getattr(law, name)
        }
        provenance = {**law.provenance, "trim": trim, "trim_explained": explained}
        law = replace(trimmed, provenance=provenance)
    return Compensation(route, law, lead)


def compensate_files(
    bench: str,
    model: Path,
    out: Path,
    *,
    route: str,
    slow: tuple[Path, ...] = (),
    command: Path | None = None,
    clip: bool = False,
    effects: Path | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Compute a compensation from files and describe it."""
    from pmac_comp.workflow.identification import load_model

    loaded = load_bench(bench)
    drive = load_model(model, loaded, effects=effects)
    if route in {"cam", "program"}:
        return _compensate_motion(loaded, drive, out, route, command)
    captures = tuple(read_capture(path) for path in slow)
    provenance = {
        "bench_digest": loaded.digest,
        "model": model.name,
        "effects": list(drive.effects),
    }
    compensation = compute_compensation(
        loaded, drive, route=route, slow=captures, provenance=provenance, progress=progress
    )
    cuts = _limits_report(loaded, compensation.law)
    if cuts and not clip:
        from pmac_comp.base.errors import AmplitudeExceeded

        raise AmplitudeExceeded(
            "The correction passes the limits: " + "; ".join(cuts) + ".",
            code="PC-DEP-010",
            hint="Check the model, raise [safety] max_correction_um, or use --limit to clip.",
        )
    write_compensation(out, compensation)
    return {
        "route": route,
        "file": out,
        "summary": describe(loaded, compensation),
        "remarks": [*cuts, *cost_remarks(loaded, route)],
        "law": compensation.law.as_mapping(),
    }


def _exact(bench: Bench, model: Any, position_m: FloatArray) -> Learning:
    limit = bench.safety.max_correction_um / UM_PER_M
    return exact_correction(model_loop(model), position_m, bench.servo_period_s, limit_m=limit)


def _compensate_motion(
    bench: Bench, drive: Any, out: Path, route: str, command: Path | None
) -> dict[str, Any]:
    from pmac_comp.workflow.commands import read_command

    if command is None:
        raise ConfigError(
            f"The route {route} needs the motion it is for.",
            code="PC-DEP-011",
            hint="Give it with --command FILE (CSV with time_s,commanded_position_mm).",
        )
    time_s, position = read_command(command)
    exact = _exact(bench, drive, position)
    law = design_law(bench, model_loop(drive), latency_cycles=0, with_torque=False)
    compensation = Compensation(
        route,
        law,
        None,
        motion_time_s=time_s,
        motion_position_m=position,
        motion_correction_m=exact.correction_m,
    )
    write_compensation(out, compensation)
    summary = {
        "route": route,
        "motion": f"{time_s[-1] - time_s[0]:.3f} s, {position.size} samples",
        "largest correction um": float(np.max(np.abs(exact.correction_m)) * UM_PER_M),
        "total error before um rms": exact.history_um[0],
        "total error after um rms (model)": exact.history_um[-1],
        "passes": len(exact.history_um) - 1,
    }
    limit_um = bench.safety.max_correction_um
    cut = float(np.mean(np.abs(exact.correction_m) * UM_PER_M > 0.999 * limit_um))
    remarks = [f"{100.0 * cut:.1f} % of the motion is cut at max_correction_um = {limit_um:g} um"]
    return {
        "route": route,
        "file": out,
        "summary": summary,
        "remarks": remarks if cut else [],
        "law": None,
    }


def describe(bench: Bench, compensation: Compensation) -> dict[str, Any]:
    """Figures of a compensation for people."""
    law = compensation.law
    out: dict[str, Any] = {
        "route": compensation.route,
        "per acceleration um/(m/s2)": law.inertia_s2 * UM_PER_M,
        "per speed um/(m/s)": law.viscous_s * UM_PER_M,
        "friction um (each side)": law.coulomb_m * UM_PER_M,
        "change along the travel %/m": 100.0
        * law.inertia_per_m_s2_per_m
        / max(abs(law.inertia_s2), 1e-12),
        "largest correction um": largest_correction_um(law),
        "clamp um": law.amplitude_limit_m * UM_PER_M,
        "valid to m/s": law.valid_speed_m_per_s,
        "valid to m/s2": law.valid_acceleration_m_per_s2,
    }
    explained = law.provenance.get("trim_explained", 0.0)
    if explained:
        out["corrected by the captures, share of the rest explained %"] = 100.0 * explained
    if compensation.route in TORQUE_ROUTES:
        out["friction torque Nm"] = law.torque_coulomb_Nm
        out["torque lead ms"] = law.torque_lead_s * 1e3
    rendered = compensation.table(bench)
    if compensation.lead is not None and rendered is not None:
        out |= {k.replace("_", " "): v for k, v in compensation.lead.summary().items()}
        out["table entries"] = len(rendered.table.entries)
        out["table rounding um"] = rendered.quantisation_um
    return out


def largest_correction_um(law: CompensationLaw) -> float:
    """Largest correction within the law's range of speeds and accelerations, um."""
    a, v = law.valid_acceleration_m_per_s2, law.valid_speed_m_per_s
    return UM_PER_M * (abs(law.inertia_s2) * a + abs(law.viscous_s) * v + abs(law.coulomb_m))


def _limits_report(bench: Bench, law: CompensationLaw) -> list[str]:
    limit = bench.safety.max_correction_um
    largest = largest_correction_um(law)
    if largest <= limit:
        return []
    return [
        f"at {law.valid_acceleration_m_per_s2:.3g} m/s2 the correction would be {largest:.1f} um, "
        f"the limit is {limit:g} um; it is clipped there"
    ]


def cost_remarks(bench: Bench, route: str) -> list[str]:
    """What the route costs on the card's processor, and the way out where that is much."""
    if route != "law":
        return []
    cost = law_upload.law_cost_us(bench.controller.cpu_clock_MHz)
    period = bench.servo_period_s * US_PER_S
    share = cost / period
    text = (
        f"PLC 0 takes about {cost:.0f} us of each {period:.0f} us servo period "
        f"({100 * share:.0f} %) at {bench.controller.cpu_clock_MHz:g} MHz"
    )
    if share <= _CHEAP_SHARE:
        return [text]
    return [
        text + ": more than a quarter. Run it every second cycle (I8 = 1; the law allows for "
        "it), or use --route servo, whose compiled form costs about a tenth"
    ]
