"""A gap in the nut that the runs show and the model does not hold: taken up, and said.

What lives here: when it is looked for, how the compensation file keeps it, the words for people.
What may not: the fit (``physics.compensate.clearance``).
"""

from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from pmac_comp.base.units import UM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.compensate.clearance import Clearance, measured_clearance, with_clearance
from pmac_comp.physics.compensate.grip import gripping_model
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.compensate.ripple import RIPPLE
from pmac_comp.workflow.law.dynamic_law import nut_gap, without_fed_forward
from pmac_comp.workflow.law.static_map import bench_map

if TYPE_CHECKING:
    from pmac_comp.physics.model.drive import DriveModel

_KEY = "clearance"


def found_clearance(
    bench: Bench, model: "DriveModel", slow: Sequence[Capture], captures: Sequence[Capture]
) -> Clearance | None:
    """Gap that slow and fast runs together show beyond the model; None without fast runs."""
    if not captures:
        return None
    lead = bench_map(bench, slow) if slow else None
    return measured_clearance(without_fed_forward(model, but=RIPPLE), (*captures, *slow), lead)


def clearance_note(clearance: Clearance | None) -> dict[str, Any]:
    """What the law keeps of it in its provenance."""
    return {} if clearance is None else {_KEY: asdict(clearance)}


def loosened(model: "DriveModel", law: CompensationLaw | None) -> "DriveModel":
    """The model that a law was made with: with the gap and the grip that the runs showed."""
    if law is None:
        return model
    model = gripping_model(model, law)
    noted = law.provenance.get(_KEY)
    if noted is None or nut_gap(model) is not None:
        return model
    return with_clearance(model, noted["values"])


def clearance_remarks(law: CompensationLaw) -> list[str]:
    """What was found and what it is not, for people."""
    noted = law.provenance.get(_KEY)
    if noted is None:
        return []
    found = Clearance(**noted)
    like = "of a nut that is soft around zero force" if found.is_soft else "as a gap does"
    pressed = f", pressed to one side by {found.load_N:+.0f} N" if found.load_N != 0.0 else ""
    return [
        f"slow and fast runs show a lost motion of {found.gap_m * UM_PER_M:.2f} um that turns with "
        f"the force in the nut{pressed}, {like}, and that the model does not hold: with it "
        f"{found.with_um:.2f} um rms of the mechanical error of the runs stay, without it "
        f"{found.without_um:.2f}. The law takes it up; `pmac-comp diagnose` tells what it is"
    ]


def flank_remarks(law: CompensationLaw) -> list[str]:
    """At which accelerations a nut changes its flank: what a law knows least, for people."""
    if law.gap_half_m == 0.0 or law.inertia_s2 <= 0.0:
        return []
    return [*_loaded_flank(law), *_flank_by_speed(law)]


def _loaded_flank(law: CompensationLaw) -> list[str]:
    """Where load and friction let the nut change its flank."""
    if law.gap_load_m == 0.0:
        return []
    load, friction = abs(law.gap_load_m), abs(law.coulomb_m)
    against = -1.0 if law.gap_load_m > 0.0 else 1.0
    edges = [edge for edge in (load - friction, load + friction) if edge > 0.0]
    at = " and ".join(f"{against * edge / law.inertia_s2:+.2f}" for edge in edges)
    return [
        f"the load on the nut and friction let it change its flank at accelerations of {at} m/s2. "
        "On a motion whose peak comes within a tenth of that the law may take the gap up where the "
        "drive does not, or not where it does, and leave a part of the gap as error: `pmac-comp "
        "verify` such a motion before you rely on it, or accelerate a little more or less"
    ]


def _flank_by_speed(law: CompensationLaw) -> list[str]:
    """Where friction that is higher near standstill moves the flank with the speed.

    In simulation with 3 and 5 um of play, with and without a load, sinusoids of 10 to 25 mm with
    such peaks kept 1.8 to 3.5 times the aim, also in the model that the law was made with.
    """
    if law.stribeck_m <= 0.0:
        return []
    load, fast, slow = abs(law.gap_load_m), law.coulomb_m, law.coulomb_m + law.stribeck_m
    ranges = {_sizes(load + way * fast, load + way * slow) for way in (-1.0, 1.0)}
    between = " and ".join(
        f"from {low / law.inertia_s2:.2f} to {high / law.inertia_s2:.2f}"
        for low, high in sorted(ranges)
    )
    return [
        "beside the gap, friction that is higher near standstill moves the nut from flank to flank "
        f"with the speed: of slow motions whose peak acceleration lies {between} m/s2 the law may "
        "leave two to four times what it leaves of others. `pmac-comp verify` such a motion before "
        "you rely on it, or accelerate more"
    ]


def _sizes(one: float, other: float) -> tuple[float, float]:
    """Smallest and largest size of what lies between two values, on either side of 0 or on both."""
    small, large = sorted((abs(one), abs(other)))
    return (small if one * other > 0.0 else 0.0), large
