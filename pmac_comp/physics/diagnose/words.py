"""Sentences for a person: what was seen, its cause and size, what it is worth, what it is not.

What lives here: text only. May import ``result`` and ``remainder``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from pmac_comp.physics.diagnose.localise import Region
from pmac_comp.physics.diagnose.records import Gap
from pmac_comp.physics.diagnose.remainder import Remainder
from pmac_comp.physics.diagnose.result import Estimate
from pmac_comp.physics.identify.result import Z95
from pmac_comp.physics.model.effect import Effect

# Share of the time, and of the gap, from which on what is left out is told.
_TOLD = 0.002
_LESS = 0.8
_CLEARLY = 1.5  # times the noise floor
_OPEN = 0.6  # of a gap: what other values of known parameters close more of, they leave open
_UNCHANGED = 0.97  # of a gap: what closes less of it does not live there


@dataclass(frozen=True)
class Rival:
    """A look-alike that lost: by a paired test of full refits, or already in the screening.

    Parameters
    ----------
    name : str
        Effect.
    p_value : float or None
        That the winner is better by chance; None if the screening left it out.
    share : float
        Gain as a share of the winner's.
    """

    name: str
    p_value: float | None
    share: float

    def describe(self) -> str:
        """Name with its evidence."""
        if self.p_value is not None:
            return f"{self.name} (p {self.p_value:.1g})"
        return f"{self.name} (earns {100 * max(self.share, 0.0):.0f} % as much)"


@dataclass(frozen=True)
class Story:
    """What there is to tell.

    Parameters
    ----------
    verdict : str
        One of the four verdicts.
    named, tied : sequences
        As in the result.
    estimates : sequence of Estimate
        Parameters of the named effects.
    where : sequence of Region
        Where the base model disagrees.
    before, after : Gap
        On runs that judge.
    left : Remainder
        What is left.
    rivals : sequence of Rival
        Look-alikes that are ruled out.
    library : Mapping of str to Effect
        Effects with their own words.
    withheld : Mapping of str to str
        Effects that close some of the gap and are not claimed, and why.
    alone : bool
        Whether sizes are those with the named effects alone, as others are not claimed.
    restated : str
        The one quantity of the bench file that does in place of effects, in words.
    forms : sequence of str
        Effects as the grown model has them, ``effect`` or ``effect@place``.
    """

    verdict: str
    named: Sequence[str]
    tied: Sequence[Sequence[str]]
    estimates: Sequence[Estimate]
    where: Sequence[Region]
    before: Gap
    after: Gap
    left: Remainder
    rivals: Sequence[Rival]
    library: Mapping[str, Effect]
    withheld: Mapping[str, str]
    alone: bool = False
    restated: str = ""
    forms: Sequence[str] = ()


def statements_of(story: Story) -> tuple[str, ...]:
    """Sentences in the order in which a person asks: what, how large, how sure, what is left."""
    said = [f"Seen: {region.describe()}." for region in story.where[:2] if story.verdict != "none"]
    said.append(_headline(story))
    said += [_cause(name, story) for name in story.named]
    said += [
        f"{name} closes some of it and is not claimed: {why}."
        for name, why in story.withheld.items()
    ]
    if story.alone:
        said.append(
            "The sizes are those with the named effects alone; what is not claimed would share in "
            "them."
        )
    said.append(_worth(story))
    said += _rests(story)
    torque = _torque(story)
    if torque is not None and not _in_torque(story):
        said.append(f"The torque gap goes from {torque[0]:.3g} to {torque[1]:.3g} N m rms.")
    times = story.after.position_um / max(story.left.noise_floor_um, 1e-12)
    if story.verdict != "none" and times > _CLEARLY and not story.left.unexplained:
        said.append(
            f"What is left is {times:.2g} times the noise floor, most of it no more than how "
            "friction sets in or a fit to those runs as well leaves open."
        )
    if story.left.visible:
        proved = story.left.unexplained or bool(story.named)
        word = "Left" if proved else "Not proved beyond noise"
        said += [f"{word}: {region.describe()}." for region in story.left.regions[:3]]
    return tuple(said)


def _headline(story: Story) -> str:
    if story.verdict == "none":
        return f"Nothing is missing that these runs can show: {_nothing(story)}."
    found = "No effect of the library explains it."
    if story.named:
        found = f"Found: {names_in_words(story.named, story.tied)}."
    if story.restated:
        found = f"One quantity of the bench file does as well as any effects: {story.restated}."
    if story.tied:
        groups = "; ".join(" or ".join(group) for group in story.tied)
        found = f"{found} These runs cannot separate {groups}."
    if story.verdict == "unknown" and story.left.unexplained:
        return (
            f"{found} Something without a name is left, {story.left.excess_um:.3g} um rms beyond "
            "the noise."
        )
    return found


def names_in_words(named: Sequence[str], tied: Sequence[Sequence[str]]) -> str:
    """Names found, look-alikes of one group joined by ``or``: one of them is there, not each."""
    group_of = {name: tuple(group) for group in tied for name in group}
    groups = dict.fromkeys(group_of.get(name, (name,)) for name in named)
    return ", ".join(" or ".join(group) for group in groups)


def _nothing(story: Story) -> str:
    """What is left where nothing is missing: noise, or more than repeats would leave."""
    times = story.after.position_um / max(story.left.noise_floor_um, 1e-12)
    if times < _CLEARLY and not story.left.visible:
        if not story.where:
            return "what is left is noise"
        first = story.where[0]
        seen = f"{first.channel} residual over {first.coordinate.replace('_', ' ')}"
        unit = f" {first.unit}" if first.unit else ""
        return (
            f"what is left is {times:.2g} times the noise floor, and what repeats in it (the {seen}"
            f", at most {first.size_um:.2g} um, between {first.low:.4g} and {first.high:.4g}{unit})"
            " is too little of it for a name"
        )
    settled_um = story.left.settled_um
    if times > _CLEARLY and settled_um < _OPEN * story.after.position_um:
        return (
            f"what is left is {times:.2g} times the noise floor, but {settled_um:.3g} um where the "
            "runs that judge are fitted as well: the others leave parameters open, and what these "
            "runs can show is little; more of them, in both directions, would tell more"
        )
    return (
        f"what is left is {times:.2g} times the noise floor, and no effect or smooth function of "
        "the motion foretells it on other runs (how friction sets in at stops and how the floor "
        "differs between motions are open to that extent)"
    )


def _cause(name: str, story: Story) -> str:
    """Where it acts, the trace it leaves and its size."""
    effect = story.library.get(name)
    sizes = ", ".join(_size(e) for e in story.estimates if e.name.partition(".")[0] == name)
    seen = f" ({effect.where}: {effect.signature})" if effect is not None else ""
    # Where an effect may act at several places, or beyond a corner or within, sizes are of one.
    form = next((f for f in story.forms if f.startswith(f"{name}@")), "")
    chosen = f", in the grown model as {form}" if form else ""
    return f"{name}{seen}{chosen}: {sizes} (95 %)." if sizes else f"{name}{seen}{chosen}."


def _size(estimate: Estimate) -> str:
    bare = estimate.name.partition(".")[2]
    unit = "" if estimate.unit == "1" else f" {estimate.unit}"
    if Z95 * estimate.std > abs(estimate.value) and not bare.startswith("phase"):
        return f"{bare} is not determined by these runs"
    return f"{bare} = {estimate.value:.4g} +/- {Z95 * estimate.std:.2g}{unit}"


def _rests(story: Story) -> list[str]:
    """What the gap is apart from moments that no model foretells, where those make much of it."""
    calm = story.left.calm
    if calm.left_out < _TOLD or calm.after_um > _LESS * story.after.position_um:
        return []
    start = f"falls from {calm.before_um:.3g} to" if story.named else "is"
    return [
        f"In {100 * calm.left_out:.0f} % of that time the axis rests within its friction or has "
        "just left it: how it creeps there depends on fractions of a count of its encoder and is "
        f"no evidence. Without that time the gap {start} {calm.after_um:.3g} um rms; the "
        f"noise floor is {calm.floor_um:.3g} um."
    ]


def _torque(story: Story) -> tuple[float, float] | None:
    """Gap of the torque before and after, where there is one and something is named."""
    before, after = story.before.torque_Nm, story.after.torque_Nm
    return (before, after) if story.named and before is not None and after is not None else None


def _in_torque(story: Story) -> bool:
    """Whether what is named closes a gap of the torque and hardly one of positions."""
    torque = _torque(story)
    still = story.after.position_um > _UNCHANGED * story.before.position_um
    return torque is not None and still and torque[1] < _UNCHANGED * torque[0]


def _worth(story: Story) -> str:
    before, after = story.before.position_um, story.after.position_um
    floor = f"the noise floor is {story.left.noise_floor_um:.3g} um"
    if not story.named:
        return f"The gap on runs not used for fitting is {after:.3g} um rms; {floor}."
    text = (
        f"With it the gap falls from {before:.3g} to {after:.3g} um rms on runs not used for "
        f"fitting; {floor}"
    )
    torque = _torque(story)
    if torque is not None and _in_torque(story):
        text = (
            f"It lives in the torque, whose gap falls from {torque[0]:.3g} to {torque[1]:.3g} N m "
            "rms on runs not used for fitting; positions hardly show it, their gap is "
            f"{before:.3g} um rms before and {after:.3g} after, and {floor}"
        )
    if story.rivals:
        text += f"; look-alikes ruled out: {', '.join(r.describe() for r in story.rivals)}"
    return f"{text}."
