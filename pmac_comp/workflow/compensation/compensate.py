"""Compensation files from model files and captures: refused early, computed, looked at, written.

What lives here: ``compensate`` on files. What may not: the computing (``computing``), what of it is
foreseen within seconds (``foreseen``), the words for its figures (``text``).
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from pmac_comp.base.errors import ConfigError
from pmac_comp.base.progress import Progress
from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.files.capture import predicted_remarks
from pmac_comp.physics.compensate.exact import Aim
from pmac_comp.physics.compensate.unmodelled import model_law
from pmac_comp.workflow.bench.remarks import lag_remarks, loop_remarks
from pmac_comp.workflow.bench.same_axis import captures_of
from pmac_comp.workflow.compensation.computing import compute_compensation
from pmac_comp.workflow.compensation.file import Compensation, check_route, write_compensation
from pmac_comp.workflow.compensation.foreseen import (
    check_amplitude,
    check_options,
    check_uncompensated,
    too_large,
)
from pmac_comp.workflow.compensation.promises import Promiser, worse_known_remarks, worse_remarks
from pmac_comp.workflow.compensation.tables import refused_remarks
from pmac_comp.workflow.compensation.text import describe, limits_report, table_remarks
from pmac_comp.workflow.law.beyond_model import made_with, shown_remarks
from pmac_comp.workflow.law.dynamic_law import (
    constant_remarks,
    creep_remarks,
    drag_remarks,
    law_remarks,
    without_fed_forward,
    wobble_remarks,
)
from pmac_comp.workflow.law.law_cost import (
    CHEAP_FRAC,
    CheaperLaw,
    cheaper_laws,
    cost_remarks,
    share_frac,
)
from pmac_comp.workflow.law.loose_nut import flank_remarks
from pmac_comp.workflow.law.routes import MOTION_ROUTES, TORQUE_ROUTES
from pmac_comp.workflow.law.static_map import Limit
from pmac_comp.workflow.motion.campaigns import verification_motions
from pmac_comp.workflow.motion.motions import parse_motion

if TYPE_CHECKING:
    from pmac_comp.physics.model.drive import DriveModel

_LIKE_VERIFIED = 0  # seed of motions on which a compensation is looked at before it is uploaded


def compensate_files(
    bench: str,
    model: Path,
    out: Path,
    *,
    route: str,
    slow: tuple[Path, ...] = (),
    captures: tuple[Path, ...] = (),
    command: str = "",
    aim: Aim = Aim.TOTAL,
    limit: Limit = Limit.REFUSE,
    every_cycles: int = 1,
    effects: Path | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Compute a compensation from files and describe it."""
    from pmac_comp.workflow.model.identification import load_model

    check_route(route)
    loaded = load_bench(bench)
    motion = parse_motion(command, loaded) if command else None
    check_options(loaded, route, motion, every_cycles)
    drive = load_model(model, loaded, effects=effects)
    slow_runs, runs = captures_of(slow, loaded), captures_of(captures, loaded)
    check_uncompensated(loaded, [*slow_runs, *runs], [path.name for path in (*slow, *captures)])
    if limit is Limit.REFUSE:
        check_amplitude(loaded, drive, route, motion, aim)
    compensation = compute_compensation(
        loaded,
        drive,
        route=route,
        slow=tuple(slow_runs),
        captures=tuple(runs),
        motion=motion,
        aim=aim,
        provenance={
            "bench_digest": loaded.digest,
            "model": model.name,
            "effects": list(drive.effects),
        },
        limit=limit,
        every_cycles=every_cycles,
        progress=progress,
    )
    cuts = limits_report(loaded, compensation)
    if cuts and limit is Limit.REFUSE:
        raise too_large(route, aim, "; ".join(cuts))
    # What cannot be rendered or drawn is refused before it is written.
    refused = refused_remarks(compensation, loaded)
    summary = describe(loaded, compensation) | _promised_of_motion(loaded, compensation, drive)
    write_compensation(out, compensation)
    offers: tuple[CheaperLaw, ...] = ()
    law = compensation.law
    if route == "law" and share_frac(loaded, law) > CHEAP_FRAC:
        whole = without_fed_forward(made_with(drive, law))
        own = model_law(law).with_values(torque_wobble_Nm_s3_per_m3=0.0)  # no table here
        offers = cheaper_laws(loaded, whole, own, progress, whole=law)
    return {
        "route": route,
        "file": out,
        "summary": summary,
        "remarks": [
            *predicted_remarks([*slow_runs, *runs]),
            *cuts,
            *refused,
            *table_remarks(loaded, compensation),
            *law_remarks(drive, route, has_captures=bool(captures), has_slow=bool(slow)),
            *constant_remarks(loaded, law),
            *wobble_remarks(law),
            *drag_remarks(law),
            *creep_remarks(law),
            *shown_remarks(law),
            *(flank_remarks(law) if route != "table" else ()),
            *lag_remarks(loaded),
            *loop_remarks(loaded, drive),
            *_expected_worse(loaded, compensation, drive),
            *cost_remarks(loaded, route, law, offers),
        ],
        "law": law.as_mapping() if route in TORQUE_ROUTES else None,
    }


def aim_of(text: str) -> Aim:
    """Aim by its name.

    Raises
    ------
    ConfigError
        No such aim.
    """
    try:
        return Aim(text)
    except ValueError as error:
        raise ConfigError(
            f"'{text}' is not an aim.",
            code="PC-DEP-012",
            hint="Use " + " or ".join(aim.value for aim in Aim) + ".",
        ) from error


def _expected_worse(bench: Bench, compensation: Compensation, drive: "DriveModel") -> list[str]:
    """Remarks on motions like those that ``verify`` draws, which the model expects to get worse."""
    promiser = Promiser.of(bench, compensation, drive)
    if promiser is None or bench.scale is None:
        return []
    if compensation.route in MOTION_ROUTES:
        return worse_known_remarks(promiser, compensation.aim)
    return worse_remarks(promiser, verification_motions(bench, _LIKE_VERIFIED))


def _promised_of_motion(
    bench: Bench, compensation: Compensation, drive: "DriveModel"
) -> dict[str, Any]:
    """What is promised for the one motion of a compensation, as `verify` will run it."""
    promiser = None if bench.scale is None else Promiser.of(bench, compensation, drive)
    said = None if promiser is None else promiser.of_known()
    if said is None:
        return {}
    aim = compensation.aim
    before, name = ("total_before", "total_after")
    if aim is Aim.MECHANICAL:
        before, name = ("e_before", "e_r_after")
    out = {
        f"{aim.value} error before um rms, promised": said[f"{before}_um"],
        f"{aim.value} error after um rms, promised": said[f"{name}_um"],
    }
    if f"{name}_upper_um" in said:
        out[f"{aim.value} error after um rms, at most"] = said[f"{name}_upper_um"]
    return out
