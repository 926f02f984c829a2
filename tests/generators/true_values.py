"""What a simulated plant really has, in the names of the fitted model."""

from pmac_comp.simulator.plant.ballscrew import DriveTruth


def friction_of(truth: DriveTruth) -> dict[str, float]:
    """Coulomb friction of all places and the guide's viscous friction."""
    return {
        "coulomb.guide_N": truth.guide_coulomb_N,
        "coulomb.nut_Nm": truth.nut_coulomb_Nm,
        "coulomb.motor_Nm": truth.motor_coulomb_Nm,
        "viscous.guide_Ns_per_m": truth.guide_viscous_Ns_per_m,
    }
