"""The drive model as a value: names, bounds, effects, refusals."""

import multiprocessing
import pickle
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from pmac_comp.base.errors import ConfigError, ModelError, NonFinite
from pmac_comp.files.bench import Known, SiControl, load_bench
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.drive import DriveModel, simulate, simulate_many
from pmac_comp.physics.model.effect import effect_library, load_effects
from pmac_comp.physics.model.quasi_static import modes_Hz
from pmac_comp.physics.model.terms import Coordinate, Factor, Site, TableTerm
from pmac_comp.physics.signals import trajectory as tr

BENCH = load_bench("paper")
TS = BENCH.servo_period_s
MODEL = DriveModel.base(BENCH)
MOTION = tr.sinusoid(period_s=TS, amplitude_m=2e-3, frequency_Hz=5.0, cycles=1.0)

# The names that the design fixes.
DESIGN = (
    "stribeck presliding viscous_nonlinear coulomb viscous friction_asymmetry friction_per_rev "
    "post_reversal_dip friction_warmup cogging torque_ripple bias_force cable_drag payload "
    "backlash nut_efficiency axial_stiffness_position axial_stiffness_nonlinear preload_loss "
    "coupling_windup chain_damping base_mode lead_linear lead_cyclic thermal_growth "
    "encoder_eccentricity scale_subdivision scale_slope channel_skew actuator_delay "
    "current_bandwidth torque_saturation external_force"
)

# First parameter in files and its unit, as users' programs read them.
SCORED = {
    "presliding": ("distance_um", 1e6),
    "friction_asymmetry": ("fraction", 1.0),
    "bias_force": ("force_N", 1.0),
    "backlash": ("gap_um", 1e6),
    "preload_loss": ("half_width_um", 1e6),
    "friction_per_rev": ("amplitude_Nm", 1.0),
    "cogging": ("amplitude_Nm", 1.0),
    "torque_ripple": ("amplitude_Nm", 1.0),
    "encoder_eccentricity": ("amplitude_um", 1e6),
    "lead_cyclic": ("amplitude_um", 1e6),
    "lead_linear": ("slope_um_per_m", 1e6),
    "scale_slope": ("slope_um_per_m", 1e6),
    "thermal_growth": ("final_um_per_m", 1e6),
    "payload": ("mass_kg", 1.0),
    "actuator_delay": ("time_us", 1e6),
    "channel_skew": ("time_us", 1e6),
    "current_bandwidth": ("bandwidth_Hz", 1.0),
    "cable_drag": ("stiffness_N_per_m", 1.0),
    "base_mode": ("frequency_Hz", 1.0),
    "external_force": ("amplitude_N", 1.0),
    "stribeck": ("excess_N", 1.0),
}


def all_variants():
    return [
        f"{name}@{place}" if place else name
        for name, effect in effect_library().items()
        for place in (effect.places or ("",))
    ]


def test_library_holds_every_effect_of_the_design():
    assert set(DESIGN.split()) <= set(effect_library())


def test_first_parameters_keep_the_names_and_units_of_files():
    for name, (file_name, factor) in SCORED.items():
        first = effect_library()[name].parameters[0]
        assert (first.file_name, first.file_factor) == (file_name, factor)


def test_every_effect_says_what_a_person_needs():
    for effect in effect_library().values():
        assert effect.source
        assert effect.signature
        assert effect.separating_experiment
        assert all(name in effect_library() for name in effect.look_alikes)


@pytest.mark.parametrize("name", [n for n in all_variants() if n not in {"coulomb", "viscous"}])
def test_every_effect_changes_what_is_read(name):
    model = MODEL.with_effect(name)
    if name == "torque_saturation":
        model = model.with_parameters({"torque_saturation.limit_Nm": 0.5})
    plain, changed = simulate(MODEL, MOTION), simulate(model, MOTION)
    rows = [(plain.table_position_m, changed.table_position_m)]
    rows.append((plain.motor_position_m, changed.motor_position_m))
    assert max(float(np.std(a - b)) for a, b in rows) > 0.2e-9
    assert all(np.all(np.isfinite(b)) for _, b in rows)


def test_parameters_are_known_with_the_tolerance_of_the_bench():
    spec = MODEL.spec("chain.table_mass_kg")
    assert (spec.kind, spec.tolerance_frac, spec.nominal) == ("known", 0.05, 122.86)
    stiffness = MODEL.spec("chain.axial_stiffness_N_per_m")
    assert stiffness.to_file(stiffness.nominal) == pytest.approx(97.14)
    assert stiffness.file_name == "axial_stiffness_N_per_um"
    assert MODEL.spec("coulomb.guide_N").kind == "free"


