"""Captures of a drive in which an effect is hidden, made by the simulated plant alone.

Nothing of ``pmac_comp.physics`` may be imported here: the code that makes the data shares nothing
with the model that is fitted to it. Each case draws its bench within the tolerances of the bench
file, its motions, the zero and jitter of its scale and a random force on its table; the effect is
scaled until it is a given multiple of the noise after a refit of the base (``sizing``).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pmac_comp.files.bench import Bench
from pmac_comp.files.capture import Capture
from pmac_comp.simulator.plant.ballscrew import BallscrewPlant
from pmac_comp.simulator.servo.closed_loop import closed_loop_capture
from tests.generators.effects import EFFECTS, Values, truth_of
from tests.generators.motions import Command, campaign, judging_campaign
from tests.generators.sizing import (
    Sizing,
    Surroundings,
    drive,
    fine_scale,
    jittered,
    random_force,
    sized,
)

_MOST_JITTER_um = 0.15
_MOST_FORCE_N = 1.0
_MOST_ZERO_um = 100.0  # an index pulse of the scale and one of the encoder do not know each other


@dataclass(frozen=True)
class Case:
    """Captures for fitting and judging, and what was hidden in them.

    Parameters
    ----------
    hidden : Mapping
        Values of the hidden effects as the plant takes them.
    truth : Mapping
        The same under the names of the diagnosis' parameters.
    ratios : Mapping
        Effect over noise after a refit of the base, per effect; empty where it was not asked for.
    noise_um : float
        Rms of the noise at the judging tables; 0 where it was not asked for.
    fit, judge : list of Capture
        Runs.
    seed : int
        Draws everything.
    """

    hidden: Mapping[str, Values]
    truth: Mapping[str, Mapping[str, float]]
    ratios: Mapping[str, float]
    noise_um: float
    fit: list[Capture]
    judge: list[Capture]
    seed: int


def surroundings(seed: int, spread: float, *, quiet: bool) -> Surroundings:
    """Noise of a case beside quantisation."""
    if quiet:
        return Surroundings(seed, spread)
    rng = np.random.default_rng([seed, 4])
    return Surroundings(
        seed,
        spread,
        float(rng.uniform(0.0, _MOST_JITTER_um)),
        float(rng.uniform(0.0, _MOST_FORCE_N)),
    )


def make_case(
    bench: Bench,
    effects: Sequence[str],
    *,
    seed: int,
    strength: float = 1.0,
    over_noise: Sequence[float] | None = None,
    seconds: float = 10.0,
    spread: float = 1.0,
    quiet: bool = False,
) -> Case:
    """A bench within its tolerances with the named effects hidden.

    Parameters
    ----------
    bench : Bench
        The bench file.
    effects : sequence of str
        What to hide; empty for a clean case.
    seed : int
        Draws everything.
    strength : float
        Size, where ``over_noise`` does not say it.
    over_noise : sequence of float or None
        Wanted effect over noise after a refit of the base, per effect; empty measures the noise
        of a clean case.
    seconds : float
        Length of each capture.
    spread : float
        Share of the tolerances that is used.
    quiet : bool
        Quantisation alone, no jitter and no random force.
    """
    around = surroundings(seed, spread, quiet=quiet)
    fit, judge = (
        campaign(bench, seed, seconds=seconds),
        judging_campaign(bench, seed, seconds=seconds),
    )
    rng = np.random.default_rng([seed, 3])
    hidden: dict[str, Values] = {}
    ratios: dict[str, float] = {}
    noise_um = 0.0
    if over_noise is not None:
        sizing = Sizing(bench, around, fit, judge)
        noise_um = sizing.noise_um
        for name, target in zip(effects, over_noise, strict=True):
            hidden[name], ratios[name] = sized(sizing, name, seed, bench, target)
    else:
        hidden = {name: EFFECTS[name](rng, strength, bench) for name in effects}
    plant = drive(bench, around, hidden)
    base = drive(bench, around, {})
    zero_m = 1e-6 * float(np.random.default_rng([seed, 5]).uniform(-_MOST_ZERO_um, _MOST_ZERO_um))
    captures = _captures(bench, plant, around, [*fit, *judge], zero_m)
    damping = base.truth.damping_time_us
    return Case(
        hidden,
        {n: truth_of(n, v, damping_time_us=damping) for n, v in hidden.items()},
        ratios,
        noise_um,
        captures[: len(fit)],
        captures[len(fit) :],
        seed,
    )


def _captures(
    bench: Bench,
    plant: BallscrewPlant,
    around: Surroundings,
    commands: Sequence[Command],
    zero_m: float,
) -> list[Capture]:
    step = bench.scale_resolution_m or 1e-9
    fine = fine_scale(bench)
    made = []
    for run, command in enumerate(commands):
        push = random_force(around, run, command.size, bench.servo_period_s)
        capture = closed_loop_capture(fine, plant, command, external_force_N=push)
        assert capture.table_position_m is not None
        table = jittered(around, run, capture.table_position_m + zero_m, step)
        made.append(replace(capture, table_position_m=table))
    return made
