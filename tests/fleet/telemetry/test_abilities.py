"""What `fleet inspect` says a twin can do with a recording: the same as the twin itself does with it."""

import contextlib
import dataclasses

import numpy as np
import pytest
from test_inspect import judged, known, lively, slower

from fleet.commands.offline import inspect
from fleet.contract import Mission, Prediction, Status
from fleet.process.sanitise import format_below
from fleet.telemetry.inspection import abilities as needs
from fleet.telemetry.inspection.survey import ROTOR_AIRBORNE_HEIGHT, airborne, survey_recording
from tests.support import flights
from tests.support.flights import T0
from tests.support.ulog_writer import flight as flight_of
from tests.support.ulog_writer import ulog
from twin_worker.diagnosis.baseline import own_past, past
from twin_worker.diagnosis.data import flight
from twin_worker.diagnosis.data import flight as smooth
from twin_worker.diagnosis.data.card import UNKNOWN
from twin_worker.evaluation.replay import run_offline
from twin_worker.prediction import constant_turn as turn_rate
from twin_worker.prediction.multirotor import fit as tilt
from twin_worker.telemetry import resample
from twin_worker.telemetry.history import TelemetryHistory
from twin_worker.twin.state import flight_phase, routes
from twin_worker.twin.steps import identify_step
from twin_worker.validation import verify


def test_the_figures_are_those_the_twin_works_by():
    assert tuple(resample.LONGEST_GAP) == needs.REQUIRED_FIELDS
    assert identify_step.MIN_WINDOW_S == needs.MIN_IDENTIFY_S
    least, papers, most = identify_step._HOLD_OUT_S  # held out beside what is identified
    assert (
        max(identify_step._WINDOW_LIMITS_S[1] + most, identify_step._PAPER_WINDOW_S + papers) == needs.MAX_IDENTIFY_S
        and least < papers < most
    )
    assert routes.ROUTE_MODES == needs.ROUTE_MODES
    assert min(verify.HORIZONS_S) == needs.MIN_STRETCH_S
    assert verify._STEADY_STD == needs.MIN_EXCITATION
    assert max(4 * turn_rate.STEP, 50 * resample.DT) == needs.TURN_RATE_S
    assert (flight._MIN_FLIGHT_S, flight.VANE_HZ) == (needs.MIN_DIAGNOSE_S, needs.GUST_SENSING_HZ)
    assert (needs._SKIP_BEGIN_S, needs._SKIP_END_S) == flight._TRANSIENT_S
    assert past.MIN_PAST_S + own_past.MIN_AFTER_S == needs.MIN_OWN_PAST_S
    assert flight_phase._AIRBORNE_HEIGHT_M == ROTOR_AIRBORNE_HEIGHT
    assert tilt._MIN_TILT_S == needs.MIN_TILT_S


@pytest.mark.parametrize(
    ("seconds", "without", "can"), [(31, (), False), (33, (), True), (60, ("velocity",), False), (60, ("imu",), True)]
)
def test_diagnose_is_promised_where_the_diagnosis_accepts_the_flight(seconds, without, can):
    laid = {name: rows for name, rows in lively(seconds).items() if name not in without}
    history = TelemetryHistory(keep_s=np.inf)
    for message in flights.messages(laid):
        history.add(message)
    with contextlib.nullcontext() if can else pytest.raises(ValueError):
        flight.resample_flight("it", history, {}, UNKNOWN)
    assert judged(known(laid))["diagnose"][0] is can


def quad(seconds: float = 40.0, speed: float = 3.0, height: float = 10.0) -> flights.Laid:
    """A multirotor that goes north at one height, from the first row to the last."""
    t = T0 + np.arange(0.0, seconds, 0.1)
    north = speed * (t - T0)
    place = np.column_stack([473_977_420 + north * 89.83, 0 * t + 85_455_940, 0 * t + 500_000])
    rows = {"attitude": np.zeros((len(t), 6)), "velocity": np.column_stack([0 * t + speed, 0 * t, 0 * t])}
    rows |= {"position": place, "height": 0 * t[:, None] + height, "leg": 0 * t[:, None] + 2.0}
    return {name: (t, x) for name, x in rows.items()}


@pytest.mark.parametrize(("speed", "height", "flies"), [(3.0, 0.5, True), (0.0, 10.0, True), (0.0, 0.2, False)])
def test_a_quadrotor_flies_below_six_metres_a_second(speed, height, flies):
    (*spans,) = airborne(known(quad(speed=speed, height=height), vehicle="multirotor"))
    assert [span.seconds > 38 for span in spans] == flies * [True]


def test_a_quadrotor_on_its_route_is_predicted_as_the_twin_does():
    laid = quad()
    status = Status(uav=1, t=T0, mode="AUTO", armed=True, vehicle="multirotor", autopilot="ardupilot")
    mission = Mission(uav=1, t=T0, items=tuple(flights.item(n, north=200.0 * n) for n in range(4)), complete=True)
    messages = [status, mission, *flights.messages(laid)]
    made = [m for m in run_offline(messages, {}) if isinstance(m, Prediction)]
    assert "copter" in {m.method for m in made}
    can, why = judged(survey_recording(messages)[1])["predict on the route"]
    assert can and "40 s on the route" in why


