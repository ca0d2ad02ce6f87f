"""What one aircraft is warned of by itself: ground, fence, short horizon, missions it cannot fly; each once."""

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import norm

from fleet.contract import Alert, AlertKind, Array, Mission, Params, Prediction, Status
from fleet.frames import Origin
from fleet.mission import unroll_route
from tests.support import flights as f
from tests.support.flights import HERE, item, predictions
from tests.support.predicted import T, straight
from twin_worker.alerts.feasibility import FlightLimits, MissionState, feasibility_hazard, read_limits
from twin_worker.alerts.gaussian_forecast import axis_z, to_gaussian
from twin_worker.alerts.geofence import GeofenceLimits, geofence_hazard, ground_hazard, read_geofence
from twin_worker.alerts.hysteresis import RULES, AlertState, HazardEstimate
from twin_worker.twin.state.state import Twin, ingest
from twin_worker.twin.steps.alerts import prediction_alerts

NAN, INF = float("nan"), float("inf")
KINDS = tuple(RULES)

# --- the ledger -----------------------------------------------------------------------------------------------------


def found(p: float, kind: AlertKind = AlertKind.GROUND, other: int = -1) -> HazardEstimate:
    return HazardEstimate(kind, p, "danger", "over", other)


@given(st.sampled_from(KINDS), st.lists(st.one_of(st.floats(0, 1), st.just(NAN)), max_size=80))
def test_raised_and_withdrawn_take_turns_and_keep_their_distance(kind: AlertKind, chances: list[float]) -> None:
    ledger, told = AlertState(), []
    for k, p in enumerate(chances):
        told += ledger.update(7, T + k, found(p, kind))
        assert [a.kind for a in ledger.active] == [kind] * (len(told) % 2)
    assert [a.active for a in told] == [k % 2 == 0 for k in range(len(told))]
    rule, at = RULES[kind], [a.t for a in told]
    for k, alert in enumerate(told):
        before = chances[: int(alert.t - T) + 1]
        lasted = rule.raise_after_s if alert.active else rule.clear_after_s
        recent = np.nan_to_num(before[-int(lasted) - 1 :])
        assert (recent >= rule.raise_at).all() if alert.active else (recent < rule.clear_below).all()
        assert k == 0 or alert.t - at[k - 1] >= lasted


def test_between_the_two_thresholds_nothing_happens() -> None:
    ledger, rule = AlertState(), RULES[AlertKind.GROUND]
    middle = 0.5 * (rule.raise_at + rule.clear_below)
    assert not any(ledger.update(1, T + k, found(middle)) for k in range(20))
    assert sum(len(ledger.update(1, T + 20 + k, found(1.0))) for k in range(5)) == 1
    assert not any(ledger.update(1, T + 30 + k, found(middle)) for k in range(20))


@pytest.mark.parametrize(("ahead", "lasts"), [(10.0, 2), (30.0, 2), (60.0, 6), (180.0, 22)])
def test_what_lies_far_ahead_must_last(ahead: float, lasts: int) -> None:
    """Time to go runs down while it lasts."""
    ledger = AlertState()
    far = HazardEstimate(AlertKind.GROUND, 1.0, "danger", "over", predicted_t=T + ahead)
    raised = [k for k in range(60) if ledger.update(1, T + k, far)]
    assert raised == [lasts]


def test_a_clock_that_jumps_back_starts_the_wait_again() -> None:
    ledger = AlertState()
    assert ledger.update(1, T + 1000.0, found(1.0)) == []
    assert ledger.update(1, T, found(1.0)) == [] and ledger.update(1, T + 1, found(1.0)) == []
    assert len(ledger.update(1, T + 2, found(1.0))) == 1


# --- ground ---------------------------------------------------------------------------------------------------------

LOW = Origin(HERE.lat_e7, HERE.lon_e7, HERE.alt_mm)


def laid(made: Prediction):
    flight = to_gaussian(made)
    assert flight is not None
    return flight


@given(height=st.floats(40, 200), sigma=st.floats(1, 30), sink=st.floats(0, 1))
def test_sinking_has_its_closed_form(height: float, sigma: float, sink: float) -> None:
    made = straight(p=(0, 0, -height), v=(20.0, 0.0, sink), half=(5.0, 5.0, axis_z(0.9) * sigma))
    result = ground_hazard(laid(made), LOW, 30.0)
    assert result.probability == pytest.approx(norm.cdf((30.0 - height + 180 * sink) / sigma), abs=0.01)
    if result.probability > 0.6:
        assert result.predicted_t == pytest.approx(T + (height - 30) / sink, abs=2.1)
        assert result.position is not None and result.position.alt_mm - LOW.alt_mm == pytest.approx(30_000, abs=2_500)


