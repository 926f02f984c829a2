"""Closed loop of a drive model, as the compensations are computed and promised in it.

What lives here: the loop as a function of command, desired position and torque; what of a model
goes by the place alone and is therefore no part of it; the constant load that its integrator holds.
What may not: the law and its fit (``design``), captures, controllers.

All that this package computes it computes in such a loop: what a law leaves (``design``), what
captures have beyond the model (``grip``, ``ripple``, ``constant``, ``trim``, ``clearance``), what
is promised (``promise``).
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from pmac_comp.base.arrays import FloatArray
from pmac_comp.physics.compensate.lead import LeadWave
from pmac_comp.physics.model.start import Start

if TYPE_CHECKING:
    from pmac_comp.physics.model.drive import DriveModel

# What goes by the place of the table alone. A cable pulls on the screw as a lead error does, and
# tables take that; its torque the law has from the captures.
STATIC_EFFECTS = frozenset(
    {
        "cable_drag",
        "lead_linear",
        "lead_cyclic",
        "thermal_growth",
        "encoder_eccentricity",
        "scale_subdivision",
        "scale_slope",
    }
)


@dataclass(frozen=True)
class LoopSignals:
    """Positions in m and the controller's torque in N m of one simulation; shape (n,) each."""

    motor_position_m: FloatArray
    table_position_m: FloatArray
    torque_Nm: FloatArray


class LoopRunner(Protocol):
    """Closed loop of a drive at rest that is given a command; all arrays of shape (n,)."""

    def __call__(
        self,
        commanded_m: FloatArray,
        desired_m: FloatArray | None,
        added_Nm: FloatArray | None,
        resting_Nm: float = 0.0,
        /,
    ) -> LoopSignals:
        """Positions and torque along a command, one sample per servo period.

        Parameters
        ----------
        commanded_m : ndarray, shape (n,)
            Trajectory in m.
        desired_m : ndarray, shape (n,), or None
            Trajectory with the correction in m, which the controller follows; None for none.
        added_Nm : ndarray, shape (n,), or None
            Torque in N m that is added to the controller's output; None for none.
        resting_Nm : float
            Torque in N m that friction held before, beside what holds the constant load.
        """
        ...


def model_loop(model: "DriveModel", wave: LeadWave | None = None) -> LoopRunner:
    """Closed loop of a drive model's dynamics on exact positions.

    Parameters
    ----------
    model : DriveModel
        The drive; what goes by the place of its table alone is left out.
    wave : LeadWave or None
        Wobble of the lead, which shakes the drive. The table of the signals is then that beside the
        wobble's own place: what stays is what the table does because it cannot follow.

    Raises
    ------
    NonFinite
        Of the loop: it became unstable.
    """
    return _loop(model, wave, quantise=False)


def counted_loop(model: "DriveModel", wave: LeadWave | None = None) -> LoopRunner:
    """The same loop fed with counts of encoder and scale; its positions are those before rounding.

    An encoder with 1/T extension resolves so finely that nothing is rounded.
    """
    return _loop(model, wave, quantise=model.bench.encoder.extension == "none")


def _loop(model: "DriveModel", wave: LeadWave | None, *, quantise: bool) -> LoopRunner:
    from pmac_comp.physics.model.drive import simulate

    dynamic, held_Nm = _dynamic_model(model, wave), load_torque_Nm(model)

    def run(
        commanded_m: FloatArray,
        desired_m: FloatArray | None,
        added_Nm: FloatArray | None,
        resting_Nm: float = 0.0,
        /,
    ) -> LoopSignals:
        found = simulate(
            dynamic,
            commanded_m,
            desired_position_m=desired_m,
            torque_feedforward_Nm=_beside_load(added_Nm, held_Nm),
            start=Start(held_Nm + resting_Nm),
            quantise=quantise,
        )
        table_m = found.true_table_position_m
        if wave is not None:
            table_m = table_m - wave.at(commanded_m)
        return LoopSignals(found.true_motor_position_m, table_m, found.torque_command_Nm)

    return run


def without_static(model: "DriveModel") -> "DriveModel":
    """The model without what goes by place, which the lead table takes away, not the law."""
    from pmac_comp.physics.model.effect import split_name

    for name in model.effects:
        if split_name(name)[0] in STATIC_EFFECTS:
            model = model.without_effect(name)
    return model


def _dynamic_model(model: "DriveModel", wave: LeadWave | None) -> "DriveModel":
    """The model whose lead has no error but a wobble."""
    dynamic = without_static(model)
    if wave is None:
        return dynamic
    values = {
        "amplitude_m": wave.amplitude_m,
        "order_per_rev": float(wave.order),
        "phase_rad": wave.phase_rad,
    }
    return dynamic.with_effect("lead_cyclic", values)


def constant_load_N(model: "DriveModel") -> float:
    """Constant load on the table of a model in N; positive resists positive motion."""
    return model.parameters["bias_force.force_N"] if "bias_force" in model.effects else 0.0


def load_torque_Nm(model: "DriveModel") -> float:
    """Torque in N m that holds the constant load of a model."""
    return constant_load_N(model) * model.bench.lead_m_per_rad


def _beside_load(torque_Nm: FloatArray | None, load_Nm: float) -> FloatArray | None:
    """Torque added to a loop whose integrator holds the load at first, in N m, shape (n,).

    It is less by what of the load it sends itself; None stays None.
    """
    if torque_Nm is None or load_Nm == 0.0:
        return torque_Nm
    return torque_Nm - min(max(float(torque_Nm[0]), min(load_Nm, 0.0)), max(load_Nm, 0.0))