def test_models_are_values():
    grown = MODEL.with_effect("backlash", {"gap_m": 4e-6})
    assert "backlash" not in MODEL.effects
    assert grown.parameters["backlash.gap_m"] == 4e-6
    assert grown.without_effect("backlash") == MODEL
    with pytest.raises(TypeError):
        grown.parameters["backlash.gap_m"] = 1.0
    copy = pickle.loads(pickle.dumps(grown))  # noqa: S301 our own object, for process pools
    assert copy == grown


def test_place_selects_the_variant():
    nut = MODEL.with_effect("stribeck@nut", {"excess_Nm": 0.1})
    vector = nut.kernel_vector()
    assert vector[s.STRIBECK_NUT] == 0.1
    assert vector[s.STRIBECK_GUIDE] == 0.0
    assert "stribeck.excess_Nm" in nut.parameters


@pytest.mark.parametrize(
    "action",
    [
        lambda: MODEL.with_effect("no_such_effect"),
        lambda: MODEL.with_effect("stribeck@wall"),
        lambda: MODEL.with_effect("backlash").with_effect("backlash"),
        lambda: MODEL.with_parameters({"backlash.gap_m": 1e-6}),
        lambda: MODEL.with_parameters({"coulomb.guide_N": -1.0}),
        lambda: MODEL.without_effect("backlash"),
        lambda: MODEL.spec("chain.colour"),
    ],
)
def test_wrong_names_and_values_are_refused(action):
    with pytest.raises(ModelError):
        action()


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_parameters_that_are_not_finite_are_refused_by_name(value):
    with pytest.raises(NonFinite, match=r"coulomb\.guide_N"):
        MODEL.with_parameters({"coulomb.guide_N": value})


def test_unstable_loop_is_reported_not_returned():
    law = SiControl(Kp_Nm_per_mm=1e6)
    update = {"kind": "si", "si": law}
    bench = BENCH.model_copy(
        update={
            "drive": BENCH.drive.model_copy(update={"torque_limit_Nm": 1e100}),
            "controller": BENCH.controller.model_copy(update=update),
        }
    )
    model = DriveModel.base(bench)
    with pytest.raises(NonFinite, match="unstable"):
        simulate(model, np.concatenate([np.zeros(10), np.full(60_000, 1e-3)]))


def test_delay_beyond_the_history_is_refused():
    slow = BENCH.model_copy(
        update={"controller": BENCH.controller.model_copy(update={"ivariables": {"I10": 1000.0}})}
    )
    model = DriveModel.base(slow).with_effect("actuator_delay", {"time_s": 0.05})
    with pytest.raises(ModelError, match="delay"):
        simulate(model, np.zeros(10))


def test_simulate_many_agrees_with_one_after_the_other():
    models = [MODEL.with_parameters({"coulomb.guide_N": level}) for level in (20.0, 40.0, 60.0)]
    alone = [simulate(model, MOTION).table_position_m for model in models]
    together = simulate_many(models, [MOTION])
    with ThreadPoolExecutor(2) as pool:
        given = simulate_many(models, [MOTION] * 3, executor=pool)
    for one, two, three in zip(alone, together, given, strict=True):
        assert np.array_equal(one, two.table_position_m)
        assert np.array_equal(one, three.table_position_m)
    with pytest.raises(ModelError):
        simulate_many(models, [MOTION, MOTION])


def test_correction_moves_motor_and_table_together():
    offset = np.full(MOTION.n, 5e-6)
    moved = simulate(MODEL, MOTION, desired_position_m=MOTION.position_m + offset)
    plain = simulate(MODEL, MOTION)
    np.testing.assert_allclose(
        moved.motor_position_m - plain.motor_position_m, 5e-6, rtol=0.0, atol=1e-9
    )


def test_time_origin_moves_what_depends_on_time():
    model = MODEL.with_effect("thermal_growth", {"final": 1e-4, "time_constant_s": 10.0})
    cold = simulate(model, np.full(50, 0.1))
    warm = simulate(model, np.full(50, 0.1), time_origin_s=1e4)
    grown = warm.table_position_m[0] - cold.table_position_m[0]
    assert grown == pytest.approx(1e-4 * (0.1 + 0.45), rel=1e-3)
    assert warm.time_s[0] == 1e4


