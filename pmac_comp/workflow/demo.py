"""The whole job against the simulated Turbo PMAC: capture, identify, compensate, upload, verify.

The card is served on a loopback TCP socket in this process and is reached through the real wire
protocol only; the host knows the bench file and nothing of the plant. The plant's true positions
are recorded beside, so that the report can say what the sensors could not see.
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pmac_comp.base.atomic import atomic_write_text
from pmac_comp.base.documents import document
from pmac_comp.base.errors import ConfigError
from pmac_comp.base.progress import Progress
from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.files.capture import Capture, capture_source, write_capture
from pmac_comp.workflow.capture.axis import Axis, run_all
from pmac_comp.workflow.capture.capturing import prepare
from pmac_comp.workflow.capture.context import context_of
from pmac_comp.workflow.capture.session import open_axis
from pmac_comp.workflow.capture.simulated import (
    ServedClock,
    TruthRecorder,
    default_servo,
    make_card,
    warm_up,
)
from pmac_comp.workflow.compensation.computing import compute_compensation
from pmac_comp.workflow.compensation.file import Compensation, check_route, write_compensation
from pmac_comp.workflow.compensation.text import describe, table_remarks
from pmac_comp.workflow.controller.deploy import Deployment, deploy
from pmac_comp.workflow.law.law_cost import cost_remarks
from pmac_comp.workflow.model.identification import (
    IdentificationOutcome,
    base_friction,
    identify_captures,
)
from pmac_comp.workflow.motion.campaigns import (
    calibration_motions,
    lead_motions,
    require_scale,
    verification_motions,
)
from pmac_comp.workflow.verification.kept_runs import KeptRuns
from pmac_comp.workflow.verification.result import Verification
from pmac_comp.workflow.verification.verify import verify_axis

_STATIC_RUNS = 2  # the standard wants five; the demo is to be short


@dataclass(frozen=True)
class Step:
    """One step of a run and how long it took, s of the wall clock."""

    name: str
    seconds: float


@dataclass(frozen=True)
class RunResult:
    """A whole job: what was captured, identified, uploaded and measured.

    Parameters
    ----------
    title : str
        Heading of the report.
    bench : Bench
        What the host knew.
    controller : str
        Where it ran.
    captures : tuple of Capture
        Calibration runs.
    identified : IdentificationOutcome
        The model.
    compensation : Compensation
        Law and lead map.
    deployment : Deployment
        How the upload ended.
    verification : Verification
        Before and after.
    steps : tuple of Step
        Times.
    plant_notes : tuple of str
        What the simulated plant holds that the host was not told; empty on iron.
    remarks : tuple of str
        Further notes.
    """

    title: str
    bench: Bench
    controller: str
    captures: tuple[Capture, ...]
    identified: IdentificationOutcome
    compensation: Compensation
    deployment: Deployment
    verification: Verification
    steps: tuple[Step, ...]
    plant_notes: tuple[str, ...] = ()
    remarks: tuple[str, ...] = field(default=())

    def summary(self) -> list[str]:
        """Lines for a terminal."""
        lines = [self.title, f"controller: {self.controller} (simulated)", ""]
        lines += ["identified:"]
        for row in self.identified.rows():
            name, value, unit, std = row[0], row[1], row[2], row[3]
            spread = "" if std is None else f" +/- {1.96 * std:.3g}"
            lines.append(f"  {name:44s} {value:.5g}{spread} {unit}")
        lines += ["", f"upload: {self.deployment.verdict.value}"]
        lines += [f"  {note}" for note in self.deployment.notes]
        lines += ["", *self.verification.lines()]
        lines += [f"  note: {remark}" for remark in self.remarks]
        total = sum(step.seconds for step in self.steps)
        lines += ["", "time: " + ", ".join(f"{s.name} {s.seconds:.1f} s" for s in self.steps)]
        return [*lines, f"      {total:.1f} s in all"]

    def as_result(self) -> dict[str, Any]:
        """Mapping for ``--json``."""
        return {
            "kind": "run",
            "simulated": True,
            "bench": self.bench.name,
            "controller": self.controller,
            "parameters": self.identified.as_result()["parameters"],
            "compensation": describe(self.bench, self.compensation),
            "upload": self.deployment.as_result(),
            "verification": self.verification.as_result(),
            "seconds": {step.name: step.seconds for step in self.steps},
            "plant": list(self.plant_notes),
            "remarks": list(self.remarks),
        }


class Stopwatch:
    """Named steps with their times, told to a progress callback."""

    def __init__(self, progress: Progress | None) -> None:
        self._progress = progress
        self.steps: list[Step] = []

    @contextmanager
    def step(self, name: str) -> Iterator[Progress]:
        """Time a step; gives a callback for progress within it."""
        start = time.monotonic()
        self.tell(name, 0.0)
        yield self.tell
        self.steps.append(Step(name, time.monotonic() - start))

    def tell(self, text: str, fraction: float) -> None:
        """Pass progress on."""
        if self._progress is not None:
            self._progress(text, fraction)


def run_demo(
    out: Path,
    *,
    bench: str = "paper",
    plant: str | None = None,
    route: str = "law",
    seed: int = 0,
    progress: Progress | None = None,
) -> RunResult:
    """Run the whole job and leave captures, model, compensation and result in a folder.

    Parameters
    ----------
    out : Path
        Folder for everything; made if missing.
    bench : str
        Bench file or the name of a bundled one.
    plant : str or None
        ``FILE[:FACTORY]`` of a drive of the user's own.
    route : str
        One of ``ROUTES``.
    seed : int
        Draws the verification motions, after the upload.
    progress : callable, optional
        Called with a step and a fraction.

    Raises
    ------
    ConfigError
        Unknown route, a bench without a scale, or a folder that holds runs of a real axis.
    """
    check_route(route)
    if out.exists() and not out.is_dir():
        raise ConfigError(
            f"{out} is a file, a folder is needed.",
            code="PC-DEM-002",
            hint="Name a folder with --out; nothing was written.",
        )
    _refuse_measured(out)
    loaded = load_bench(bench)
    require_scale(loaded, "the whole job")
    out.mkdir(parents=True, exist_ok=True)
    watch = Stopwatch(progress)
    with watch.step("starting the simulated Turbo PMAC"):
        servo = default_servo() if route == "servo" else None
        warm_up(loaded, plant)
        card = make_card(loaded, plant=plant, servo=servo)
        recorder = TruthRecorder(card)
    from pmac_comp.simulator.serving.pace import HostPace
    from pmac_comp.simulator.serving.server import ServeOptions, running_server

    pace = HostPace()
    options = ServeOptions(tcp=0, pace=pace)
    clock = ServedClock(card, pace)
    with (
        running_server(card, options) as endpoints,
        open_axis(endpoints["tcp"], loaded, clock=clock) as axis,
    ):
        result = _whole_job(axis, out, endpoints["tcp"], route, seed, watch, recorder)
    atomic_write_text(out / "result.json", document(result.as_result()))
    return result


def _refuse_measured(out: Path) -> None:
    """Refuse a folder of a real axis: its runs have the names of the demo's."""
    for path in sorted(out.glob("*.h5")):
        if "simulated" not in capture_source(path):
            raise ConfigError(
                f"{out} holds {path.name}, which was not captured on the simulated card.",
                code="PC-DEM-001",
                hint="Name another folder with --out; nothing was written.",
            )


