"""Compensation of an axis taken off a controller, whoever put it on: no journal of it is needed.

What lives here: what of this tool stands on the card for an axis, and taking all of it off as one
upload that ``rollback`` brings back. Settings that uploads of this folder have replaced come back
with it; of those of another folder what stood before is not known, and they stay. What may not: the
transactions (``machine.controller``).
"""

from collections.abc import Collection
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pmac_comp.base.progress import Progress
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.change.transaction import UploadResult
from pmac_comp.machine.controller.change.verdict import untouched
from pmac_comp.machine.controller.contents import programs
from pmac_comp.machine.controller.contents.law_bank import LawBlock
from pmac_comp.machine.controller.contents.safety import raise_all
from pmac_comp.machine.controller.contents.settings import Settings, read_settings, same_definition
from pmac_comp.machine.controller.contents.table_set import Key, read_tables
from pmac_comp.machine.controller.law import law_goal, law_install, law_state
from pmac_comp.machine.controller.law.law_checks import law_elsewhere
from pmac_comp.machine.controller.law.law_state import LawForm
from pmac_comp.machine.controller.motors import motors
from pmac_comp.machine.controller.settings import guard_install, temporary
from pmac_comp.machine.controller.settings.definition_use import definitions_in_use
from pmac_comp.machine.controller.settings.settings_upload import SettingsUpload, lease_refusals
from pmac_comp.machine.controller.tables.upload import remove_tables
from pmac_comp.machine.controller.whole.grouping import grouped
from pmac_comp.machine.controller.whole.leftovers import (
    REMOVAL,
    before_uploads,
    known_definitions,
    merged,
)
from pmac_comp.machine.controller.whole.waiting import waiting_refusals
from pmac_comp.workflow.capture.at_work import at_work, require_free_block
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.axis_setup import UNITS
from pmac_comp.workflow.capture.context import context_of, context_to_look
from pmac_comp.workflow.capture.session import open_axis
from pmac_comp.workflow.compensation.cam import rest_time_motor, time_motor_off
from pmac_comp.workflow.controller.motion_owners import MOTIONS, is_motion_of, motions_of_others
from pmac_comp.workflow.controller.owners import cam_of_another, is_of_axis
from pmac_comp.workflow.controller.standing import (
    Sets,
    place_refusals,
    stand_to_switch,
    standing_lines,
    uploading,
)
from pmac_comp.workflow.controller.upload_flow import rollback_command


@dataclass(frozen=True)
class Standing:
    """What compensates an axis now: tables by kind and motor, and the form of the law.

    ``beside`` brings what is known without a journal to the state without it: time motor and
    programs of known motions, guard, definitions of the law. ``in_plc_0`` says that the law itself
    stands there, and not only what it left.
    """

    tables: tuple[Key, ...]
    law: LawForm
    beside: Settings = field(default_factory=Settings)
    in_plc_0: bool = True

    @property
    def is_empty(self) -> bool:
        """Whether nothing stands."""
        return not self.tables and self.law is LawForm.NONE and self.beside.is_empty

    def lines(self) -> list[str]:
        """For people."""
        said = [f"table {kind.value} of motor #{motor}" for kind, motor in self.tables]
        if self.law is LawForm.PLC:
            what = (
                "the law in PLC 0, with" if self.in_plc_0 else "what a law that is gone has left:"
            )
            said.append(f"{what} following and torque offset of its motor")
        if self.law is LawForm.SERVO:
            said.append("the law in the open servo: faded out; the servo itself stays (Ixx59)")
        said += [f"{kind.value} {number}" for kind, number in self.beside.programs]
        said += [f"motor #{name[1:-2]}, which counts time" for name in self.beside.variables]
        said += ["M-variables of law or guard"] if self.beside.definitions else []
        return said or ["nothing of a compensation stands for this axis"]


