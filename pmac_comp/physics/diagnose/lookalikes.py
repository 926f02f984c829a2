"""Look-alikes: which effects leave the same trace, and the run that tells them apart.

What lives here: groups and experiments. The effects' own words come from the library. May import
``physics.model`` and ``result``.
"""

from collections.abc import Iterable, Mapping

from pmac_comp.physics.diagnose.result import SeparatingExperiment
from pmac_comp.physics.model.effect import Effect

# Exact twins: no run of this axis alone separates them (both are one slope of the scale reading).
_TWINS = (frozenset({"lead_linear", "scale_slope"}),)

# Groups that ordinary data may fail to separate (ball-screw facts, section 3).
_GROUPS = (
    frozenset({"bias_force", "friction_asymmetry"}),
    frozenset({"encoder_eccentricity", "lead_cyclic"}),
    frozenset({"actuator_delay", "current_bandwidth"}),
    frozenset({"backlash", "preload_loss"}),
    frozenset({"channel_skew", "viscous"}),
    *_TWINS,
)

# Motions in the words of the capture command's campaign, per pair.
_EXPERIMENTS: Mapping[frozenset[str], tuple[str, tuple[str, ...]]] = {
    frozenset({"lead_linear", "scale_slope"}): (
        "Measure the table against a laser or a second scale, or repeat the slow map at another "
        "temperature: the slope of a scale grows 8-11 um/m per K, that of the screw with the "
        "screw's own temperature. No motion of this axis alone separates them.",
        ("staircase over the whole travel, cold", "staircase over the whole travel, warm"),
    ),
    frozenset({"bias_force", "friction_asymmetry"}): (
        "Run a speed staircase in both directions: a bias shifts the torque by the same amount "
        "at every speed, an asymmetry grows with speed.",
        ("speed_staircase 1-300 mm/s both directions",),
    ),
    frozenset({"encoder_eccentricity", "lead_cyclic"}): (
        "Run the same stroke slowly and at several revolutions per second: an eccentric encoder "
        "moves the motor through the servo and fades above the bandwidth, lead does not. Or turn "
        "the encoder on its shaft by 180 degrees: only the eccentricity turns with it.",
        ("triangle 2 mm/s over 3 revolutions", "triangle 300 mm/s over the travel"),
    ),
    frozenset({"actuator_delay", "current_bandwidth"}): (
        "Excite torque to 400 Hz: the phase of a delay grows in proportion to frequency, that of "
        "a current loop levels off.",
        ("chirp 5-400 Hz, small amplitude",),
    ),
    frozenset({"backlash", "preload_loss"}): (
        "Push the table by the loading screws at standstill, both ways and in steps: a gap gives "
        "way without force, a lost preload with a lower stiffness.",
        ("standstill load steps -500 to 500 N", "nested_reversals 5-100 um"),
    ),
    frozenset({"channel_skew", "viscous"}): (
        "Repeat one sinusoid at both ends of the travel: viscous deformation grows along the "
        "screw, skew does not. Or swap the latch order of the two channels.",
        ("sinusoid 25 mm 2 Hz near the bearing", "sinusoid 25 mm 2 Hz far from the bearing"),
    ),
}


def alike(one: str, other: str, library: Mapping[str, Effect]) -> bool:
    """Whether two effects are known to leave similar traces."""
    pair = {one, other}
    if any(pair <= group for group in _GROUPS):
        return True
    return any(
        name in library and (pair - {name}) <= set(library[name].look_alikes) for name in pair
    )


def exact_twins(name: str, library: Mapping[str, Effect]) -> tuple[str, ...]:
    """Effects of the library that no data separates from this one."""
    return tuple(
        sorted(t for group in _TWINS if name in group for t in group - {name} if t in library)
    )


def separating_experiment(
    effects: Iterable[str], library: Mapping[str, Effect]
) -> SeparatingExperiment:
    """The run that would tell the effects apart.

    Parameters
    ----------
    effects : iterable of str
        A group of look-alikes.
    library : Mapping of str to Effect
        Effects with their own experiments.

    Returns
    -------
    SeparatingExperiment
        The pair's own experiment where there is one, else those of the effects.
    """
    group = tuple(dict.fromkeys(effects))
    for pair, (text, motions) in _EXPERIMENTS.items():
        if pair <= set(group):
            return SeparatingExperiment(group, text, motions)
    words = [f"{name}: {library[name].separating_experiment}" for name in group if name in library]
    return SeparatingExperiment(group, "; ".join(words))