def test_backlash_at_standstill_is_the_gap():
    model = MODEL.without_effect("coulomb").with_effect("backlash", {"gap_m": 6e-6})
    n = 6000
    force = np.where(np.arange(n) < n // 2, 200.0, -200.0)
    response = simulate(model, np.zeros(n), external_force_N=force)
    elastic = simulate(model.without_effect("backlash"), np.zeros(n), external_force_N=force)
    step = response.mechanical_error_m[-1] - response.mechanical_error_m[n // 2 - 1]
    spring = elastic.mechanical_error_m[-1] - elastic.mechanical_error_m[n // 2 - 1]
    assert step - spring == pytest.approx(6e-6, rel=1e-3)


def test_lead_cyclic_reads_as_the_stated_harmonic_at_low_speed():
    model = MODEL.with_effect("lead_cyclic", {"amplitude_m": 2e-6, "phase_rad": 0.4})
    motion = tr.trapezoid(
        period_s=TS, distance_m=0.02, speed_m_per_s=0.02, acceleration_m_per_s2=0.5, both_ways=False
    )
    both = [simulate(m, motion) for m in (model, MODEL)]
    found = both[0].mechanical_error_m - both[1].mechanical_error_m
    expected = 2e-6 * np.cos(both[0].motor_position_m / BENCH.lead_m_per_rad + 0.4)
    assert np.std(found - expected) < 0.02e-6


def test_skew_reads_an_older_table():
    model = MODEL.with_effect("channel_skew", {"time_s": 40e-6})
    late = simulate(model, MOTION).table_position_m
    now = simulate(MODEL, MOTION)
    shifted = CubicSpline(now.time_s, now.table_position_m)(now.time_s - 40e-6)
    assert np.std(late - shifted) < 5e-9


def test_table_terms_reproduce_built_in_effects():
    x = np.linspace(-0.05, 0.05, 41)
    term = TableTerm(
        Coordinate.TABLE_POSITION_M, Site.TABLE_FORCE_N, -0.05, float(x[1] - x[0]), -3000.0 * x
    )
    drag = MODEL.with_effect("cable_drag", {"stiffness_N_per_m": 3000.0})
    ours = simulate(MODEL, MOTION, extra_terms=[term])
    np.testing.assert_allclose(
        ours.table_position_m, simulate(drag, MOTION).table_position_m, rtol=0.0, atol=0.5e-9
    )


def test_table_term_factors_follow_the_friction_state():
    term = TableTerm(
        Coordinate.TIME_S, Site.TABLE_FORCE_N, 0.0, 1.0, np.array([-10.0, -10.0]),
        Factor.GUIDE_FRICTION_STATE,
    )  # fmt: skip
    more = MODEL.with_parameters({"coulomb.guide_N": 55.0})
    ours = simulate(MODEL, MOTION, extra_terms=[term]).torque_command_Nm
    theirs = simulate(more, MOTION).torque_command_Nm
    plain = simulate(MODEL, MOTION).torque_command_Nm
    assert np.std(ours - theirs) < 0.35 * np.std(plain - theirs)


USER_EFFECT = """
import numpy as np
from pmac_comp.physics.model.effect import Effect, no_slots
from pmac_comp.physics.model.parameters import parameter
from pmac_comp.physics.model.quasi_static import modes_Hz
from pmac_comp.physics.model.terms import Coordinate, Site, TableTerm

def terms(values, bench):
    x = np.linspace(-0.3, 0.3, 601)
    force = -values["force_N"] * np.exp(-((x - values["place_m"]) / 0.002) ** 2)
    return (TableTerm(Coordinate.TABLE_POSITION_M, Site.TABLE_FORCE_N, -0.3, 0.001, force),)

EFFECT = Effect(
    name="tight_spot",
    parameters=(parameter("force_N", "N", 20.0, (0.0, 1e4)),
                parameter("place_m", "m", 0.0, (-1.0, 1.0), scale=0.01)),
    apply=no_slots, terms=terms, where="guide", source="own", signature="a bump in the torque",
    separating_experiment="run over it",
)
"""


def test_a_users_own_effect_acts_in_the_loop(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(USER_EFFECT)
    library = load_effects(path)
    model = MODEL.with_effect("tight_spot", {"force_N": 100.0}, library=library)
    motion = tr.trapezoid(
        period_s=TS, distance_m=0.04, speed_m_per_s=0.02, acceleration_m_per_s2=0.5,
        start_m=-0.02, both_ways=False,
    )  # fmt: skip
    extra = simulate(model, motion).joint_force_N - simulate(MODEL, motion).joint_force_N
    at = np.argmin(extra)
    assert extra[at] == pytest.approx(-100.0, rel=0.1)
    assert motion.position_m[at] == pytest.approx(0.0, abs=2e-3)


@pytest.mark.parametrize(
    "text", ["EFFECT = 3", "raise ImportError('no')", "def broken(:", USER_EFFECT.replace(
        '"tight_spot"', '"backlash"')],
)  # fmt: skip
def test_bad_effect_files_are_refused(tmp_path, text):
    path = tmp_path / "bad.py"
    path.write_text(text)
    with pytest.raises(ConfigError):
        load_effects(path)
    with pytest.raises(ConfigError):
        load_effects(tmp_path / "missing.py")


def test_pmac_gains_in_physical_units():
    # Comment of the bench file: K_P 23.7 N m/rad, K_D 0.227, K_I 298, K_VFF 0.2295, K_AFF 1.112e-3.
    vector = MODEL.kernel_vector()
    lead = BENCH.lead_m_per_rad
    found = [vector[i] * lead for i in (s.KP, s.KD, s.KI, s.KVFF, s.KAFF)]
    np.testing.assert_allclose(found, [23.7, 0.227, 298.0, 0.2295, 1.112e-3], rtol=2e-3)


def test_both_paper_benches_have_the_same_loop():
    other = DriveModel.base(load_bench("paper_x4")).kernel_vector()
    for slot in (s.KP, s.KD, s.KI, s.KVFF, s.KAFF):
        assert other[slot] == pytest.approx(MODEL.kernel_vector()[slot], rel=1e-4)


def test_gain_variables_of_a_closed_loop_slower_than_the_servo_are_refused():
    control = BENCH.controller.model_copy(
        update={"ivariables": {**BENCH.controller.ivariables, "I160": 1.0}}
    )
    with pytest.raises(ConfigError, match="I160"):
        DriveModel.base(BENCH.model_copy(update={"controller": control})).kernel_vector()


def test_any_executor_can_be_handed_in():
    # A process pool needs models that travel; a Dask cluster asks for the same.
    models = [MODEL.with_effect("backlash", {"gap_m": gap}) for gap in (1e-6, 4e-6)]
    alone = [simulate(model, MOTION).table_position_m for model in models]
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        there = simulate_many(models, [MOTION], executor=pool)
    for one, two in zip(alone, there, strict=True):
        assert np.array_equal(one, two.table_position_m)


def test_a_dask_cluster_runs_many_simulations():
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        there = simulate_many([MODEL, MODEL], [MOTION], executor=client.get_executor())
    assert np.array_equal(there[0].table_position_m, simulate(MODEL, MOTION).table_position_m)


@pytest.mark.parametrize(("stated_Hz", "periods"), [(400.0, 1.0), (None, 2.0)])
def test_a_bench_that_states_no_delay_has_the_usual_one(stated_Hz, periods):
    nominal = {"actuator_delay_us": None, "current_bandwidth_Hz": stated_Hz}
    bench = BENCH.model_copy(update={"nominal": BENCH.nominal.model_copy(update=nominal)})
    spec = DriveModel.base(bench).spec("chain.actuator_delay_s")
    assert spec.nominal == pytest.approx(periods * bench.servo_period_s)
    assert (spec.kind, spec.tolerance_frac) == ("known", 1.0)


def test_damping_that_is_usual_is_a_share_of_critical_and_not_a_time() -> None:
    # 3 % of critical at 130.6 Hz is 73 us; at 40 Hz it is 240 us, which is no missing effect.
    paper = load_bench("paper")
    nominal = DriveModel.base(paper).spec("chain.damping_time_s").nominal
    assert nominal == pytest.approx(7.3e-5, rel=1e-3)
    unmeasured = paper.model_copy(update={"known": Known()})
    again = DriveModel.base(unmeasured).spec("chain.damping_time_s").nominal
    assert again == pytest.approx(nominal, rel=0.02)
    soft = paper.nominal.model_copy(update={"axial_stiffness_N_per_um": 5.0})
    slender = DriveModel.base(unmeasured.model_copy(update={"nominal": soft}))
    first_Hz = float(modes_Hz(slender, 0.0)[0])
    damping_s = slender.spec("chain.damping_time_s").nominal
    assert damping_s * np.pi * first_Hz == pytest.approx(0.03, rel=0.03)