def standing_on(axis: Axis) -> Standing:
    """Tables and law of the bench's axis; nothing is changed."""
    tables = tuple((t.kind, t.motor) for t in read_tables(axis.link) if is_of_axis(axis, t))
    in_plc_0 = law_goal.law_stands(axis.link, context_to_look(axis).block)
    law = _form_of_law(axis)
    return Standing(tables, law, _beside(axis, law), in_plc_0)


def _beside(axis: Axis, law: LawForm, known: Collection[int] = ()) -> Settings:
    """What of ours stands beside tables and law, switched off, emptied or undefined.

    A definition is a law's or a guard's where one of ours stands or has just been taken off: others
    use the same registers. Those that are known to have stood before stay.
    """
    link, guard = axis.link, guard_install.guard_program(_block(axis)).tokens
    defined = law_goal.definitions(axis.motor)
    asked = Settings(
        definitions=defined, programs=dict.fromkeys([*MOTIONS, guard_install.GUARD], ())
    )
    found = read_settings(link, asked)
    ours = [key for key in MOTIONS if is_motion_of(axis, key[1], found.programs[key])]
    if programs.canonical(found.programs[guard_install.GUARD]) == guard:
        ours.append(guard_install.GUARD)
    of_law = set(defined) - {guard_install.GUARD_DEFINITION} if law is LawForm.PLC else set()
    of_guard = {guard_install.GUARD_DEFINITION} if guard_install.GUARD in ours else set()
    free = {
        n: "*"
        for n in (of_law | of_guard) - set(known)
        if same_definition(defined[n], found.definitions[n])
    }
    goal = merged(
        Settings(definitions=free, programs=dict.fromkeys(ours, ())), time_motor_off(axis)
    )
    return _not_of_others(axis, goal)


def _not_of_others(axis: Axis, goal: Settings) -> Settings:
    """Without what law, guard and motion of another axis use as well, where one of them stands."""
    goal = _not_of_their_motions(axis, goal)
    places = Settings(programs={law_goal.LAW: (), guard_install.GUARD: ()})
    found = read_settings(axis.link, places).programs
    guard = guard_install.guard_program(_block(axis)).tokens
    kept = dict(goal.definitions)
    if found[law_goal.LAW]:
        kept = {n: text for n, text in kept.items() if n == guard_install.GUARD_DEFINITION}
        goal = replace(goal, variables={k: v for k, v in goal.variables.items() if k != "I8"})
    if programs.canonical(found[guard_install.GUARD]) not in {(), guard}:
        kept.pop(guard_install.GUARD_DEFINITION, None)
    used = definitions_in_use(axis.link, kept, goal.programs) if kept else frozenset()
    kept = {n: text for n, text in kept.items() if n not in used}
    return replace(goal, definitions=kept)


def _not_of_their_motions(axis: Axis, goal: Settings) -> Settings:
    """Without axes and units, where coordinate system 1 serves a motion of another axis.

    And without the motor that counts time, where it does so for that one.
    """
    shared = cam_of_another(axis) is not None
    if not shared and not motions_of_others(axis):
        return goal
    counting = f"I{axis.bench.controller.cam_motor_number}" if shared else None
    kept = {
        name: text
        for name, text in goal.variables.items()
        if name not in UNITS and name[:-2] != counting
    }
    return replace(goal, variables=kept, axes=None)


def _block(axis: Axis) -> LawBlock:
    return LawBlock.from_p_block(axis.bench.controller.p_block)


def _form_of_law(axis: Axis) -> LawForm:
    """Form of the law for the axis' motor; a PLC 0 that was stopped has left its outputs standing.

    What is left of one, too: a motor that follows the master word.
    """
    link, context = axis.link, context_to_look(axis)
    head = law_state.read_law_head(link, context.block)
    if head.motor != axis.motor:
        return LawForm.NONE
    if law_goal.law_stands(link, context.block) or axis.motor in law_goal.followers(link):
        return LawForm.PLC
    return law_goal.running_form(link, context, head)