def test_height_is_above_home_wherever_the_origin_is() -> None:
    made = straight(origin=(HERE.lat_e7, HERE.lon_e7, HERE.alt_mm - 80_000))
    assert ground_hazard(laid(made), LOW, 30.0).probability > 0.999
    assert ground_hazard(laid(straight()), LOW, 30.0).probability < 1e-6


# --- fence ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("params", "expected"),
    [
        ({}, GeofenceLimits()),
        ({"FENCE_ENABLE": 0.0, "FENCE_RADIUS": 300.0}, GeofenceLimits()),
        (
            {"FENCE_ENABLE": 1.0, "FENCE_TYPE": 3.0, "FENCE_RADIUS": 300.0, "FENCE_ALT_MAX": 120.0},
            GeofenceLimits(300.0, 120.0),
        ),
        (
            {"FENCE_AUTOENABLE": 1.0, "FENCE_TYPE": 1.0, "FENCE_RADIUS": 300.0, "FENCE_ALT_MAX": 120.0},
            GeofenceLimits(INF, 120.0),
        ),
        ({"FENCE_ENABLE": 1.0, "FENCE_TYPE": 8.0, "FENCE_ALT_MIN": -10.0}, GeofenceLimits(floor=-10.0)),
        ({"FENCE_ENABLE": 1.0, "FENCE_TYPE": NAN, "FENCE_RADIUS": NAN, "FENCE_ALT_MAX": -5.0}, GeofenceLimits()),
        ({"FENCE_ENABLE": 1.0, "FENCE_TYPE": 3.0, "FENCE_OPTIONS": NAN}, GeofenceLimits()),
        ({"FENCE_ENABLE": 1.0, "FENCE_TYPE": 1e30, "FENCE_RADIUS": INF, "FENCE_ALT_MIN": INF}, GeofenceLimits()),
        ({"GF_MAX_HOR_DIST": 500.0, "GF_MAX_VER_DIST": 0.0}, GeofenceLimits(500.0)),
    ],
)
def test_a_fence_is_read_from_parameters(params: dict, expected: GeofenceLimits) -> None:
    assert read_geofence(params) == expected
    assert read_geofence(params).any_limit() == (expected != GeofenceLimits())


def test_a_polygon_is_said_not_to_be_judged() -> None:
    params = {"FENCE_ENABLE": 1.0, "FENCE_TYPE": 6.0, "FENCE_TOTAL": 5.0, "FENCE_RADIUS": 1000.0}
    assert (
        "its 5 fence items were not received" in geofence_hazard(laid(straight()), read_geofence(params), LOW).message
    )


def test_leaving_a_circle_is_told_when_and_where() -> None:
    result = geofence_hazard(laid(straight(half=(4.0, 4.0, 4.0))), GeofenceLimits(1000.0), LOW)
    assert result.probability == 1.0 and result.predicted_t == pytest.approx(T + 52, abs=2.5)
    assert result.position is not None and "circle of 1000 m" in result.message and "in 5" in result.message
    assert geofence_hazard(laid(straight(half=(4.0, 4.0, 4.0))), GeofenceLimits(3700.0), LOW).probability == 0.0
    half = geofence_hazard(laid(straight(half=(60.0, 4.0, 4.0))), GeofenceLimits(3600.0), LOW)
    assert half.probability == pytest.approx(0.5, abs=0.05)


def test_ceiling_and_floor_are_told_apart() -> None:
    up, down = straight(v=(20.0, 0.0, -2.0)), straight(v=(20.0, 0.0, 0.5))
    assert "ceiling of 120 m" in geofence_hazard(laid(up), GeofenceLimits(ceiling=120.0), LOW).message
    assert "floor of 40 m" in geofence_hazard(laid(down), GeofenceLimits(floor=40.0), LOW).message


def test_already_outside_is_said_so() -> None:
    result = geofence_hazard(laid(straight(p=(500.0, 0.0, -100.0))), GeofenceLimits(300.0), LOW)
    assert result.probability == 1.0 and result.message.endswith("now")


# --- missions -------------------------------------------------------------------------------------------------------

ABLE = FlightLimits(20.0, 4.0, 3.0, np.radians(45.0), 80.0)


