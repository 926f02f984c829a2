"""When runs began, for effects that depend on time.

What lives here: the free start times of runs. A pump knows of no capture, and an axis warms up over
a session of which captures are pieces; files seldom say at which time of either a run began. May
import ``records`` and ``workbench``.
"""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from pmac_comp.physics.diagnose.records import Record
from pmac_comp.physics.diagnose.workbench import Direction
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.model.effect import split_name

WAVES = frozenset({"external_force"})
"""Effects that repeat in time."""
SLOW = frozenset({"thermal_growth", "friction_warmup"})
"""Effects that begin once."""
_STEP = 0.05  # rad of a wave, or share of a time constant
_PHASES = 6


def _present(model: DriveModel, kind: frozenset[str]) -> frozenset[str]:
    return kind & frozenset({split_name(name)[0] for name in model.effects})


def needs_clocks(model: DriveModel) -> bool:
    """Whether the times at which runs began are free in a model, and matter."""
    return len(model.clocks) > 1 and bool(_present(model, WAVES | SLOW))


def free_clocks(model: DriveModel) -> int:
    """Number of such times; the first run's is the origin."""
    return len(model.clocks) - 1 if needs_clocks(model) else 0


def clock_directions(model: DriveModel, share: float) -> list[Direction]:
    """One direction per run but the first; ``share`` scales the step of the difference."""
    if not needs_clocks(model):
        return []
    step = share * _step_s(model)
    # What begins once has not begun before it began.
    lower = -math.inf if not _present(model, SLOW) else 0.0
    origin = min(model.clocks)
    return [
        Direction(
            owner="",
            label=f"clock {number}",
            model=model.with_clocks({**model.clocks, number: value + step}),
            step=1.0,
            lower=(lower - value) / step,
            unit=step,
            run=number,
        )
        for number, value in sorted(model.clocks.items())
        if number != origin
    ]


def _step_s(model: DriveModel) -> float:
    turns = [_period_s(model) / (2.0 * np.pi)] if _present(model, WAVES) else []
    slow = [model.parameters[f"{n}.time_constant_s"] for n in sorted(_present(model, SLOW))]
    return _STEP * float(min([*turns, *slow]))


def _period_s(model: DriveModel) -> float:
    return 1.0 / model.parameters["external_force.frequency_Hz"]


def moved_clocks(
    model: DriveModel, directions: Sequence[Direction], step: Sequence[float]
) -> dict[int, float]:
    """Start times after a step along directions."""
    clocks = dict(model.clocks)
    for direction, size in zip(directions, step, strict=True):
        if direction.run is not None:
            clocks[direction.run] += size * direction.unit
    return clocks


def merged_clocks(
    model: DriveModel, effect: str, values: Mapping[str, float], clocks: Mapping[int, float]
) -> Mapping[int, float]:
    """Start times for a candidate beside what a model holds: one clock serves both."""
    if not needs_clocks(model):
        return clocks
    if not clocks:
        return model.clocks
    if effect in WAVES:
        return _near(clocks, model.clocks, 1.0 / values["frequency_Hz"])
    return _near(model.clocks, clocks, _period_s(model)) if _present(model, WAVES) else clocks


def _near(
    phased: Mapping[int, float], wanted: Mapping[int, float], period_s: float
) -> dict[int, float]:
    """Times wanted, moved by less than a period to have the phases of others."""
    return {
        n: t + period_s * round((wanted.get(n, t) - t) / period_s)
        for n, t in sorted(phased.items())
    }


def first_guesses(model: DriveModel, record: Record) -> list[DriveModel]:
    """The model with times at which a run may have begun that the fit did not hold."""
    known = model.clocks.get(record.number)
    if known is None:
        # Runs for judging follow the others, unless each began anew.
        anew = not _present(model, SLOW) or len(set(model.clocks.values())) == 1
        known = record.begun_s if anew else max(model.clocks.values())
    if not _present(model, WAVES):
        return [model.with_clocks({**model.clocks, record.number: known})]
    return [
        model.with_clocks({**model.clocks, record.number: known + i * _period_s(model) / _PHASES})
        for i in range(_PHASES)
    ]
