"""The rotor model against simulated multirotors on RotorPy: thrust and drag, free run, verification, takeover."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from fleet.contract import Model, Outcome, Params, Rows, Sample, Status
from fleet.frames import G
from fleet.simulator.multirotor.uav import SimulatedMultirotor
from tests.support.flights import rows
from twin_worker.identification.multirotor.output_error import identify
from twin_worker.identification.multirotor.rotor_model import HIGH, LOW, PARAMETERS, RotorModel, free_run, start_states
from twin_worker.identification.multirotor.rotor_window import DT, RotorWindow, missing_telemetry, rotor_window
from twin_worker.ownership.cold_start import restore_model
from twin_worker.telemetry.history import TelemetryHistory
from twin_worker.telemetry.motors import motor_inputs
from twin_worker.twin.state.rotor_models import RotorModels
from twin_worker.twin.state.state import Twin, ingest
from twin_worker.twin.steps.rotor_step import PERIOD_S, identify_rotors
from twin_worker.validation.rotors import rotor_consistency, rotor_fit, verify_rotors, verify_since_identification

SEED, SECONDS, FIRST_S = 42_003, 190.0, 20.0
FlownAircraft = tuple[SimulatedMultirotor, Sample]


@pytest.fixture(scope="module")
def flown() -> FlownAircraft:
    """One simulated aircraft on its mission in wind, and its telemetry in one message."""
    uav = SimulatedMultirotor(0, SEED, wind=3.0)
    uav.silent, fast, slow = True, [], []
    for k in range(1, round(SECONDS / 0.05)):
        uav.step(0.05 * k)
        e = uav.estimate
        fast.append((1e9 + 0.05 * k, *e.euler, *e.rates, *uav.pulses, 0, 0, 0, 0))
        if k % 2 == 0:
            slow.append((1e9 + 0.05 * k, *e.v, *e.p, *uav._command[:2]))
    x, y = np.array(fast), np.array(slow)
    lla = np.column_stack([np.full((len(y), 2), 0.0), uav.origin.alt_mm - 1e3 * y[:, 6]])
    command = np.column_stack([y[:, 7:9], np.zeros((len(y), 3))])
    sample = Sample(
        uav=1,
        t=float(x[-1, 0]),
        attitude=rows(x[:, 0], x[:, 1:7]),
        servo=rows(x[:, 0], x[:, 7:15]),
        velocity=rows(y[:, 0], y[:, 1:4]),
        position=rows(y[:, 0], lla),
        command=rows(y[:, 0], command),
    )
    return uav, sample


def window_of(flown: FlownAircraft, **without: Rows | None) -> RotorWindow:
    uav, sample = flown
    history = TelemetryHistory(keep_s=1e4)
    history.add(msgspec.structs.replace(sample, **without))
    window = rotor_window(history, uav.params, seconds=SECONDS - FIRST_S, ground_mm=float(uav.origin.alt_mm))
    assert window is not None
    return window


@pytest.fixture(scope="module")
def window(flown: FlownAircraft) -> RotorWindow:
    return window_of(flown)


@pytest.fixture(scope="module")
def model(flown: FlownAircraft, window: RotorWindow) -> RotorModel:
    return identify(window.part(0, SPLIT), flown[0].params)


SPLIT = 1150


def test_thrust_and_drag_are_those_of_the_aircraft(flown: FlownAircraft, model: RotorModel) -> None:
    kind, motors = flown[0].vehicle.kind, flown[0].vehicle.motors
    w = np.sqrt((1 - kind.expo) * model.hover + kind.expo * model.hover**2) * kind.top_speed
    assert model.thrust == pytest.approx(kind.k_eta * w**2 * (motors**2).sum() / kind.mass, rel=0.03)
    drag = (kind.k_d * w * motors.sum() + kind.drag[0] * model.speed) / kind.mass
    assert model.drag == pytest.approx(drag, rel=0.1) and abs(model.drag - drag) < 3 * model.drag_std
    assert "drag" in str(model) and 0.0 < model.drag_std < 0.1 * model.drag


def test_ten_seconds_are_predicted_from_commands_and_motor_outputs(window: RotorWindow, model: RotorModel) -> None:
    fit, persistence = rotor_fit(model, window.part(SPLIT, len(window)), 10.0)
    assert min(fit.values()) > 70.0 > 40.0 > max(persistence.values()), (fit, persistence)


def test_without_a_command_only_velocities_are_predicted(flown: FlownAircraft, model: RotorModel) -> None:
    window = window_of(flown, command=None)
    alone = identify(window.part(0, SPLIT), flown[0].params)
    assert not alone.has_command and model.has_command
    assert np.allclose(alone.par[:10], model.par[:10], rtol=1e-6, atol=1e-6)
    fit, _ = rotor_fit(alone, window.part(SPLIT, len(window)), 10.0)
    assert list(fit) == ["velocity"] and fit["velocity"] > 60.0


def test_flight_before_makes_the_drag_more_certain(
    flown: FlownAircraft, window: RotorWindow, model: RotorModel
) -> None:
    longer = identify(window.part(SPLIT, len(window)), flown[0].params, base=model)
    alone = identify(window.part(SPLIT, len(window)), flown[0].params)
    assert longer.drag_std < 0.8 * alone.drag_std


def test_a_model_is_verified_only_where_its_errors_would_show(window: RotorWindow, model: RotorModel) -> None:
    verdict = verify_rotors(model, window, SPLIT, name="uav-1")
    assert verdict.outcome.is_accepted and verdict.horizon_s == 10.0
    assert set(verdict.fit) == {"velocity", "attitude"} and "velocity4" in verdict.fit_by_length
    assert ("consistent" in verdict.sentence) == (verdict.outcome is Outcome.VERIFIED)
    errors = rotor_consistency(model, window.part(SPLIT, len(window)))
    assert errors is not None and not errors.failed() and errors.power()["thrust"] < 30.0


@pytest.mark.parametrize(
    ("names", "factor", "group"), [(("k",), 1.25, "thrust"), (("k",), 0.8, "thrust"), (("d", "c"), 2.5, "drag")]
)
def test_a_wrong_parameter_is_rejected(
    window: RotorWindow, model: RotorModel, names: tuple[str, ...], factor: float, group: str
) -> None:
    par = model.par.copy()
    par[[PARAMETERS.index(name) for name in names]] *= factor
    wrong = replace(model, par=par, t1=float(window.t[0]))
    accepted = verify_rotors(model, window, SPLIT, name="uav-1")
    since = verify_since_identification(accepted, wrong, window, "uav-1")
    assert since.outcome is Outcome.PLAUSIBLE and group in since.derivative_error
    assert np.sign(since.derivative_error[group]) == np.sign(1.0 - factor)
    assert "the aircraft has" in since.sentence


def test_a_worse_model_does_not_replace_the_active_one(window: RotorWindow, model: RotorModel) -> None:
    par = model.par.copy()
    par[PARAMETERS.index("d")] *= 2.0
    verdict = verify_rotors(replace(model, par=par), window, SPLIT, name="uav-1", active=model)
    assert verdict.outcome is Outcome.WORSE_THAN_LAST and "stays active" in verdict.sentence


def test_a_hover_is_not_identifiable(window: RotorWindow, model: RotorModel) -> None:
    n = len(window)
    hover = replace(
        window,
        velocity=np.full((n, 3), 0.01) * np.sin(np.arange(n))[:, None],
        attitude=np.zeros((n, 3)),
        rates=np.zeros((n, 2)),
        command=np.zeros((n, 2)),
        inputs=np.full(window.inputs.shape, 0.5),
        ok=np.ones(n, bool),
    )
    verdict = verify_rotors(model, hover, SPLIT, name="uav-1")
    assert verdict.outcome in (Outcome.NOT_IDENTIFIABLE, Outcome.DIVERGED)


def test_a_still_free_run_obeys_gravity_and_thrust(window: RotorWindow) -> None:
    par = np.zeros(len(PARAMETERS))
    par[[PARAMETERS.index("k"), PARAMETERS.index("wn_phi"), PARAMETERS.index("wn_theta")]] = 2 * G, 5.0, 5.0
    n = 31
    still = RotorWindow(
        np.arange(n) * DT,
        np.zeros((n, 3)),
        np.zeros((n, 3)),
        np.zeros((n, 2)),
        np.zeros((n, 2)),
        np.zeros((n, 4)),
        np.ones(n, bool),
    )
    first = np.zeros(1, int)
    run = free_run(par, still, first, start_states(still, first), n - 1, commanded=True)
    assert run[0, -1, 2] == pytest.approx(G * DT * (n - 1)) and np.allclose(run[0, :, 3:], 0.0)
    half = replace(still, inputs=np.full((n, 4), 0.5))
    assert np.allclose(free_run(par, half, first, start_states(half, first), n - 1, commanded=True), 0.0, atol=1e-9)


def test_rows_on_the_ground_and_at_gaps_are_not_used(flown: FlownAircraft) -> None:
    uav, sample = flown
    history = TelemetryHistory(keep_s=1e4)
    history.add(sample)
    whole = rotor_window(history, uav.params, seconds=SECONDS, ground_mm=float(uav.origin.alt_mm))
    assert whole is not None and not whole.ok[: round(2.0 / DT)].any() and whole.ok[round(FIRST_S / DT) :].all()
    t, x = sample.velocity.t.numpy(), sample.velocity.x.numpy()  # type: ignore[union-attr]
    received = (t < 1e9 + 60.0) | (t > 1e9 + 63.0)
    gap = window_of(flown, velocity=rows(t[received], x[received]))
    assert 3.0 < (~gap.ok).sum() * DT < 6.0
    lengths = gap.runs(40)
    assert (np.diff(lengths) >= 40).all() and all(gap.ok[k : k + 41].all() for k in lengths)


def test_what_is_missing_is_named(flown: FlownAircraft) -> None:
    uav, sample = flown
    history = TelemetryHistory()
    history.add(msgspec.structs.replace(sample, servo=None))
    assert missing_telemetry(history, uav.params) == "no motor outputs yet"
    assert rotor_window(history, uav.params, seconds=100.0, ground_mm=0.0) is None
    assert "frame" in missing_telemetry(history, {"FRAME_CLASS": 9.0})
    few = window_of(flown).part(0, 60)
    with pytest.raises(ValueError, match="runs of 4 s without a gap, needs 4"):
        identify(few, uav.params)


def test_parameters_stay_within_their_limits_whatever_the_data(flown: FlownAircraft, window: RotorWindow) -> None:
    rng = np.random.default_rng(5)
    noise = replace(window, velocity=rng.normal(0.0, 20.0, window.velocity.shape))
    try:
        par = identify(noise.part(0, SPLIT), flown[0].params).par
    except ValueError:
        return
    assert (par >= LOW).all() and (par <= HIGH).all()


# --- the twin --------------------------------------------------------------------------------------------------------


def twin_of(flown: FlownAircraft, **params: float) -> Twin:
    uav, sample = flown
    twin = Twin.of(1)
    ingest(twin, Status(uav=1, t=1e9, vehicle="multirotor", autopilot="ardupilot", mode="AUTO", armed=True))
    ingest(twin, Params(uav=1, t=1e9, values={**uav.params, **params}))
    ingest(twin, sample)
    return twin


@pytest.fixture(scope="module")
def identified(flown: FlownAircraft) -> tuple[Twin, Model]:
    twin = twin_of(flown)
    (message,) = identify_rotors(twin)
    return twin, message


def test_the_twin_publishes_model_and_verdict(identified: tuple[Twin, Model]) -> None:
    twin, message = identified
    assert message.verdict.outcome.is_accepted and message.active_verdict == message.verdict
    assert message.rotors is not None and message.rotors.names == PARAMETERS
    assert message.rotors.sentence == str(twin.models.rotors.active)
    assert twin.identification.message is message and twin.models.active_model is None
    assert twin.models.state.value in ("plausible", "verified")
    assert identify_rotors(twin) == []  # not due


def test_the_prior_of_a_later_window_is_the_model_before_it(
    flown: FlownAircraft, identified: tuple[Twin, Model]
) -> None:
    rotors = identified[0].models.rotors
    assert rotors.base is rotors.newest and rotors.base is not None
    rotors.timer.restart(rotors.timer.last - PERIOD_S)
    assert identify_rotors(identified[0]) == []  # the flight since the base is too short: nothing is lost
    assert rotors.active is not None


def test_two_contradictions_in_a_row_discard_the_flight_before(model: RotorModel) -> None:
    rotors = RotorModels()
    rotors.store(model, fails=False, becomes_base=True)
    assert rotors.base is model
    for fails in (True, False, True):
        rotors.store(replace(model, steps=1), fails=fails, becomes_base=False)
        assert rotors.base is model and rotors.newest is not model
    rotors.store(replace(model, steps=2), fails=True, becomes_base=True)
    assert rotors.base is None and rotors.newest is None and rotors.failures == 0


def test_a_clock_set_back_keeps_the_model(flown: FlownAircraft, identified: tuple[Twin, Model]) -> None:
    twin = twin_of(flown)
    late = replace(identified[0].models.rotors.base, t1=2e9)  # type: ignore[type-var]
    twin.models.rotors.restore(late)
    (message,) = identify_rotors(twin)
    assert message.verdict.outcome is not Outcome.INSUFFICIENT_DATA
    assert twin.models.rotors.newest is not None and twin.models.rotors.newest.t1 < 1e9 + SECONDS


def test_a_frame_that_is_not_known_is_said(flown: FlownAircraft) -> None:
    twin = twin_of(flown, FRAME_CLASS=9.0)
    assert identify_rotors(twin) == []
    assert "the frame in the parameters is none of a quadrotor" in twin.identification.verdict.sentence


def test_another_worker_continues_with_the_published_model(
    identified: tuple[Twin, Model], flown: FlownAircraft
) -> None:
    _, message = identified
    other = Twin.of(1)
    assert restore_model(other, message)
    restored = other.models.rotors.base
    assert restored is not None and np.allclose(restored.par, identified[0].models.rotors.active.par)  # type: ignore[union-attr]
    assert "taken over" in other.models.active_verdict.sentence  # type: ignore[union-attr]
    for odd in (
        msgspec.structs.replace(message.rotors, names=("k",)),
        msgspec.structs.replace(message.rotors, value=message.rotors.covariance),  # type: ignore[union-attr]
        msgspec.structs.replace(message.rotors, covariance=message.rotors.value),  # type: ignore[union-attr]
    ):
        cold = Twin.of(1)
        assert not restore_model(cold, msgspec.structs.replace(message, rotors=odd))
        assert cold.models.rotors.active is None


def test_motor_inputs_are_between_idle_and_full() -> None:
    params = {"MOT_SPIN_MIN": 0.2, "MOT_SPIN_MAX": 0.9}
    assert motor_inputs(np.array([1000.0, 1200.0, 1550.0, 1900.0, 2000.0]), params) == pytest.approx([0, 0, 0.5, 1, 1])
