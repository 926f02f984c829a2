"""An axis under a controller: made ready, moved along trajectories, and gathered in SI.

What lives here: the sequence of one run. What may not: the registers themselves
(``machine.controller``), what is gathered and the capture it becomes (``samples``), the fit.
Nothing here is repeated after a doubt: a run that did not come back whole is run again from its
start.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import ClassVar

import numpy as np

from pmac_comp.base.clock import Deadline
from pmac_comp.base.errors import (
    CaptureError,
    CommandRefused,
    MotorNotSafe,
    PmacCompError,
    SafetyRefusal,
)
from pmac_comp.base.progress import Progress
from pmac_comp.base.units import MM_PER_M, MS_PER_S
from pmac_comp.files.bench import Bench
from pmac_comp.files.capture import Capture
from pmac_comp.files.sidecar import Attribute
from pmac_comp.machine.client.commander import Commander
from pmac_comp.machine.controller.contents import programs
from pmac_comp.machine.controller.contents.safety import raise_all
from pmac_comp.machine.controller.gather import gather
from pmac_comp.machine.controller.gather.gather_plan import (
    GatherMode,
    GatherPlan,
)
from pmac_comp.machine.controller.gather.gather_samples import GatherResult
from pmac_comp.machine.controller.motors import motors
from pmac_comp.machine.controller.motors.feed_override import jog_refusals
from pmac_comp.machine.controller.motors.motion import program_status
from pmac_comp.machine.controller.motors.supervision import SensorWatch
from pmac_comp.workflow.bench.scales import Scales
from pmac_comp.workflow.capture.axis_setup import AxisSetup
from pmac_comp.workflow.capture.run_cut import TAIL_s
from pmac_comp.workflow.capture.run_log import RunLog
from pmac_comp.workflow.capture.samples import capture_of_samples, gather_plan, stored
from pmac_comp.workflow.capture.sensors import (
    MISMATCH_m,
    block_watch,
    is_blind,
    jog_watch,
    require_agreement,
)
from pmac_comp.workflow.motion.approach import (
    PROGRAM_DWELL_s,
    SETTLE_s,
    run_up_m,
)
from pmac_comp.workflow.motion.motions import Motion, check_motion, relaxing
from pmac_comp.workflow.motion.pvt import PROGRAM_NUMBER, pvt_program

_START_TIME_s = 0.4  # program start, calculation time and the first DWELL
_ATTEMPTS = 3
_END_s = 0.5  # after the last sample, for a host that ran ahead of the card's clock
_START_ATTEMPTS = 10
_SOURCE = "gathered at the servo rate"
_SIMULATED_SOURCE = "simulated controller and drive, gathered at the servo rate"
HALT_s = 2.0  # for an axis that was stopped to stand
_LOOK_s = 0.05  # between questions for the positions while the card gathers for itself
_TRIPPED = "PC-AXI-002"
_ERR_MOVE_NOT_COMPLETED = 11  # Software Reference Manual p. 391


def _gathered_s(motion: Motion) -> float:
    """How long a run of a motion is gathered, its start and its tail with it."""
    return motion.duration_s + _START_TIME_s + TAIL_s


@dataclass
class Axis:
    """A connected axis of one bench.

    Parameters
    ----------
    link : Commander
        Conversation; its clock is the clock of the controller's time.
    bench : Bench
        What is known of the axis.
    identity : str
        Controller identity for captures.
    simulated : bool
        Whether the controller says that it is a simulated one; captures then say so.
    address : str
        Where it is, which tells it from others that answer alike; empty where nothing has to.
    setup : AxisSetup
        Axis definitions that were put aside, shared by all axes of a session.
    run_log : RunLog
        Where the samples of a run are kept while it lasts; nowhere if not named.
    """

    link: Commander
    bench: Bench
    identity: str = ""
    simulated: bool = False
    address: str = ""
    setup: AxisSetup = field(default_factory=AxisSetup)
    run_log: RunLog = field(default_factory=RunLog)
    scales: Scales = field(init=False)
    program_number: int = field(init=False, default=PROGRAM_NUMBER)
    keeps_rests: ClassVar[bool] = False  # of a motion at its ends: a known one is judged there too

    def __post_init__(self) -> None:
        self.scales = Scales.of(self.bench)

    @property
    def motor(self) -> int:
        """Number of the motor that closes the loop."""
        return self.bench.encoder.motor_number

    def enable(self) -> None:
        """Close the loop where the axis stands."""
        motors.enable(self.link, self.motor)

    def kill(self) -> None:
        """Switch the amplifier off."""
        motors.kill(self.link, self.motor)

    def move_to(self, place_ct: float) -> None:
        """Jog to a position in counts and wait; whoever stops waiting stops the axis as well.

        Encoder and scale are compared on the way: with wrong counts it would be a long one.

        Raises
        ------
        MotorNotSafe
            The place is outside the travel or the feed rate override is 0, nothing was sent; or
            the motor did not arrive.
        """
        raise_all(
            [*self._place_refusals(place_ct), *jog_refusals(self.link, self.motor)], "The move"
        )
        watch = jog_watch(self.link, self.bench, self.scales)
        try:
            motors.move_to(self.link, self.motor, place_ct, during=watch)
        except (PmacCompError, KeyboardInterrupt) as error:
            with suppress(PmacCompError):
                self.link.flush()
                self._end_jog(blind=isinstance(error, PmacCompError) and is_blind(error))
            if isinstance(error, PmacCompError):
                self._tell_trips(error)
            raise

    def _place_refusals(self, place_ct: float) -> list[SafetyRefusal]:
        """Refusal of a place outside the travel; a count is left to rounding."""
        limits, travel = self.scales.limits(self.bench), self.bench.travel
        if limits.min_position_ct - 1.0 <= place_ct <= limits.max_position_ct + 1.0:
            return []
        place_mm = place_ct * self.scales.motor_m_per_ct * MM_PER_M
        return [
            MotorNotSafe(
                f"Motor #{self.motor} would move to {place_mm:.3f} mm, outside the travel of "
                f"{travel.min_mm:g} to {travel.max_mm:g} mm.",
                code="PC-MOT-040",
                hint="Nothing was moved. Correct [travel] in the bench file if the axis may go "
                "there.",
            )
        ]

    def _end_jog(self, *, blind: bool) -> None:
        """Hold the axis where it is, or kill it where its own encoder may be at fault."""
        if blind:
            self.kill()
        elif motors.read_motor(self.link, self.motor).status.is_closed_loop:
            self.link.command(f"#{self.motor}J/")
            motors.wait_in_position(self.link, self.motor, timeout_s=HALT_s)

    def run(
        self, motion: Motion, *, relaxed: bool = False, progress: Progress | None = None
    ) -> Capture:
        """Run a motion from its start and gather it at the servo rate.

        Parameters
        ----------
        motion : Motion
            What to run.
        relaxed : bool
            Wiggle before the motion, so that it starts as a simulation does; the wiggle is not
            part of the capture. Where the card gathers into its own memory, which the wiggle would
            fill, the start is approached instead, and the capture says so.
        progress : callable, optional
            Called with a step and a fraction.

        Raises
        ------
        SafetyRefusal
            The motion leaves the travel or passes the limits.
        CaptureError
            No attempt gave every sample.
        MotorNotSafe
            The motor tripped on the way.
        """
        check_motion(motion, self.bench)
        relaxed = relaxed and gather_plan(self.link, self.bench).mode is GatherMode.RING
        whole, first = relaxing(motion) if relaxed else (motion, 0)
        self.prepare(whole)
        self.require_room(whole)
        for attempt in range(_ATTEMPTS):
            with self._halted_if_cut_off():
                if not relaxed:
                    self._run_up(whole)
                self._go_to_start(whole)
                result = self._gather(whole, progress)
            if not result.gaps:
                return capture_of_samples(
                    result,
                    whole,
                    self.scales,
                    self._attributes(whole),
                    skipped=first,
                    with_rests=self.keeps_rests,
                )
            if progress is not None:
                progress(f"{motion.name}: samples lost, run {attempt + 2} of {_ATTEMPTS}", -1.0)
        result.require_whole()
        raise CaptureError("The run was not whole.", code="PC-AXI-001")

    @contextmanager
    def _halted_if_cut_off(self) -> Iterator[None]:
        """Stop the axis where whoever watches it has gone: Ctrl-C, or an error in the run."""
        try:
            yield
        except KeyboardInterrupt:
            self.halt()
            raise
        except PmacCompError as error:
            self.halt()
            if is_blind(error):
                with suppress(PmacCompError):
                    self.kill()
            self._tell_trips(error)
            raise

    def _tell_trips(self, error: PmacCompError) -> None:
        """Add to an error that the card had stopped the motor by itself: nothing holds it then.

        Asked once the axis was told to stop: a question before that would let it run on.
        """
        if error.code == _TRIPPED:
            return
        with suppress(PmacCompError):
            status = motors.read_motor(self.link, self.motor).status
            if status.trips and status.is_killed:
                error.add_note(
                    f"Motor #{self.motor} had been killed by the card itself: "
                    f"{', '.join(status.trips)}. Nothing holds it."
                )

    def halt(self) -> None:
        """Abort the motion program, decelerate in closed loop and end gathering, as far as told.

        Answers that are still under way are dropped first. Nothing is raised: this runs while
        something else has gone wrong, and that is what must be reported.
        """
        with suppress(PmacCompError):
            self.link.flush()
        stops = ["&1A", f"#{self.motor}J/", "ENDGATHER"]
        with suppress(PmacCompError):
            # A with I36 = 0, and J/, would close the loop of a killed motor again: one that ran
            # away would run on. Where its program has not ended with it, K comes with the A.
            if motors.read_motor(self.link, self.motor).status.is_killed:
                still = program_status(self.link).running
                stops = [*([f"&1A#{self.motor}K"] if still else []), "ENDGATHER"]
        for text in stops:
            with suppress(PmacCompError):
                self.link.command(text)

    def kill_once_it_stands(self) -> None:
        """Switch the amplifier off after ``halt``; as there, nothing is raised."""
        with suppress(PmacCompError):
            motors.wait_in_position(self.link, self.motor, timeout_s=HALT_s)
            self.kill()

    def prepare(self, motion: Motion) -> None:
        """Download the motion as a PVT program and compare what the card lists."""
        pvt = pvt_program(motion, self.bench)
        gather.stop(self.link)
        self.define_axis()
        self.program_number = PROGRAM_NUMBER
        lines = (f"DWELL{PROGRAM_DWELL_s * MS_PER_S:.0f}", *pvt.lines, "DWELL50")
        programs.download(
            self.link, programs.Program(programs.ProgramKind.PROG, PROGRAM_NUMBER, lines)
        )

    def define_axis(self) -> None:
        """Make the motor axis X in counts; what is lost by that comes back at the session's end."""
        self.setup.put_on(self.link, self.bench, self.identity, self.address)

    def release_axis(self) -> None:
        """Bring axis definitions back that measurements put aside."""
        self.setup.take_off(self.link)

    def release_after(self, error: BaseException) -> None:
        """The same though something failed; if that fails too, the error says so."""
        try:
            self.release_axis()
        except PmacCompError as second:
            error.add_note(
                f"Axis definitions from before the measurement are not back: {second.message} "
                "`pmac-comp recover` brings them back."
            )

    def _run_up(self, motion: Motion) -> None:
        """Stand a little way inside the travel, so that every run meets its start the same way.

        Friction remembers the approach, and a law that was switched on at standstill does not know
        how the drive got there: where the axis stands on the start already, runs with and without
        compensation would begin in states that no later run has. Where it comes from afar it goes
        to the start first: the way inward is too short for the integrator to forget a long jog.
        """
        start_m = float(motion.position_m[0])
        self._go_to(start_m)
        self._go_to(run_up_m(self.bench, start_m))

    def _go_to_start(self, motion: Motion) -> None:
        self._go_to(float(motion.position_m[0]))
        self.link.clock.sleep_s(SETTLE_s)

    def _go_to(self, place_m: float) -> None:
        if motors.read_motor(self.link, self.motor).status.is_killed:
            self.enable()
        self.move_to(place_m / self.scales.motor_m_per_ct)

    def _gather(self, motion: Motion, progress: Progress | None) -> GatherResult:
        plan = gather_plan(self.link, self.bench)
        duration_s = _gathered_s(motion)
        clock = self.link.clock
        start_s = clock.now_s()

        self.setup.hold_on(self.link)

        def going_on() -> bool:
            self.setup.keep_on(self.link)
            if progress is not None:
                progress(motion.name, min(1.0, (clock.now_s() - start_s) / duration_s))
            return True

        def start() -> None:
            self._start_program()

        if plan.mode is GatherMode.RING:
            with self.run_log.of(self._attributes(motion), clock) as log:
                result = gather.gather_ring(
                    self.link,
                    plan,
                    duration_s,
                    self.scales.period_s,
                    log=log,
                    during=start,
                    keep_going=going_on,
                    on_block=block_watch(self.bench, self.scales),
                )
        else:
            result = self._gather_ram(plan, duration_s, start)
        self._check_alive()
        self._require_end(motion)
        return result

    def _start_program(self) -> None:
        """Run the program; a card that still ends the jog before refuses and changes nothing."""
        for _ in range(_START_ATTEMPTS):
            try:
                self.link.command(f"&1B{self.program_number}R")
            except CommandRefused as error:
                if error.context.get("error") != _ERR_MOVE_NOT_COMPLETED:
                    raise
                self.link.clock.sleep_s(0.02)
            else:
                return
        self.link.command(f"&1B{self.program_number}R")

    def _gather_ram(
        self, plan: GatherPlan, duration_s: float, start: Callable[[], None]
    ) -> GatherResult:
        n_samples, words = stored(plan, duration_s, self.scales.period_s)
        with gather.prepared(self.link, plan, words):
            self.link.command("GATHER")
            start()
            self._watch_positions(duration_s + 0.05)
            gather.await_stored(self.link, plan, n_samples)
            self.link.command("ENDGATHER")
            return gather.read_ram(self.link, plan, n_samples)

    def require_room(self, motion: Motion) -> None:
        """Refuse a run that the card's own buffer cannot hold; SIZE is what is free (p. 396).

        Raises
        ------
        CaptureError
            The run is gathered there and is too long; nothing was moved for it.
        """
        plan = gather_plan(self.link, self.bench)
        if plan.mode is GatherMode.RING:
            return
        gather.stop(self.link)  # a buffer that was left behind is in the way
        _, words = stored(plan, _gathered_s(motion), self.scales.period_s)
        free = int(self.link.query("SIZE")[0])
        if words <= free:
            return
        sample_s = self.scales.period_s * plan.period_cycles
        margin_s = _START_TIME_s + TAIL_s
        needs_s, held_s = (
            (n - gather.HEADER_LONG_WORDS) / plan.layout.long_words * sample_s
            for n in (words, free)
        )
        raise CaptureError(
            f"{motion.name} lasts {needs_s - margin_s:.1f} s with the rests around its motion, and "
            f"the controller's own memory, into which it is gathered on this line, holds "
            f"{max(0.0, held_s - margin_s):.1f} s ({words} long words needed, {free} free).",
            code="PC-AXI-005",
            hint="Name shorter motions with --motion, or connect by Ethernet to a card with "
            "dual-ported RAM, which gathers runs of any length.",
        )

    def _watch_positions(self, duration_s: float) -> None:
        """Wait for a run that is gathered on the card; its sensors are compared by questions."""
        scale = self.bench.scale
        deadline = Deadline.after(self.link.clock, duration_s)
        watch = SensorWatch(MISMATCH_m)
        while not deadline.expired():
            self.link.clock.sleep_s(min(_LOOK_s, max(0.0, deadline.remaining_s())))
            self.setup.keep_on(self.link)
            if scale is None or deadline.expired():
                continue
            found = motors.read_motors(self.link, [self.motor, scale.motor_number])
            motor, table = (found[n].position_ct for n in (self.motor, scale.motor_number))
            places = (
                np.array([motor * self.scales.motor_m_per_ct]),
                np.array([table * self.scales.scale_m_per_ct]),
            )
            require_agreement(watch.feed(*places))

    def _check_alive(self) -> None:
        status = motors.read_motor(self.link, self.motor).status
        if status.trips or status.is_killed:
            raise MotorNotSafe(
                f"Motor #{self.motor} stopped during the run: "
                f"{', '.join(status.trips) or 'it was killed'}.",
                code=_TRIPPED,
                hint="Look at `pmac-comp status`; the motor is left killed.",
            )

    def _require_end(self, motion: Motion) -> None:
        """Refuse a run whose program takes longer than planned: the samples end before it does."""
        deadline = Deadline.after(self.link.clock, _END_s)
        while program_status(self.link).running:
            if deadline.expired():
                raise CaptureError(
                    f"The motion program for {motion.name} was not over when its time was; the "
                    "axis was stopped and the run is not kept.",
                    code="PC-AXI-006",
                    hint="Look at the feed rate override: `pmac-comp terminal URL -c '&1%'` "
                    "should say 100; `&1%100` sets it.",
                )
            self.link.clock.sleep_s(_LOOK_s)

    def _attributes(self, motion: Motion) -> dict[str, Attribute]:
        plan = gather_plan(self.link, self.bench)
        return {
            "source": _SIMULATED_SOURCE if self.simulated else _SOURCE,
            "controller": self.identity or self.link.name,
            "motion": motion.name,
            "start_utc": datetime.now(UTC).isoformat(timespec="milliseconds"),
            "servo_period_s": self.scales.period_s,
            "decimation": 1,
            "gather_sources": " ".join(source.name for source in plan.sources),
            "bench_text": self.bench.text,
        }


def run_all(
    axis: Axis,
    motions: Sequence[Motion],
    *,
    relaxed: bool = True,
    progress: Progress | None = None,
    what: str = "",
) -> list[Capture]:
    """Captures of motions, one after another, with progress over all."""
    total_s = sum(m.duration_s for m in motions)
    done_s = 0.0
    captures: list[Capture] = []
    for motion in motions:
        share = motion.duration_s / total_s

        def step(text: str, fraction: float, done: float = done_s, part: float = share) -> None:
            if progress is not None:
                progress(f"{what}: {text}", done / total_s + part * max(0.0, fraction))

        captures.append(axis.run(motion, relaxed=relaxed, progress=step))
        done_s += motion.duration_s
    return captures
