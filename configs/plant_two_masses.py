"""Example of drives of your own behind the simulated card.

    pmac-comp sim --bench paper --plant configs/plant_two_masses.py --tcp 1025
    pmac-comp sim --bench paper --plant configs/plant_two_masses.py:loose_nut --tcp 1025

A file holds one factory or several: ``make_plant(bench)``, or the one named behind the colon. Its
drive has ``reset(table_position_m=0.0)`` and ``step(torque_command_Nm)``. One step is one servo
period: the torque is held over it, and the answer is the motor's angle in rad and the table's
position in m at its end. Positive torque turns the angle up and moves the table up. Current loop,
torque limit and mechanics are the plant's business; encoder and scale are rounded by the card.
``set_external_force(force_N)``, positive against positive motion, may be left out.
"""

import math

from pmac_comp.base.units import UM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.simulator.plant import Plant
from pmac_comp.simulator.plant import make_plant as built_in_drive
from pmac_comp.simulator.plant.ballscrew import hidden_effects

FINE_STEPS = 20  # a servo period
GUIDE_N, SHAFT_Nm = 40.0, 0.4  # Coulomb friction
GUIDE_Ns_per_m = 200.0
CREEP_m_per_s, CREEP_rad_per_s = 2e-4, 0.1  # speed over which friction turns over
DAMPING_RATIO = 0.04


class TwoMasses:
    """Rotor and table on one spring, each with friction: a drive in thirty lines."""

    def __init__(self, bench: Bench) -> None:
        known = bench.nominal
        needed = (known.motor_inertia_kgm2, known.table_mass_kg, known.axial_stiffness_N_per_um)
        if any(value is None for value in needed):
            raise ValueError("this drive needs motor inertia, table mass and axial stiffness")
        rotor_kgm2, self.mass_kg, stiffness = (float(value or 0.0) for value in needed)
        self.inertia_kgm2 = rotor_kgm2 + (known.screw_inertia_kgm2 or 0.0)
        self.stiffness_N_per_m = stiffness * UM_PER_M
        self.damping = 2.0 * DAMPING_RATIO * math.sqrt(self.stiffness_N_per_m * self.mass_kg)
        self.lead_m_per_rad = bench.lead_m_per_rad
        self.limit_Nm = bench.drive.torque_limit_Nm
        self.fine_s = bench.servo_period_s / FINE_STEPS
        self.reset()

    def reset(self, table_position_m: float = 0.0) -> None:
        """Put the drive at rest at a table position in m."""
        self.angle_rad, self.table_m = table_position_m / self.lead_m_per_rad, table_position_m
        self.speed_rad_per_s = self.speed_m_per_s = self.pushed_N = 0.0

    def set_external_force(self, force_N: float) -> None:
        """Force on the table in N, positive against positive motion."""
        self.pushed_N = force_N

    def step(self, torque_command_Nm: float) -> tuple[float, float]:
        """Motor angle in rad and table position in m after one servo period of this torque."""
        torque_Nm = max(-self.limit_Nm, min(self.limit_Nm, torque_command_Nm))
        for _ in range(FINE_STEPS):
            self._fine_step(torque_Nm)
        return self.angle_rad, self.table_m

    def _fine_step(self, torque_Nm: float) -> None:
        lead = self.lead_m_per_rad
        spring_N = self.stiffness_N_per_m * (lead * self.angle_rad - self.table_m)
        spring_N += self.damping * (lead * self.speed_rad_per_s - self.speed_m_per_s)
        shaft_Nm = SHAFT_Nm * math.tanh(self.speed_rad_per_s / CREEP_rad_per_s)
        guide_N = GUIDE_N * math.tanh(self.speed_m_per_s / CREEP_m_per_s)
        guide_N += GUIDE_Ns_per_m * self.speed_m_per_s + self.pushed_N
        turning_Nm = torque_Nm - shaft_Nm - lead * spring_N
        self.speed_rad_per_s += self.fine_s * turning_Nm / self.inertia_kgm2
        self.speed_m_per_s += self.fine_s * (spring_N - guide_N) / self.mass_kg
        self.angle_rad += self.fine_s * self.speed_rad_per_s
        self.table_m += self.fine_s * self.speed_m_per_s


def make_plant(bench: Bench) -> Plant:
    """The drive of this file."""
    return TwoMasses(bench)


def loose_nut(bench: Bench) -> Plant:
    """The built-in drive with one hidden effect more: 4 um of play in the nut.

    The names of effects and their parameters are those of `pmac_comp.simulator.plant.effects`.
    """
    return built_in_drive(bench, effects={**hidden_effects(), "backlash": {"gap_um": 4.0}})