def _whole_job(
    axis: Axis,
    out: Path,
    url: str,
    route: str,
    seed: int,
    watch: Stopwatch,
    recorder: TruthRecorder,
) -> RunResult:
    with watch.step("comparing the controller with the bench file"):
        prepare(axis)
    with watch.step("calibrating") as told:
        axis.setup.store = out / "journal"
        captures = run_all(axis, calibration_motions(axis.bench), progress=told, what="capture")
        slow = run_all(axis, lead_motions(axis.bench), progress=told, what="lead error")
        for i, capture in enumerate([*captures, *slow]):
            write_capture(out / f"calibration_{i + 1:02d}.h5", capture)
    with watch.step("identifying") as told:
        friction = base_friction(captures, axis.bench)
        identified = identify_captures(captures, axis.bench, friction=friction, progress=told)
        identified.write(out / "model.json")
    drive = identified.identification.model
    with watch.step("computing the law") as told:
        compensation = compute_compensation(
            axis.bench,
            drive,
            route=route,
            slow=tuple(slow),
            captures=tuple(captures),
            motion=verification_motions(axis.bench, seed)[0],
            provenance={"model": "model.json", "bench_digest": axis.bench.digest},
            progress=told,
        )
        write_compensation(out / "compensation.json", compensation)
    with watch.step("uploading") as told:
        context = context_of(axis, out / "journal", told)
        if route == "servo":
            axis.link.command(f"I{axis.motor}59=1")
        deployment = deploy(axis, compensation, context)
    with watch.step("verifying") as told:
        kept = KeptRuns(out / "verification")
        verification = verify_axis(
            axis,
            context,
            compensation,
            verification_motions(axis.bench, seed),
            drive=drive,
            static_runs=_STATIC_RUNS,
            truth=recorder.truth,
            keep=kept.keep,
            progress=told,
        )
        kept.write_result(verification)
    axis.kill()
    return RunResult(
        title="pmac-comp demo: the whole job on a simulated Turbo PMAC",
        bench=axis.bench,
        controller=f"simulated Turbo PMAC2 at {url}",
        captures=tuple(captures),
        identified=identified,
        compensation=compensation,
        deployment=deployment,
        verification=verification,
        steps=tuple(watch.steps),
        plant_notes=recorder.notes(),
        remarks=(
            *table_remarks(axis.bench, compensation),
            *cost_remarks(axis.bench, route, compensation.law),
        ),
    )
