"""One run of the compiled closed loop: from a parameter vector to the kernel and back.

What lives here: the grid of step matrices along the screw, the bounds of what the kernel takes, and
the check of what it gives. What may not: effects and names of parameters (``drive``) or equations
(``kernel``, which is loaded on use: compiling takes a while).
"""

import math

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.errors import ModelError, NonFinite
from pmac_comp.physics.model import slots as s

NODE_SPACING_m = 0.01
# Step matrices are tabulated this far beyond the command, as far as the screw goes.
_MARGIN_m = 0.02
_MAX_SUBSTEPS = 256
_HISTORY_CYCLES = 250  # of torque commands that the kernel keeps for the actuator delay


def run_loop(
    vector: FloatArray,
    n_sub: int,
    desired_m: FloatArray,
    torque_Nm: FloatArray,
    force_N: FloatArray,
    rows: FloatArray,
    values: FloatArray,
    origin_s: float,
) -> FloatArray:
    """Signals of a run, shape (7, n): readings, torques, nut force, and unrounded positions.

    Parameters
    ----------
    vector : ndarray, shape (N_SLOTS,)
        Parameters in the layout of the kernel.
    n_sub : int
        Substeps per servo period.
    desired_m, torque_Nm, force_N : ndarray, shape (n,)
        Desired position, torque feed-forward and force on the table, one per servo period.
    rows, values : ndarray
        Packed table terms.
    origin_s : float
        Time of the first sample.

    Raises
    ------
    ModelError
        Impossible substeps, or a delay longer than the kernel keeps torque for.
    NonFinite
        The loop became unstable.
    """
    from pmac_comp.physics.model import kernel, kernel_chain

    if not 1 <= n_sub <= _MAX_SUBSTEPS:
        raise ModelError(
            f"{n_sub} substeps are not possible; 1 to {_MAX_SUBSTEPS} are.",
            code="PC-MOD-015",
            hint="Give none: the model knows how many its effects ask for.",
        )
    period = vector[s.PERIOD]
    if vector[s.DELAY] > _HISTORY_CYCLES * period:
        raise ModelError(
            f"An actuator delay of {vector[s.DELAY]:g} s is longer than {_HISTORY_CYCLES} cycles.",
            code="PC-MOD-010",
            hint="Correct actuator_delay_us in the bench file, or the delay of the model.",
        )
    first, n_nodes = _nodes(vector, float(desired_m.min()), float(desired_m.max()))
    bank = kernel_chain.step_bank(vector, first, NODE_SPACING_m, n_nodes, period / n_sub)
    out = np.zeros((7, desired_m.size))
    done = kernel.run(
        vector, bank, first, NODE_SPACING_m, n_sub, desired_m, torque_Nm, force_N, rows, values,
        origin_s, out,
    )  # fmt: skip
    if done < desired_m.size or not np.all(np.isfinite(out)):
        raise NonFinite(
            f"The simulated loop became unstable at sample {done}.",
            code="PC-MOD-011",
            hint="Check gains, delay and the parameters of the model.",
            context={"index": int(done)},
        )
    return out


def _nodes(vector: FloatArray, low_m: float, high_m: float) -> tuple[float, int]:
    """First node (a multiple of the spacing) and number of nodes along the screw."""
    if vector[s.RIGID] > 0.5:
        return 0.0, 1
    origin, length = vector[s.X_ORIGIN], vector[s.LENGTH]
    low = min(max(low_m + origin - _MARGIN_m, 0.0), length)
    high = min(max(high_m + origin + _MARGIN_m, 0.0), length)
    start = math.floor(low / NODE_SPACING_m)
    stop = math.ceil(high / NODE_SPACING_m)
    return start * NODE_SPACING_m, max(stop - start + 1, 2)
