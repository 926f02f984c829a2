"""Sentences for a person: what was found, how much it is worth, what it could be instead.

What lives here: text only. May import ``result`` and ``remainder``.
"""

from collections.abc import Sequence

from pmac_comp.physics.diagnose.localise import Region
from pmac_comp.physics.diagnose.records import Gap
from pmac_comp.physics.diagnose.remainder import Remainder
from pmac_comp.physics.diagnose.result import Estimate


def statements_of(
    verdict: str,
    named: Sequence[str],
    tied: Sequence[Sequence[str]],
    estimates: Sequence[Estimate],
    where: Sequence[Region],
    before: Gap,
    after: Gap,
    left: Remainder,
) -> tuple[str, ...]:
    """Sentences in the order in which a person asks: what, how sure, where, what is left."""
    said = [_headline(verdict, named, tied, left)]
    said += [f"{e.name} = {e.value:.4g} +/- {1.96 * e.std:.2g} {e.unit} (95 %)" for e in estimates]
    said.append(
        f"The gap on runs not used for fitting goes from {before.position_um:.3g} to "
        f"{after.position_um:.3g} um rms; the noise floor is {left.noise_floor_um:.3g} um."
    )
    if before.torque_Nm is not None and after.torque_Nm is not None:
        said.append(
            f"The torque gap goes from {before.torque_Nm:.3g} to {after.torque_Nm:.3g} N m rms."
        )
    said += [f"Base model: {region.describe()}." for region in where[:2]]
    if left.visible:
        said += [f"Left: {region.describe()}." for region in left.regions[:3]]
    return tuple(said)


def _headline(
    verdict: str, named: Sequence[str], tied: Sequence[Sequence[str]], left: Remainder
) -> str:
    if verdict == "none":
        return "Nothing is missing that these runs can show: what is left is noise."
    found = f"Found: {', '.join(named)}." if named else "No effect of the library explains it."
    if verdict == "unknown":
        return (
            f"{found} Something without a name is left, {left.excess_um:.3g} um rms beyond the "
            "noise."
        )
    if tied:
        groups = "; ".join(" or ".join(group) for group in tied)
        return f"{found} These runs cannot separate {groups}."
    return found
