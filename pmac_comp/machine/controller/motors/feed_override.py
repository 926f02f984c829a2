"""Feed rate override of a coordinate system: at 0 % no jog and no program gets anywhere.

What lives here: reading it, and what it forbids. What may not: setting it; somebody may have
stopped the machine with it. Source: Software Reference Manual p. 275-276, 325.
"""

from typing import Final

from pmac_comp.base.errors import MotorNotSafe, SafetyRefusal
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.motors.motors import read_motor

FULL_percent: Final = 100.0
_SAME_percent: Final = 0.01


def override_percent(link: Link, system: int) -> float:
    """Feed rate override of a coordinate system in percent; 0 in feed hold as well.

    Parameters
    ----------
    link : Link
        Conversation.
    system : int
        Number of the coordinate system, 1 to 16.
    """
    return float(link.query(f"&{system}%")[0])


def jog_refusals(link: Link, motor: int) -> list[SafetyRefusal]:
    """Refusal where the override of a motor's coordinate system is 0: a jog would never end.

    A motor that no coordinate system has obeys the first one.
    """
    system = read_motor(link, motor).status.coordinate_system
    if override_percent(link, system) > 0.0:
        return []
    return [
        MotorNotSafe(
            f"The feed rate override of coordinate system {system} is 0 %: motor #{motor} would "
            "not move.",
            code="PC-MOT-005",
            hint=_hint(system, 0.0),
        )
    ]


def run_refusals(link: Link, system: int) -> list[SafetyRefusal]:
    """Refusal where a motion would not run at the speed and in the time that it was planned for."""
    percent = override_percent(link, system)
    if abs(percent - FULL_percent) < _SAME_percent:
        return []
    return [
        SafetyRefusal(
            f"The feed rate override of coordinate system {system} is {percent:.4g} %: a run "
            "would not take the time that it is gathered for.",
            code="PC-MOT-006",
            hint=_hint(system, percent),
        )
    ]


def _hint(system: int, percent: float) -> str:
    hold = f" (a feed hold, H, ends with '&{system}R' or '&{system}A' instead)"
    return (
        "If nobody holds the machine with it, set it with `pmac-comp terminal URL -c "
        f"'&{system}%100'`{'' if percent else hold} and run the command again."
    )