def judge(items, wind=(0.0, 0.0), able: FlightLimits = ABLE) -> HazardEstimate:
    way = unroll_route((item(0), *items), seq=1, origin=HERE, params={})
    return feasibility_hazard(MissionState(T, np.array([0.0, 0.0, -100.0]), HERE, np.array([*wind, 0.3]), way), able)


FAR = item(1, north=2000.0)


def test_an_ordinary_mission_is_achievable() -> None:
    circle = item(3, 18, north=2000.0, east=1500.0, param1=1.0, param3=80.0)
    assert judge((FAR, item(2, north=2000.0, east=1500.0, alt_m=160.0), circle), (5.0, -5.0)).probability < 0.01
    assert judge(()).probability == 0.0


@pytest.mark.parametrize("wind", [(-25.0, 0.0), (0.0, 25.0), (-21.0, 5.0)])
def test_a_wind_stronger_than_the_airspeed_is_told(wind: tuple[float, float]) -> None:
    result = judge((FAR,), wind)
    assert result.probability > 0.99 and "item 1" in result.message and "headway" in result.message


@pytest.mark.parametrize("odd", [np.inf, -np.inf, np.nan])
def test_without_an_estimate_of_the_wind_no_mission_is_judged(odd: float) -> None:
    result = judge((FAR,), (odd, 0.0))
    assert result.probability == 0.0 and not result.message


def test_a_wind_from_behind_carries_there_but_not_back() -> None:
    assert "the return to launch" in judge((FAR,), (25.0, 0.0)).message
    forever = item(2, 17, north=2000.0, param3=80.0)
    assert judge((FAR, forever), (25.0, 0.0)).probability < 0.01


@pytest.mark.parametrize(("alt_m", "word"), [(900.0, "climb"), (-500.0, "descent")])
def test_a_leg_too_steep_is_told(alt_m: float, word: str) -> None:
    result = judge((FAR, item(2, north=4000.0, alt_m=alt_m)))
    assert result.probability > 0.99 and word in result.message and "item 2" in result.message
    assert result.predicted_t == pytest.approx(T + 100.0, abs=1.0)  # when it gets there
    assert judge((FAR, item(2, north=9e3, alt_m=100.0 + (alt_m - 100.0) / 4))).probability < 0.01


def test_a_circle_too_tight_is_told() -> None:
    result = judge((item(1, 18, north=500.0, param1=2.0, param3=-30.0),))
    assert result.probability > 0.99 and "deg of bank" in result.message
    fast = (item(1, 178, param2=30.0), item(2, 18, north=500.0, param1=2.0, param3=80.0))
    assert judge(fast).probability > 0.99  # at 30 m/s 49 degrees
    assert judge(fast[1:]).probability < 0.01


def test_what_was_not_received_is_not_judged() -> None:
    nothing = FlightLimits(NAN, NAN, NAN, NAN, NAN)
    steep = (FAR, item(2, north=4000.0, alt_m=900.0), item(3, 18, north=9.0, param3=5.0))
    assert judge(steep, (-90.0, 0.0), nothing).probability == 0.0
    assert judge(steep, able=FlightLimits(20.0, NAN, NAN, NAN, NAN)).probability < 0.01
    assert all(np.isnan(read_limits({}, 500.0)))


def test_abilities_are_read_of_both_autopilots() -> None:
    ours = {"AIRSPEED_CRUISE": 20.0, "TECS_CLMB_MAX": 4.0, "TECS_SINK_MAX": 3.0, "ROLL_LIMIT_DEG": 45.0}
    theirs = {"FW_AIRSPD_TRIM": 20.0, "FW_T_CLMB_MAX": 4.0, "FW_T_SINK_MAX": 3.0, "FW_R_LIM": 45.0}
    for params in (ours | {"WP_LOITER_RAD": 80.0, "AIRSPEED_MIN": 9.0, "AIRSPEED_MAX": 30.0}, theirs):
        found_ = read_limits(params | {"NAV_LOITER_RAD": -80.0}, 0.0)
        assert found_ == pytest.approx(ABLE)


@given(st.lists(st.builds(
    item, st.integers(0, 9), st.sampled_from([16, 17, 18, 19, 20, 21, 22, 31, 177, 178]),
    north=st.sampled_from([0.0, 50.0, 1e4]), param1=st.sampled_from([0.0, NAN, -INF, 3.0]),
    param2=st.sampled_from([0.0, NAN, 1e30]), param3=st.sampled_from([0.0, NAN, INF, 60.0]),
    alt_m=st.sampled_from([0.0, NAN, 1e30, -400.0, 300.0])), max_size=8),
    st.tuples(*[st.sampled_from([0.0, NAN, 1e9, -30.0])] * 2))  # fmt: skip
