"""Putting the bench file's I-variables on a controller, asked for: one journalled change.

A measurement or an upload writes no settings: where card and bench file differ it is refused
(``as_described``).
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pmac_comp.base.errors import MotorNotSafe, SafetyRefusal
from pmac_comp.files.resources import DEFAULT_JOURNAL
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.change.transaction import UploadResult
from pmac_comp.machine.controller.change.verdict import untouched
from pmac_comp.machine.controller.contents.safety import raise_all
from pmac_comp.machine.controller.contents.settings import Settings
from pmac_comp.machine.controller.motors.motors import read_motors
from pmac_comp.machine.controller.settings.settings_upload import change_settings, texts
from pmac_comp.machine.controller.whole.grouping import grouped
from pmac_comp.workflow.capture.as_described import CLOCK, differing_variables
from pmac_comp.workflow.capture.at_work import at_work, require_free_block
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.context import context_of
from pmac_comp.workflow.capture.session import open_axis


def plan_setup(url: str, bench: str, *, killed: bool = False) -> dict[str, tuple[float, float]]:
    """What ``set_up`` would change: value on the card, value in the bench file.

    Raises
    ------
    MotorNotSafe
        Something would change, ``killed`` motors are asked for, and one is enabled.
    """
    with open_axis(url, bench) as axis:
        require_free_block(axis, url)
        differing = settable_variables(axis)
        if differing and killed:
            require_killed(axis)
        return differing


def set_up(url: str, bench: str, journal: Path = DEFAULT_JOURNAL) -> dict[str, Any]:
    """Put the bench file's I-variables onto a controller; ``rollback`` brings the old ones back."""
    with open_axis(url, bench) as axis:
        context = context_of(axis, journal)
        with at_work(axis, url):
            with untouched():
                differing = settable_variables(axis)
            result = set_up_axis(axis, context, differing)
    return {**result.as_dict(), "changed": differing}


def set_up_axis(
    axis: Axis, context: Context, differing: Mapping[str, tuple[float, float]]
) -> UploadResult:
    """The same on a connected axis, as one journalled change of what differs.

    The clocks (I7000-I7002, I10) are those of the card; ``doctor`` compares them.

    Raises
    ------
    MotorNotSafe
        A motor of the bench file is enabled: gains must not change under a closed loop.
    """
    motors = axis.bench.motor_numbers
    with untouched():
        require_killed(axis)
    goal = Settings(texts({name: wanted for name, (_, wanted) in differing.items()}))
    with grouped(axis.link, context, "setup") as inner:
        return change_settings(axis.link, inner, goal, route="setup", motors=motors)


def settable_variables(axis: Axis) -> dict[str, tuple[float, float]]:
    """Variables of the bench file that stand otherwise and may be set, the clocks apart."""
    return {k: v for k, v in differing_variables(axis.link, axis.bench).items() if k not in CLOCK}


def require_killed(axis: Axis) -> None:
    """Refuse a set-up while a motor of the bench file is enabled; raises MotorNotSafe."""
    raise_all(_enabled_refusals(axis.link, axis.bench.motor_numbers), "The set-up")


def _enabled_refusals(link: Link, numbers: Sequence[int]) -> list[SafetyRefusal]:
    readings = read_motors(link, numbers)
    return [
        MotorNotSafe(
            f"Motor #{number} is enabled; settings change with killed motors only.",
            code="PC-COM-005",
            hint=f"Kill it first: `pmac-comp terminal URL -c '#{number}K'`.",
        )
        for number, reading in readings.items()
        if not reading.status.is_killed
    ]