def plan_removal(url: str, bench: str) -> dict[str, Any]:
    """What ``remove_compensation`` would take off, and from where to where the axis moves for it.

    Raises
    ------
    MotorNotSafe
        There is no place where its tables could be switched without a step.
    SafetyRefusal
        The law of another bench file works with variables of the axis' block.
    """
    with open_axis(url, bench) as axis:
        require_free_block(axis, url)
        found = standing_on(axis)
        other = law_elsewhere(axis.link, context_to_look(axis), axis.motor)
        if found.is_empty:
            return {"would_remove": [], "motion": [], "stays": _staying(other)}
        return {
            "would_remove": found.lines(),
            "motion": standing_lines(axis, _without(found)),
            "stays": _staying(other),
        }


def _without(found: Standing) -> Sets:
    return uploading((), found.tables)


_FLASH = (
    "the flash was not touched: if any of it was saved there, a reset brings it back (with all "
    "motors killed, `pmac-comp terminal URL -c SAVE` keeps what stands now)"
)


def remove_compensation(
    url: str, bench: str, journal: Path, *, progress: Progress | None = None
) -> dict[str, Any]:
    """Take tables and law of an axis off, verified; ``rollback`` brings them back."""
    with open_axis(url, bench) as axis:
        context = context_of(axis, journal, progress)
        with at_work(axis, url):
            temporary.take_off(axis.link, context)
            with untouched():
                found = standing_on(axis)
            results = remove_from(axis, context, found) if not found.is_empty else ()
            other = law_elsewhere(axis.link, context, axis.motor)
    return {
        "removed": [] if found.is_empty else found.lines(),
        "parts": [result.as_dict() for result in results],
        "said": [*([_FLASH] if results else []), *_staying(other)],
        "next": f"Bring it back: {rollback_command(url, bench, journal)}",
    }


def _staying(other: int | None) -> list[str]:
    """That PLC 0 is the law of another bench file, which only that one knows."""
    if other is None:
        return []
    return [
        f"the law of another bench file, whose p_block begins at P{other}, stays in PLC 0 and may "
        "act: `pmac-comp remove` with that file takes it off"
    ]


def remove_from(axis: Axis, context: Context, found: Standing) -> tuple[UploadResult, ...]:
    """The same on a connected axis, as one upload, where its tables may be switched."""
    with untouched():  # before the axis moves for it
        refusals = waiting_refusals(axis.link, context) + lease_refusals(axis.link, context)
        raise_all([*refusals, *place_refusals(axis, _without(found))], "The removal")
        rest_time_motor(axis)
        stand_to_switch(axis, _without(found))
    results: list[UploadResult] = []
    with grouped(axis.link, context, REMOVAL) as inner:
        if found.law is LawForm.PLC:
            results.append(law_install.remove_law(axis.link, inner))
        if found.law is LawForm.SERVO:
            results.append(law_install.fade_law(axis.link, inner, axis.motor))
        if found.tables:
            results.append(remove_tables(axis.link, inner, found.tables))
        results += _remove_beside(axis, inner, found.law)
    return tuple(results)


def _remove_beside(axis: Axis, context: Context, law: LawForm) -> list[UploadResult]:
    """What is left beside tables and law, as it stood before where this folder knows that."""
    with untouched():
        beside = _beside(axis, law, known_definitions(context))
        goal = _not_of_others(axis, merged(beside, before_uploads(axis.link, context)))
    if goal.is_empty:
        return []
    off = [int(name[1:-2]) for name, text in goal.variables.items() if _is_off(name, text)]

    def kill() -> None:
        for motor in off:
            motors.kill(axis.link, motor)

    with SettingsUpload(axis.link, context, goal, route=REMOVAL, motors=[axis.motor]) as upload:
        upload.write(first=kill)
        return [upload.finish()]


def _is_off(name: str, text: str) -> bool:
    return name.endswith("00") and len(name) > len("I00") and text.strip() == "0"