def test_hostile_missions_are_judged_with_a_probability(items, wind) -> None:
    result = judge(items, wind)
    assert not result.probability < 0 and not result.probability > 1


# --- the watch of a twin --------------------------------------------------------------------------------------------


def flying(seconds: float = 61.0, **changes) -> Twin:
    """A twin above home whose aircraft is on its mission, and which has no model."""
    twin = Twin.of(7)
    for message in f.messages(f.turn(seconds), uav=7):
        ingest(twin, message)
    twin.telemetry.advance(f.T0 + seconds)
    status = Status(uav=7, t=f.T0, mode="AUTO", armed=True, autopilot="ardupilot", vehicle="fixed_wing")
    twin.onboard.status = msgspec.structs.replace(status, **changes)
    twin.onboard.mission = Mission(
        uav=7, t=f.T0, items=(item(0), item(1, north=2e3), item(2, north=4e3)), seq=1, complete=True
    )
    twin.onboard.params = Params(uav=7, t=f.T0)
    return twin


def alerts_of(twin: Twin, made: Prediction | None, seconds: int = 20, start: float = 0.0) -> list[Alert]:
    return [a for k in range(seconds) for a in prediction_alerts(twin, T + start + k, made)]


SINKING = straight(7, v=(20.0, 0.0, 1.0), seq=1)


def test_ground_is_told_once_and_taken_back_once() -> None:
    twin = flying()
    (raised,) = alerts_of(twin, SINKING)
    assert raised.kind is AlertKind.GROUND and raised.active and T + 5 < raised.t < T + 9
    assert raised.predicted_t == pytest.approx(T + 70, abs=2.1) and "terrain unknown" in raised.sentence
    (over,) = alerts_of(twin, straight(7), start=20.0)
    assert not over.active and over.t == T + 25


@pytest.mark.parametrize(
    "excuse",
    [
        lambda twin: setattr(twin.onboard, "status", msgspec.structs.replace(twin.onboard.status, mode="QLAND")),
        lambda twin: setattr(
            twin.onboard,
            "mission",
            msgspec.structs.replace(twin.onboard.mission, items=(item(0), item(1), item(2, 21))),
        ),
        lambda twin: setattr(twin.onboard, "mission", None),
    ],
    ids=["a landing mode", "a landing in the mission", "an unknown home"],
)
def test_a_landing_is_no_danger(excuse) -> None:
    twin = flying()
    excuse(twin)
    assert alerts_of(twin, SINKING) == []


def test_an_aircraft_that_was_never_up_is_taking_off() -> None:
    low = straight(7, p=(0.0, 0.0, -10.0))
    twin = flying()
    assert alerts_of(twin, low) == []
    assert alerts_of(twin, straight(7), start=20.0) == []
    (alert,) = alerts_of(twin, low, start=40.0)
    assert alert.kind is AlertKind.GROUND


def test_a_quadplane_that_leaves_its_rotors_below_the_height_of_wings_is_taking_off() -> None:
    twin = flying()
    twin.alerts.max_height_m = 20.0  # on rotors
    assert alerts_of(twin, straight(7, p=(0.0, 0.0, -24.0))) == []


def test_a_turn_rate_says_nothing_of_far_ground_nor_of_its_own_horizon() -> None:
    twin = flying(mode="FBWA")
    assert alerts_of(twin, msgspec.structs.replace(SINKING, method="imm", horizon_s=2.0, coverage_n=99)) == []
    near = straight(7, p=(0.0, 0.0, -40.0), v=(20.0, 0.0, 1.0), method="imm")
    assert [a.kind for a in alerts_of(twin, near, start=30.0)] == [AlertKind.GROUND]


def test_on_a_mission_a_turn_rate_waits_for_something_better() -> None:
    near = straight(7, p=(0.0, 0.0, -40.0), v=(20.0, 0.0, 1.0), method="imm")
    twin = flying()
    assert alerts_of(twin, near, 20) == []  # the twin of its route is about to come
    assert alerts_of(twin, straight(7), 1, start=20) == [] and alerts_of(twin, near, 20, start=21) == []
    assert [a.kind for a in alerts_of(twin, near, 9, start=41)] == [AlertKind.GROUND]  # it does not come