def test_a_wing_that_cannot_be_identified_is_still_predicted_on_its_route():
    can, why = judged(known(flights.turn(60)))["predict on the route"]
    assert can and "kinematic fixed-wing model, since neither axis can be identified" in why


@pytest.mark.parametrize(
    ("kind", "words"), [("ULog", "PX4 logs no mission items"), ("telemetry log", "ground station")]
)
def test_the_remedy_for_a_missing_mission_list_fits_the_recording(kind, words):
    messages = [Status(uav=1, t=T0, mode="AUTO", armed=True, vehicle="fixed_wing"), *flights.messages(lively())]
    can, why = judged(survey_recording(messages, kind)[1])["predict on the route"]
    assert not can and words in why


def test_a_ulog_is_surveyed_as_one(tmp_path):
    path = tmp_path / "flight.ulg"
    path.write_bytes(ulog(flight_of((1, 14))))
    (one,) = inspect.inspect_file(path)[1].values()
    assert one.kind == "ULog"


@pytest.mark.parametrize(
    ("found", "needed", "text"), [(39.96, 40, "39.96"), (12.3, 40, "12"), (39.4, 40, "39"), (40 - 1e-9, 40, "39.999")]
)
def test_a_number_below_a_limit_never_reads_as_the_limit(found, needed, text):
    assert format_below(found, needed) == text


def test_a_past_that_is_a_little_too_short_is_not_said_to_be_enough():
    laid = lively(46.6)  # less 6.5 s at its ends and a step of the grid
    history = TelemetryHistory(keep_s=np.inf)
    for message in flights.messages(laid):
        history.add(message)
    lain = flight.resample_flight("it", history, {}, UNKNOWN)
    ok = lain.ok & (np.cumsum(lain.ok) <= round(past.MIN_PAST_S / smooth.DT) - 2)
    with pytest.raises(ValueError, match=r"found 39\.\d+ s of trusted flight before .* expected 40 s"):
        past.calibrate_past(dataclasses.replace(lain, ok=ok), UNKNOWN)


def test_a_plane_with_everything_can_everything():
    told = judged(known(lively()))
    assert [name for name, (can, _) in told.items() if not can] == []
    why = "53 s in flight without gaps, compared with a model of `fleet calibrate` or earlier flight data"
    assert why in told["diagnose"][1]


@pytest.mark.parametrize(
    ("laid", "more", "name", "words"),
    [
        (lively(20), {}, "identify lateral", "20 s of complete data in flight, 30 s are required"),
        (
            lively(),
            {"vehicle": "multirotor"},
            "identify longitudinal",
            "the dynamics of a multirotor are not identified",
        ),
        (slower(lively(), "attitude", 90), {}, "identify lateral", "attitude at 0.3 Hz is continuous for 0 of"),
        (flights.turn(60), {}, "identify longitudinal", "elevator and throttle constant"),
        (
            lively() | {"attitude": flights.turn(60)["attitude"]},
            {},
            "verify",
            "steady flight, too little excitation: bank varies",
        ),
        (lively(), {"mode": "FBWA"}, "predict on the route", "0 s in a mode that follows a mission, 5 s are required"),
        (lively(), {"items": 0}, "predict on the route", "no mission list"),
        ({k: v for k, v in lively().items() if k != "leg"}, {}, "predict on the route", "MISSION_CURRENT"),
        ({k: v for k, v in lively().items() if k != "servo"}, {}, "predict by turn rate", "no servo rows"),
        ({k: v for k, v in lively().items() if k != "air"}, {}, "estimate wind", "no air rows"),
        (flights.turn(60, Va=2.0), {}, "estimate wind", "airspeed reaches 2.0 m/s"),
        (flights.turn(60, Va=2.0), {}, "identify lateral", "never in flight"),
    ],
)
def test_what_is_missing_is_said_with_figures(laid, more, name, words):
    can, why = judged(known(laid, **more))[name]
    assert not can
    assert words in why


def test_a_copter_is_still_predicted_by_its_turn_rate():
    told = judged(known(lively(), vehicle="multirotor"))
    assert told["predict by turn rate"][0]
    assert not told["verify"][0]
    assert told["estimate wind"] == (True, "from tilt and acceleration in 60 s of flight")
    hovers = {name: rows for name, rows in lively().items() if name not in ("velocity", "air")}
    assert judged(known(hovers, vehicle="multirotor"))["estimate wind"] == (False, "no velocity rows in the recording")


def test_slow_rows_that_the_twin_still_fills_are_a_yes_with_a_but():
    can, why = judged(known(slower(lively(), "attitude", 10)))["identify lateral"]
    assert can
    assert "attitude at 2.5 Hz" in why
    assert "servo map assumed" in why
