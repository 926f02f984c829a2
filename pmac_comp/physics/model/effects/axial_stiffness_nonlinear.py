"""Contact stiffness of a preloaded double nut that falls with the force."""

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.bench import Bench
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.effect import Effect, Values
from pmac_comp.physics.model.parameters import parameter

# Two Hertz contacts preloaded by P against each other, F = P [(1 + u)^3/2 - (1 - u)^3/2], have
# k d (1 - (F/P)^2 / 216) to the same order: F_0 in the law below is 2.45 P.


def _apply(vector: FloatArray, values: Values, bench: Bench, place: str) -> None:
    vector[s.HERTZ] = 1.0 / (36.0 * values["preload_N"] ** 2)


EFFECT = Effect(
    name="axial_stiffness_nonlinear",
    parameters=(
        parameter(
            "preload_N",
            "N",
            1000.0,
            (50.0, 1e6),
            scale=300.0,
            description="F_0 of the law; 2.45 times the preload of two Hertz contacts",
        ),
    ),
    apply=_apply,
    where="nut joint",
    source=(
        "Hertz contacts of two preloaded halves, derived here: F = k d (1 - (F/F_0)^2 / 36), half "
        "of k beyond 2.83 F_0"
    ),
    signature="table lag grows faster than the force",
    separating_experiment="an amplitude sweep at the same shape: presliding scales the other way",
    look_alikes=("preload_loss", "presliding"),
    starts=({"preload_N": 500.0}, {"preload_N": 1500.0}),
    hides_behind=("chain.axial_stiffness_N_per_m",),
    min_substeps=4,
    rigid=False,
)