def test_a_fence_from_parameters_is_watched() -> None:
    twin = flying()
    twin.onboard.params = Params(uav=7, t=T, values={"FENCE_ENABLE": 1.0, "FENCE_TYPE": 2.0, "FENCE_RADIUS": 1500.0})
    (alert,) = alerts_of(twin, straight(7))
    assert alert.kind is AlertKind.GEOFENCE and alert.predicted_t == pytest.approx(T + 75, abs=4)


def test_a_new_aircraft_is_warned_of_what_is_near_until_it_has_a_model() -> None:
    twin, far = flying(20.0), straight(7, p=(0.0, 0.0, -75.0), v=(20.0, 0.0, 1.0), seq=1)
    near = straight(7, p=(0.0, 0.0, -45.0), v=(20.0, 0.0, 1.0), seq=1)
    assert alerts_of(twin, far) == []
    assert [a.kind for a in alerts_of(flying(20.0), near)] == [AlertKind.GROUND]
    assert [a.kind for a in alerts_of(flying(61.0), far)] == [AlertKind.GROUND]


def test_home_is_item_0_or_where_it_stood() -> None:
    twin = flying()
    assert twin.home == HERE
    twin.onboard.status = msgspec.structs.replace(twin.onboard.status, autopilot="px4")
    assert twin.home is None
    twin.onboard.status = msgspec.structs.replace(twin.onboard.status, armed=False)
    alerts_of(twin, None, 1)
    stood = twin.home
    assert stood is not None and abs(stood.alt_mm - HERE.alt_mm - 100_000) < 100


def test_a_short_horizon_must_last_and_be_measured() -> None:
    short = straight(7, horizon_s=6.0, early_exceedance=0.7, coverage_n=40)
    assert (
        alerts_of(flying(), short, 15) == []
        and alerts_of(flying(), msgspec.structs.replace(short, coverage_n=5), 60) == []
    )
    twin = flying()
    (alert,) = alerts_of(twin, short, 30)
    assert alert.kind is AlertKind.SHORT_HORIZON and alert.t == T + 15 and "probability of 70%" in alert.sentence
    assert (
        alerts_of(twin, msgspec.structs.replace(short, early_exceedance=0.4), 30, start=30) == []
    )  # not yet low enough
    (over,) = alerts_of(twin, msgspec.structs.replace(short, early_exceedance=0.1), 30, start=60)
    assert not over.active


def test_a_mission_against_the_wind_is_told() -> None:
    twin = flying()
    steep = (item(0), item(1, north=300.0), item(2, north=900.0, alt_m=700.0))
    twin.onboard.mission = msgspec.structs.replace(twin.onboard.mission, items=steep)
    names = ("AIRSPEED_CRUISE", "AIRSPEED_MIN", "AIRSPEED_MAX", "TECS_CLMB_MAX", "TECS_SINK_MAX")
    twin.onboard.params = Params(uav=7, t=T, values=dict(zip(names, (20.0, 14.0, 28.0, 4.0, 4.0), strict=True)))
    (alert,) = alerts_of(twin, straight(7), 30)
    assert alert.kind is AlertKind.NOT_ACHIEVABLE and "item 2" in alert.sentence and alert.lat is not None
    twin.onboard.mission = msgspec.structs.replace(twin.onboard.mission, items=steep[:2])
    assert [a.active for a in alerts_of(twin, straight(7), 30, start=30)] == [False]


def test_a_flight_without_predictions_withdraws_what_they_warned_of() -> None:
    twin = flying()
    alerts_of(twin, SINKING)
    (over,) = alerts_of(twin, None, start=20.0)
    assert over.kind is AlertKind.GROUND and not over.active and "no longer predicted" in over.sentence


def test_hostile_numbers_raise_nothing() -> None:
    twin = flying()
    twin.onboard.params = Params(uav=7, t=T, values={"FENCE_ENABLE": 1.0, "FENCE_RADIUS": NAN, "TECS_CLMB_MAX": NAN})
    nowhere = item(0, alt_m=1e30)
    twin.onboard.mission = msgspec.structs.replace(twin.onboard.mission, items=(nowhere, item(1, alt_m=NAN)))
    broken = msgspec.structs.replace(
        SINKING, path=Array.of(np.full((3, 3), NAN)), horizon_s=NAN, early_exceedance=NAN, coverage_n=99
    )
    assert alerts_of(twin, broken, 30) == []


def test_a_pretend_flight_is_warned_of_nothing(flown) -> None:
    """Two minutes of an ordinary mission; its horizon is not measured yet."""
    assert len(predictions(flown[1])) > 60 and not [m for m in flown[1] if isinstance(m, Alert)]
