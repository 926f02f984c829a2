"""Runs with and without a compensation, whatever its route: what ``verify`` alternates between."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from pmac_comp.base.errors import (
    ControllerState,
    ForeignChange,
    PmacCompError,
    VerifyMismatch,
)
from pmac_comp.files.capture import Capture
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.change.lease import parse_number
from pmac_comp.machine.controller.change.verdict import link_is_lost
from pmac_comp.machine.controller.contents import programs
from pmac_comp.machine.controller.contents.law_bank import Index
from pmac_comp.machine.controller.contents.table_set import (
    POINTERS_TEXT,
    parse_pointers,
    read_table,
)
from pmac_comp.machine.controller.law import law_goal, law_state
from pmac_comp.machine.controller.law.law_state import LawForm
from pmac_comp.machine.controller.motors import motors
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.context import acting
from pmac_comp.workflow.compensation.cam import cam_axis
from pmac_comp.workflow.compensation.file import Compensation
from pmac_comp.workflow.compensation.program import draw_motion, program_axis, run_drawn
from pmac_comp.workflow.compensation.tables import tables_of
from pmac_comp.workflow.controller.deploy import bank_in_use, switch, switch_tables
from pmac_comp.workflow.law.routes import TORQUE_ROUTES
from pmac_comp.workflow.motion.motions import Motion

Run = Callable[[Motion], Capture]


@dataclass(frozen=True)
class Runs:
    """How the motions of a verification are run.

    Parameters
    ----------
    motions : tuple of Motion
        What can be compared.
    without, compensated : callable
        Run a motion and give its capture.
    remarks : tuple of str
        What a person should know; a route for one known motion says so.
    """

    motions: tuple[Motion, ...]
    without: Run
    compensated: Run
    remarks: tuple[str, ...] = ()

    @property
    def is_free(self) -> bool:
        """Whether any other motion can be run as well."""
        return not self.remarks

    def run(self, motion: Motion, *, on: bool) -> Capture:
        """Capture of a motion with or without compensation."""
        return self.compensated(motion) if on else self.without(motion)


def runs_of(
    axis: Axis, context: Context, compensation: Compensation, motions: Sequence[Motion]
) -> Runs:
    """Runs of the route of a compensation.

    Raises
    ------
    ConfigError
        ``cam`` or ``program`` without a motion.
    VerifyMismatch
        The controller holds another program or table than the compensation.
    """
    own: tuple[str, ...] = ()
    without: Run = axis.run
    compensated: Run = axis.run
    if compensation.route == "cam":
        # A cam is for one motion, and only its own program runs the time along.
        runner, motions = cam_axis(axis, compensation)
        without = compensated = runner.run
        own = _OWN_MOTION
    elif compensation.route == "program":
        drawer, motions = program_axis(axis, compensation)
        without, own = drawer.run, _OWN_MOTION

        def compensated(_: Motion) -> Capture:
            return run_drawn(drawer)

    meant = Meant.of(axis, context, compensation)

    def switched(run: Run, *, on: bool) -> Run:
        def capture(motion: Motion) -> Capture:
            meant.require_unchanged(motion)
            switch(axis, context, compensation, on=on)
            found = run(motion)
            meant.require_unchanged(motion, on=on)
            return found

        return capture

    return Runs(tuple(motions), switched(without, on=False), switched(compensated, on=True), own)


@dataclass(frozen=True)
class Meant:
    """What of a compensation the runs are told of: asked for by one question before and after each.

    Parameters
    ----------
    axis, context
        Conversation and block.
    has_tables, has_law : bool
        What of it is switched between runs.
    change : int
        Number of the last change of the card.
    pointers : tuple of int
        Start addresses of all tables.
    """

    axis: Axis
    context: Context
    has_tables: bool
    has_law: bool
    change: int
    pointers: tuple[int, ...]

    @classmethod
    def of(cls, axis: Axis, context: Context, compensation: Compensation) -> "Meant":
        """As it stands now."""
        _, change, _, pointers = _ask(axis, context)
        has_tables = bool(tables_of(compensation, axis.bench))
        has_law = compensation.route in TORQUE_ROUTES
        return cls(axis, context, has_tables, has_law, change, pointers)

    def require_unchanged(self, motion: Motion, *, on: bool | None = None) -> None:
        """Refuse to go on where it was changed since the first run; ``on`` as it was switched.

        Raises
        ------
        ForeignChange
            A change of the card, another table, or a switch that is not as it was set.
        """
        i51, change, target, pointers = _ask(self.axis, self.context)
        found = []
        if change != self.change:
            found.append("another change of the card was made")
        if pointers != self.pointers:
            found.append("tables were defined or deleted")
        if on is not None and self.has_tables and i51 != float(on):
            found.append(f"I51 is {i51:g}")
        if on is not None and self.has_law and (target != 0.0) != on:
            found.append(f"the law's gain is to be {target:g}")
        if not found:
            return
        when = "before" if on is None else "during"
        raise ForeignChange(
            f"The compensation was changed {when} the run of {motion.name}: {'; '.join(found)}. "
            "No run from then on is kept.",
            code="PC-WRK-003",
            hint="Somebody else works at this controller, maybe from another host or with "
            "another program. See what stands with `pmac-comp status`, upload the compensation "
            "again if it is gone, and verify again.",
        )


def _ask(axis: Axis, context: Context) -> tuple[float, int, float, tuple[int, ...]]:
    """I51, number of the last change, wanted gain of the law, start addresses of all tables."""
    change, target = context.block.p(Index.CHANGE), context.block.p(Index.TARGET)
    i51, number, gain, *rest = axis.link.query(f"I51P{change}P{target}{POINTERS_TEXT}")
    return float(i51), parse_number(number), float(gain), parse_pointers(rest)


_OWN_MOTION = (
    "this route is for one known motion: others have its tables at most, and positioning after "
    "ISO 230-2 and ringing are not measured",
)


def require_on_card(axis: Axis, context: Context, compensation: Compensation) -> None:
    """Refuse to compare with a compensation that the controller does not hold.

    Raises
    ------
    VerifyMismatch
        Its tables, law or program do not stand there: runs 'with' it would be with something else.
    """
    other = [
        f"its {table.kind.value} table"
        if table.motor == axis.motor
        else f"its cam (the {table.kind.value} table of motor #{table.motor})"
        for table in tables_of(compensation, axis.bench)
        if (found := read_table(axis.link, table.kind, table.motor)) is None
        or found.entries != table.entries
    ]
    if compensation.route in TORQUE_ROUTES and not _law_stands(axis, context, compensation):
        other.append("its law")
    if compensation.route == "program":  # that of a cam is looked at before each run of either side
        drawn = draw_motion(compensation, axis.bench).program
        other += [] if programs.is_present(axis.link, drawn) else [f"its {drawn.name}"]
    if other:
        raise VerifyMismatch(
            f"The controller does not hold {' and '.join(other)}: nothing is to be verified.",
            code="PC-VER-005",
            hint="Upload this compensation first, or name the one that was uploaded; "
            "`pmac-comp status` shows what stands. Nothing was moved.",
            left=ControllerState.OLD,
        )


def _law_stands(axis: Axis, context: Context, compensation: Compensation) -> bool:
    head = law_state.read_law_head(axis.link, context.block)
    runs = law_goal.running_form(axis.link, context, head) is not LawForm.NONE
    return runs and bank_in_use(axis, context, compensation) is not None


@contextmanager
def left_as_found(axis: Axis, context: Context, compensation: Compensation) -> Iterator[None]:
    """Comparisons in between; afterwards compensation and motor are as they were found.

    After an error the axis is only stopped (``Axis.run`` did that): nobody knows what a further
    command would meet. Who stops it by Ctrl-C does not want it to move to where tables may be
    switched, but finds a motor killed that was. Both then say what acted before, unless it is seen
    to act still, as after a refusal before the first run.
    """
    killed = motors.read_motor(axis.link, axis.motor).status.is_killed
    armed, tables = acting(axis, context)
    try:
        yield
    except BaseException as error:
        if not _seen_to_act(axis, context, (armed, tables), error):
            error.add_note(_acted_before(armed=armed, tables=tables))
        if killed and isinstance(error, KeyboardInterrupt):
            axis.kill_once_it_stands()
        raise
    if (armed, tables) != acting(axis, context):
        switch(axis, context, compensation, on=armed)
        switch_tables(axis, on=tables)
    if killed:
        axis.kill()


def _seen_to_act(
    axis: Axis, context: Context, found: tuple[bool, bool], error: BaseException
) -> bool:
    """Whether law and tables act after an error as they were found; nobody looks after Ctrl-C."""
    if not isinstance(error, PmacCompError) or link_is_lost(error):
        return False
    try:
        return acting(axis, context) == found
    except PmacCompError:
        return False


def _acted_before(*, armed: bool, tables: bool) -> str:
    acted = [text for text, did in (("the law was armed", armed), ("tables acted", tables)) if did]
    if not acted:
        return "Before it no compensation acted."
    return (
        f"Before it {' and '.join(acted)}; one `pmac-comp upload` of the same compensation, with "
        "the motor enabled, brings that back."
    )
