"""One move as pulses of acceleration: trapezoids, or steps where the jerk is not limited.

What lives here: closed forms of a single move. What may not: sampling, places, sequences.
"""

import math

Piece = tuple[float, float, float]  # duration in s, jerk in m/s3, first acceleration in m/s2


def move_pieces(
    move_m: float, speed_m_per_s: float, acceleration_m_per_s2: float, rise_s: float
) -> list[Piece]:
    """Pieces of constant jerk of a move from rest to rest.

    Parameters
    ----------
    move_m : float
        Signed distance in m; 0 gives no pieces.
    speed_m_per_s, acceleration_m_per_s2 : float
        Limits, positive.
    rise_s : float
        Rise time of the acceleration in s; 0 means that it steps.
    """
    if move_m == 0.0:
        return []
    top = min(speed_m_per_s, _reachable_speed(abs(move_m), acceleration_m_per_s2, rise_s))
    up = _pulse(math.copysign(top, move_m), acceleration_m_per_s2, rise_s)
    down = [(duration, -jerk, -level) for duration, jerk, level in up]
    accelerating = sum(duration for duration, _, _ in up)
    cruise = max(0.0, abs(move_m) / top - accelerating)
    return [*up, (cruise, 0.0, 0.0), *down]


def _pulse(speed: float, acceleration: float, rise: float) -> list[Piece]:
    """Acceleration pulse that changes the speed by ``speed`` (signed)."""
    sign = math.copysign(1.0, speed)
    if rise <= 0.0:
        return [(abs(speed) / acceleration, 0.0, sign * acceleration)]
    peak = min(acceleration, abs(speed) / rise)
    flat = abs(speed) / peak - rise
    jerk = sign * peak / rise
    return [(rise, jerk, 0.0), (max(flat, 0.0), 0.0, sign * peak), (rise, -jerk, sign * peak)]


def _reachable_speed(distance: float, acceleration: float, rise: float) -> float:
    """Largest speed of a move without cruise: distance = v (duration of one pulse)."""
    # With a flat top the pulse lasts v/a + rise; without one 2 rise, at v = distance / (2 rise).
    with_top = 0.5 * acceleration * (-rise + math.sqrt(rise**2 + 4.0 * distance / acceleration))
    if rise > 0.0 and with_top < acceleration * rise:
        return distance / (2.0 * rise)
    return with_top
