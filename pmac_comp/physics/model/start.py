"""The state in which a run begins, as far as its captures tell it.

What lives here: the numbers that a simulation needs beside its command. What may not: how they are
read from captures (``resting``).
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Start:
    """How the loop of a run begins.

    Parameters
    ----------
    torque_Nm : float
        What the integrator holds, N m; 0 where it cannot be known.
    error_m : float
        By how much the motor is behind the command, m; 0 where the torque cannot be known.
    speed_m_per_s : float
        Speed of command and axis where a capture begins under way; 0 at rest.
    """

    torque_Nm: float = 0.0
    error_m: float = 0.0
    speed_m_per_s: float = 0.0


RELAXED = Start()
