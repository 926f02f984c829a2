"""Diagnose, grow the model, recompute, upload, verify, and see whether the error falls again."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pmac_comp.base.atomic import atomic_write_text
from pmac_comp.base.documents import document
from pmac_comp.base.errors import ConfigError, ModelError, PmacCompError
from pmac_comp.base.progress import Progress
from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.files.capture import Capture, holds_runs
from pmac_comp.files.model_file import ModelFile, read_model, write_model
from pmac_comp.machine.controller.card.processor_load import read_load
from pmac_comp.workflow.accuracy.outcome import WORSE, MotionOutcome, quadratic_mean
from pmac_comp.workflow.capture.at_work import measuring
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.capturing import motor_as_found, prepare, require_new, run_to_files
from pmac_comp.workflow.capture.context import context_of
from pmac_comp.workflow.capture.session import open_axis
from pmac_comp.workflow.compensation.computing import compute_compensation
from pmac_comp.workflow.compensation.file import Compensation, check_route, write_compensation
from pmac_comp.workflow.controller.deploy import deploy, switch
from pmac_comp.workflow.controller.upload_flow import removal_command
from pmac_comp.workflow.law.dynamic_law import nut_gap
from pmac_comp.workflow.law.routes import MOTION_ROUTES
from pmac_comp.workflow.model.diagnosis import DiagnosisOutcome, diagnose_captures
from pmac_comp.workflow.model.identification import base_friction, identify_captures, load_model
from pmac_comp.workflow.motion.campaigns import (
    calibration_motions,
    lead_motions,
    require_scale,
    verification_motions,
)
from pmac_comp.workflow.verification.kept_runs import KeptRuns
from pmac_comp.workflow.verification.result import Verification
from pmac_comp.workflow.verification.verify import verify_axis

if TYPE_CHECKING:
    from pmac_comp.physics.model.drive import DriveModel

JOURNAL = "journal"
_MOST_STAGES = 8
_RESULT = "improvement.json"
# Of both errors together: single runs of the same motions with the same compensation differed by
# 0.4, 1.1 and 2.5 % on three simulated axes.
_SAME = WORSE - 1.0


Row = tuple[str, float, float, float | None]


@dataclass(frozen=True)
class Improvement:
    """What was measured with the model as it was and with the grown one.

    Parameters
    ----------
    diagnosis : DiagnosisOutcome
        Judged on the first verification's runs without compensation.
    before_growth : Verification
        With the first model.
    after_growth : Verification or None
        With the grown model; None where the diagnosis added nothing.
    kept : str
        ``first`` or ``grown``: whose compensation is on the controller at the end.
    """

    diagnosis: DiagnosisOutcome
    before_growth: Verification
    after_growth: Verification | None
    kept: str

    def rows(self) -> list[Row]:
        """Motion, mechanical error without, with the first, with the grown model; um rms."""
        return self._rows(lambda m: m.e_before.value, lambda m: m.e_r_after.value)

    def total_rows(self) -> list[Row]:
        """The same of the total error."""
        return self._rows(lambda m: m.total_before.value, lambda m: m.total_after.value)

    def _rows(
        self, without: Callable[[MotionOutcome], float], left: Callable[[MotionOutcome], float]
    ) -> list[Row]:
        first, grown = self.before_growth.motions, self.after_growth
        last = [None] * len(first) if grown is None else [left(m) for m in grown.motions]
        return [
            (m.name, without(m), left(m), of_grown) for m, of_grown in zip(first, last, strict=True)
        ]

    def lines(self) -> list[str]:
        """Text for people."""
        simulated = any("simulated" in source for source in self.diagnosis.sources)
        basis = "simulated controller and drive" if simulated else "measured"
        out = [*self.diagnosis.lines(), "", f"mechanical error, um rms ({basis})"]
        out += [_row_text(*row) for row in self.rows()]
        out += [f"total error, table to command, um rms ({basis})"]
        out += [_row_text(*row) for row in self.total_rows()]
        return [*out, *self.judged()]

    def means(self) -> list[tuple[str, float, float]]:
        """Error, quadratic mean over motions with the first and the grown model, um."""
        if self.after_growth is None:
            return []
        return [
            (what, of(self.before_growth), of(self.after_growth))
            for what, of in (("mechanical", _mechanical_um), ("total", _total_um))
        ]

    def judged(self) -> list[str]:
        """Whether the error fell, and what is on the controller now."""
        if self.after_growth is None:
            return ["the diagnosis added nothing: the first compensation stays on the controller"]
        out = [
            f"  {what} error, quadratic mean: {first:.3f} -> {grown:.3f} um"
            for what, first, grown in self.means()
        ]
        first, grown = (_promises_kept(v) for v in (self.before_growth, self.after_growth))
        out.append(
            f"  motions on which the model's promise was kept: {first} -> {grown} of "
            f"{len(self.after_growth.motions)}"
        )
        stays = "the compensation of the grown model is on the controller"
        reason = "both errors together, in um, are larger"
        if abs(_change(self.before_growth, self.after_growth)) <= _SAME:
            same = "both errors together are the same within what two verifications differ by"
            stays = (
                f"{same} ({100 * _SAME:.0f} %), and the grown model explains more: its "
                "compensation is on the controller"
            )
            reason = f"{same}, and its promise was kept on fewer motions"
        if self.kept == "grown":
            return [*out, stays]
        return [
            *out,
            f"the grown model was not better ({reason}): the first compensation was put back",
        ]

    def as_result(self) -> dict[str, Any]:
        """Mapping for ``--json``."""
        grown = self.after_growth
        return {
            "kind": "improvement",
            "diagnosis": self.diagnosis.as_result(),
            "first_model": self.before_growth.as_result(),
            "grown_model": None if grown is None else grown.as_result(),
            "kept": self.kept,
        }


def _row_text(name: str, none: float, first: float, grown: float | None) -> str:
    last = "" if grown is None else f"   grown {grown:6.3f}"
    return f"  {name[:44]:44s} none {none:7.2f}   first {first:6.3f}{last}"


def is_better(before: Verification, after: Verification) -> bool:
    """Whether one error fell by more um than the other one rose, or nothing changed.

    In um, as both are errors of one table: a share of a small error is no excuse for the same
    share of a large one. Where nothing changed the model explains more, unless its promise is
    kept on fewer motions.
    """
    change = _change(before, after)
    if abs(change) > _SAME:
        return change < 0.0
    return _promises_kept(after) >= _promises_kept(before)


def _change(before: Verification, after: Verification) -> float:
    """Share by which both errors together, in um, rose."""
    first, grown = (_mechanical_um(v) + _total_um(v) for v in (before, after))
    return grown / max(first, 1e-9) - 1.0


def _promises_kept(verification: Verification) -> int:
    """Motions on which what the model promised was kept."""
    return sum(m.promise_kept(verification.floor_um) is True for m in verification.motions)


def _mechanical_um(verification: Verification) -> float:
    return quadratic_mean([m.e_r_after.value for m in verification.motions])


def _total_um(verification: Verification) -> float:
    return quadratic_mean([m.total_after.value for m in verification.motions])


def require_many_motions(route: str) -> None:
    """Refuse a route that is for one known motion: an improvement is measured on many."""
    check_route(route)
    if route in MOTION_ROUTES:
        raise ConfigError(
            f"The route {route} is for one known motion; an improvement is measured on many.",
            code="PC-IMP-002",
            hint="Use --route law, servo or table, then compute the other route from "
            "grown_model.json.",
        )


def improve_on_controller(
    url: str,
    bench: str,
    out: Path,
    *,
    model: Path | None = None,
    route: str = "law",
    seed: int = 0,
    effects: Path | None = None,
    progress: Progress | None = None,
) -> Improvement:
    """The whole loop on a controller; everything is left in a folder.

    Afterwards the motor holds or is killed as it was found.

    Raises
    ------
    ConfigError
        The route is for one known motion, the bench has no scale, or the folder holds runs or an
        earlier improvement.
    """
    require_many_motions(route)
    loaded = load_bench(bench)
    require_scale(loaded, "an improvement")
    require_new([*_runs_in(out), out / _RESULT], out)
    with open_axis(url, bench) as axis:
        axis.setup.store = out / JOURNAL  # before the lease is taken: it goes by the folder
        with measuring(axis, url), _told_what_is_left(out), motor_as_found(axis):
            prepare(axis)
            result = improve_axis(
                axis, out, model=model, route=route, seed=seed, effects=effects, progress=progress
            )
    # What is left on the controller would act in the runs that the diagnosis asks for.
    asked = replace(
        result.diagnosis,
        url=url,
        bench_name=bench,
        removal=removal_command(url, bench, out / JOURNAL),
    )
    result = replace(result, diagnosis=asked)
    atomic_write_text(out / _RESULT, document(result.as_result()))
    return result


def improve_axis(
    axis: Axis,
    out: Path,
    *,
    model: Path | None = None,
    route: str = "law",
    seed: int = 0,
    effects: Path | None = None,
    progress: Progress | None = None,
) -> Improvement:
    """The loop on a connected axis: first model, verify, diagnose, grown model, verify.

    The diagnosis is fitted to the calibration runs and judged on the runs that the verification
    made without compensation. Where the grown model turns out no better, the first compensation
    is put back.
    """
    told = _Stages(progress)
    motions = calibration_motions(axis.bench)
    told.begin("runs")
    runs = run_to_files(
        axis, [*motions, *lead_motions(axis.bench)], _run_paths(out, axis.bench), told
    )
    captures, slow = runs[: len(motions)], tuple(runs[len(motions) :])
    told.begin("first model")
    first, file = _first_model(captures, axis.bench, model, effects, told)
    write_model(out / "first_model.json", file)
    steps = _Steps(axis, out, route, captures, slow, seed, told)
    compensation, before = steps.measured(first, "first")
    told.begin("diagnosis")
    diagnosis = diagnose_captures(
        captures,
        axis.bench,
        validate=before.before,
        model=first,
        effects=effects,
        progress=told,
    )
    write_model(out / "grown_model.json", diagnosis.model)
    if not diagnosis.diagnosis.named:
        return Improvement(diagnosis, before, None, "first")
    told.begin("grown model")
    model_grown, file = reestimated(captures, axis.bench, diagnosis, told)
    write_model(out / "grown_model.json", file)
    steps.off(compensation)
    grown, after = steps.measured(model_grown, "grown")
    if is_better(before, after):
        return Improvement(diagnosis, before, after, "grown")
    steps.off(grown)
    deploy(axis, compensation, steps.context)
    return Improvement(diagnosis, before, after, "first")


def _run_paths(out: Path, bench: Bench) -> list[Path]:
    """Files of the runs that the models are fitted to."""
    n = len(calibration_motions(bench)) + len(lead_motions(bench))
    return [out / f"calibration_{i + 1:02d}.h5" for i in range(n)]


def _runs_in(folder: Path) -> list[Path]:
    """Runs of any command in a folder: those of an improvement are never mixed with others."""
    found = (folder.glob(pattern) for pattern in ("*", "verification_*/*"))
    return sorted(path for paths in found for path in paths if holds_runs(path))


@contextmanager
def _told_what_is_left(out: Path) -> Iterator[None]:
    """Errors that say what was kept, and how to see and take back what was uploaded."""
    try:
        yield
    except (PmacCompError, KeyboardInterrupt) as error:
        error.add_note(f"What was measured so far is in {out}.")
        if (out / JOURNAL).exists():
            error.add_note(
                f"`pmac-comp status` shows which compensation stands; `pmac-comp recover` settles "
                f"an interrupted upload and `pmac-comp rollback` takes the last one back, both "
                f"with --journal {out / JOURNAL}."
            )
        raise


def _first_model(
    captures: Sequence[Capture],
    bench: Bench,
    path: Path | None,
    effects: Path | None,
    progress: Progress | None,
) -> tuple["DriveModel", ModelFile]:
    """The model to start from, as given or identified, with its file."""
    if path is not None:
        return load_model(path, bench, effects=effects), read_model(path)
    friction = base_friction(captures, bench)
    found = identify_captures(captures, bench, friction=friction, progress=progress)
    return found.identification.model, found.model_file


def reestimated(
    captures: Sequence[Capture],
    bench: Bench,
    diagnosis: DiagnosisOutcome,
    progress: Progress | None,
) -> tuple["DriveModel", ModelFile]:
    """The grown model with its parameters estimated as the first model's were, torque included.

    The diagnosis weighs positions to tell effects apart; between two laws nothing but the effect
    may differ. Where the effect leaves this estimate nothing to stand on, the diagnosis' values
    stay. So they do with a gap in the nut: torque does not show it, and an estimate that weighs
    torque trades it against friction (4.9 became 3.5 um of 5).
    """
    grown = diagnosis.diagnosis.model
    as_found = grown, diagnosis.model
    if nut_gap(grown) is not None:
        return as_found
    try:
        found = identify_captures(captures, bench, model=grown, progress=progress)
    except ModelError:
        return as_found
    model = found.identification.model
    return as_found if model is None else (model, found.model_file)


class _Stages:
    """Progress with what of the whole it belongs to before each step."""

    def __init__(self, progress: Progress | None) -> None:
        self._progress = progress
        self._number, self._name = 0, ""

    def begin(self, name: str) -> None:
        """The next stage; there are fewer in all where the diagnosis names nothing."""
        self._number, self._name = self._number + 1, name

    def __call__(self, step: str, fraction: float) -> None:
        """Pass progress on."""
        if self._progress is not None:
            self._progress(f"{self._number}/{_MOST_STAGES} {self._name}: {step}", fraction)


class _Steps:
    """Compute, upload and verify for one model after another, on the same motions."""

    def __init__(
        self,
        axis: Axis,
        out: Path,
        route: str,
        captures: Sequence[Capture],
        slow: tuple[Capture, ...],
        seed: int,
        told: _Stages,
    ) -> None:
        self.context = context_of(axis, out / "journal", told)
        self._axis, self._out, self._route = axis, out, route
        self._captures, self._slow, self._told = tuple(captures), slow, told
        self._motions = verification_motions(axis.bench, seed)

    def measured(self, drive: "DriveModel", name: str) -> tuple[Compensation, Verification]:
        """Compensation of a model on the controller, with what it is measured to give."""
        self._told.begin(f"{name} compensation")
        compensation = compute_compensation(
            self._axis.bench,
            drive,
            route=self._route,
            slow=self._slow,
            captures=self._captures,
            provenance={"bench_digest": self._axis.bench.digest, "model": f"{name}_model.json"},
            load=read_load(self._axis.link, self._axis.bench.servo_period_s),
            progress=self._told,
        )
        kept = KeptRuns(self._out / f"verification_{name}")
        write_compensation(self._out / f"compensation_{name}.json", compensation)
        deploy(self._axis, compensation, self.context)
        self._told.begin(f"{name} verification")
        found = verify_axis(
            self._axis,
            self.context,
            compensation,
            self._motions,
            drive=drive,
            keep=kept.keep,
            progress=self._told,
        )
        kept.write_result(found)
        return compensation, found

    def off(self, compensation: Compensation) -> None:
        """Switch a compensation off, without a step, before another one takes its place."""
        switch(self._axis, self.context, compensation, on=False)
