"""Blended moves of motion programs as polynomial segments.

What lives here: LINEAR blending with TA and TS, PVT, SPLINE1, dwells, for all motors of a
coordinate system at once. What may not: the program language, the memory of the card.

Positions are motor units (1/(32 Ixx08) count), times servo cycles at 100 %. All motors get segments
of the same durations. In LINEAR mode a move is known to the queue only when its successor is known,
because the corner between them belongs to both.

Source: Turbo PMAC Software Reference Manual p. 433-434, 463, 472-477.
"""

from __future__ import annotations

from dataclasses import dataclass

from pmac_comp.simulator.servo.trajectory import DWELL, REAL_TIME, TIMED, Segment

Segments = dict[int, list[Segment]]
_TINY = 1e-9


@dataclass(frozen=True)
class LinearMove:
    """One LINEAR move.

    Parameters
    ----------
    end : dict of int to float
        Motor positions at its end.
    velocity : dict of int to float
        Motor units per cycle.
    cycles : float
        Move time.
    ramp_cycles, s_cycles : float
        Acceleration time and S part at its start.
    tag : int
        Reported when its first segment starts.
    """

    end: dict[int, float]
    velocity: dict[int, float]
    cycles: float
    ramp_cycles: float
    s_cycles: float
    tag: int


class Planner:
    """Turns moves into segments; ``position`` is where everything planned so far ends."""

    def __init__(self, start: dict[int, float]) -> None:
        self.position = dict(start)
        self._pending: LinearMove | None = None
        self._lead_in = 0.0  # half of the ramp already spent in the pending move
        self._controls: dict[int, list[float]] = {}
        self._spline_cycles = 0.0

    def copy(self) -> Planner:
        """The same plan, to go back to."""
        twin = Planner(self.position)
        twin._pending, twin._lead_in = self._pending, self._lead_in
        twin._controls = {motor: list(c) for motor, c in self._controls.items()}
        twin._spline_cycles = self._spline_cycles
        return twin

    @property
    def motors(self) -> tuple[int, ...]:
        """Motors that are planned for."""
        return tuple(self.position)

    @property
    def blending(self) -> bool:
        """Whether a move waits for its successor."""
        return self._pending is not None or bool(self._controls)

    @property
    def end(self) -> dict[int, float]:
        """Where the last move ends, planned or waiting."""
        if self._pending is not None:
            return dict(self._pending.end)
        if self._controls:
            return {m: c[-1] for m, c in self._controls.items()}
        return dict(self.position)

    # --- LINEAR ---------------------------------------------------------------------------------

    def linear(self, move: LinearMove) -> Segments:
        """Add a LINEAR move; segments of what is settled by it."""
        out: Segments = {m: [] for m in self.motors}
        if self._controls:
            join(out, self.finish())
        previous = self._pending
        ramp = self._ramp(previous, move)
        if previous is not None:
            join(out, self._cruise(previous, 0.5 * ramp))
        at_rest = dict.fromkeys(self.motors, 0.0)
        before = previous.velocity if previous is not None else at_rest
        join(out, self._corner(before, move.velocity, ramp, move.s_cycles, move.tag))
        self._pending = move
        self._lead_in = 0.5 * ramp
        return out

    def _ramp(self, previous: LinearMove | None, move: LinearMove) -> float:
        """Ramp time of a corner: what fits beside the ramps already spent."""
        ramp = min(move.ramp_cycles, move.cycles)
        if previous is not None:
            ramp = min(ramp, 2.0 * max(previous.cycles - self._lead_in, 0.0))
        return max(ramp, _TINY)

    def _cruise(self, move: LinearMove, lead_out: float) -> Segments:
        cycles = move.cycles - self._lead_in - lead_out
        return self._straight(move.velocity, max(cycles, 0.0), 0)

    def _straight(self, velocity: dict[int, float], cycles: float, tag: int) -> Segments:
        if cycles <= _TINY:
            return {}
        out: Segments = {}
        for motor in self.motors:
            position, v = self.position[motor], velocity[motor]
            out[motor] = [Segment(cycles, (position, v), TIMED, tag)]
            self.position[motor] = position + v * cycles
        return out

    def _corner(
        self,
        before: dict[int, float],
        after: dict[int, float],
        ramp: float,
        s_part: float,
        tag: int,
    ) -> Segments:
        part = min(s_part, 0.5 * ramp)
        out: Segments = {}
        for motor in self.motors:
            pieces = _ramp_pieces(self.position[motor], before[motor], after[motor], ramp, part)
            first = pieces[0]
            pieces[0] = Segment(first.duration_cycles, first.coefficients, TIMED, tag)
            out[motor] = pieces
            self.position[motor] = pieces[-1].end()[0]
        return out

    # --- PVT, SPLINE1, dwell --------------------------------------------------------------------

    def pvt(
        self,
        end: dict[int, float],
        velocity: dict[int, float],
        start_velocity: dict[int, float],
        cycles: float,
        tag: int,
    ) -> Segments:
        """Cubic from here to an end position and velocity (units per cycle)."""
        out = self.finish()
        for motor in self.motors:
            p0, p1 = self.position[motor], end[motor]
            v0, v1 = start_velocity[motor], velocity[motor]
            c2 = (3.0 * (p1 - p0) / cycles - 2.0 * v0 - v1) / cycles
            c3 = (2.0 * (p0 - p1) / cycles + v0 + v1) / cycles**2
            out.setdefault(motor, []).append(Segment(cycles, (p0, v0, c2, c3), TIMED, tag))
            self.position[motor] = p1
        return out

    def spline(self, end: dict[int, float], cycles: float, tag: int) -> Segments:
        """Next point of a uniform cubic B-spline."""
        out: Segments = {}
        if self._pending is not None or (self._controls and cycles != self._spline_cycles):
            out = self.finish()
        if not self._controls:
            self._controls = {m: [p, p, p] for m, p in self.position.items()}
        self._spline_cycles = cycles
        return join(out, self._spline_piece(end, tag))

    def _spline_piece(self, end: dict[int, float], tag: int) -> Segments:
        t = self._spline_cycles
        out: Segments = {}
        for motor, controls in self._controls.items():
            controls.append(end[motor])
            c0, c1, c2, c3 = controls[-4:]
            del controls[:-3]
            coefficients = (
                (c0 + 4.0 * c1 + c2) / 6.0,
                (c2 - c0) / 2.0 / t,
                (c0 - 2.0 * c1 + c2) / 2.0 / t**2,
                (3.0 * c1 - c0 - 3.0 * c2 + c3) / 6.0 / t**3,
            )
            out[motor] = [Segment(t, coefficients, TIMED, tag)]
            self.position[motor] = (c1 + 4.0 * c2 + c3) / 6.0
        return out

    def dwell(self, cycles: float, tag: int) -> Segments:
        """Stop, then stand for a time that the time base does not scale."""
        out = self.finish()
        if cycles > _TINY:
            flags = TIMED | REAL_TIME | DWELL
            for motor in self.motors:
                segment = Segment(cycles, (self.position[motor],), flags, tag)
                out.setdefault(motor, []).append(segment)
        return out

    def finish(self) -> Segments:
        """Bring a waiting move to its end at rest."""
        out: Segments = {}
        if self._controls:
            last = {m: c[-1] for m, c in self._controls.items()}
            for _ in range(2):
                join(out, self._spline_piece(last, 0))
            self._controls = {}
            self.position = last
        move = self._pending
        if move is None:
            return out
        ramp = min(move.ramp_cycles, 2.0 * max(move.cycles - self._lead_in, 0.0))
        ramp = max(ramp, _TINY)
        join(out, self._cruise(move, 0.5 * ramp))
        at_rest = dict.fromkeys(self.motors, 0.0)
        join(out, self._corner(move.velocity, at_rest, ramp, move.s_cycles, 0))
        self.position = dict(move.end)  # without the rounding of the pieces
        self._pending = None
        self._lead_in = 0.0
        return out


def _ramp_pieces(position: float, v0: float, v1: float, ramp: float, part: float) -> list[Segment]:
    """Velocity change in an S-curve; always the same pieces, whatever the velocities are."""
    acceleration = (v1 - v0) / (ramp - part)
    jerk = acceleration / part if part > _TINY else 0.0
    plan = ((part, 0.0, jerk), (ramp - 2.0 * part, acceleration, 0.0), (part, acceleration, -jerk))
    pieces: list[Segment] = []
    velocity = v0
    for duration, a0, j0 in plan:
        if duration > _TINY:
            piece = Segment(duration, (position, velocity, 0.5 * a0, j0 / 6.0), TIMED)
            pieces.append(piece)
            position, velocity = piece.end()
    return pieces or [Segment(ramp, (position, v0), TIMED)]


def join(out: Segments, more: Segments) -> Segments:
    """Append segments of each motor; gives back `out`."""
    for motor, segments in more.items():
        out.setdefault(motor, []).extend(segments)
    return out
