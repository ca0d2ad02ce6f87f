"""Which law the twin flies: the autopilot's own, the one that asks for the same banks, or none."""

from math import radians

import numpy as np
import pytest

from fleet.autopilots import laws
from fleet.window import Window
from tests.support.flights import HERE, remembered
from tests.support.point_mass import PLANE, Plane, begin, fly, leg, route
from twin_worker.estimation.wind_filter import WindFilter
from twin_worker.prediction import autopilot_identification as learning
from twin_worker.prediction.autopilot_identification import AutopilotEstimate, identify_autopilot, law_in_force
from twin_worker.prediction.replay_window import AutopilotConfig, PredictionContext, ReplayWindow

OURS = {
    "arduplane": PLANE | {"NAVL1_PERIOD": 15},
    "px4": {"FW_AIRSPD_TRIM": 20, "FW_AIRSPD_MIN": 12, "FW_AIRSPD_MAX": 28, "FW_THR_TRIM": 0.5, "NPFG_PERIOD": 12},
    "px4_l1": {"FW_AIRSPD_TRIM": 20, "FW_AIRSPD_MIN": 12, "FW_AIRSPD_MAX": 28, "FW_THR_TRIM": 0.5, "FW_L1_PERIOD": 16},
    "textbook": {"Va_c": 20.0, "k_path": 0.03},
}
LAP = [(700.0, 0.0), (700.0, 500.0), (0.0, 500.0), (0.0, 0.0), (700.0, 0.0), (700.0, 900.0)]


def flown(law: str, banks=None, **more: float) -> ReplayWindow:
    """Give a minute of a lap flown by `law` in calm air, as a replay takes it."""
    par, _ = laws.parameters(law, {**OURS[law], **more})
    legs, plane = route(*(leg(n=n, e=e) for n, e in LAP)), Plane()
    rows, _ = fly(legs, plane, 60.0, par, ctl=begin(legs, plane, par, (0, 0, -100)))
    n = len(rows)
    parts = (rows[:, 0], rows[:, 1:4], rows[:, 4:7], rows[:, 7:10], np.zeros((n, 3)), rows[:, 10])
    phi_c = rows[:, 11] if banks is None else banks(rows[:, 0])
    told = (*parts, phi_c, rows[:, 12], np.column_stack([np.full((n, 3), np.nan), rows[:, 13]]))
    good = Window(rows[:, 0], np.zeros((n, 9)), np.zeros((n, 4)), *parts[1:3], np.ones(n, bool), np.zeros(n, bool))
    start = np.array([0.0, 0.0, -100.0])
    return ReplayWindow(
        good, good, legs, start, tuple(map(np.ascontiguousarray, told)), rows[:, 14].astype(np.int64), 0.0, ""
    )


@pytest.fixture
def learn(monkeypatch: pytest.MonkeyPatch):
    """Learn from what was heard, as an autopilot that calls itself so and sent these parameters."""

    def learnt(heard: ReplayWindow, autopilot: str, params: dict[str, float]) -> AutopilotEstimate:
        monkeypatch.setattr(learning, "replay_inputs", lambda now: heard)
        now = PredictionContext(heard.window, remembered([]), AutopilotConfig((), params, 0.0), WindFilter(), HERE)
        found = AutopilotEstimate()
        identify_autopilot(found, autopilot, now)
        return found

    return learnt


@pytest.mark.parametrize("with_params", [True, False])
@pytest.mark.parametrize("law", ["arduplane", "px4", "textbook"])
def test_a_stranger_is_given_the_law_that_asks_for_its_banks(learn, law, with_params):
    found = learn(flown(law), "generic", OURS[law] if with_params else {})
    assert found.law == law
    assert "autopilot generic: control law " + laws.LAWS[law].description in found.reason
    assert min(found.bank_error, key=found.bank_error.get) == law


def test_parameters_not_received_are_read_off_the_flight(learn):
    found = learn(flown("px4", NPFG_PERIOD=13, FW_R_LIM=35), "generic", {})
    assert found.law == "px4"
    assert found.values["NPFG_PERIOD"] == pytest.approx(13, abs=2)
    assert found.values["FW_R_LIM"] == pytest.approx(35, abs=1)
    assert found.values["FW_AIRSPD_TRIM"] == pytest.approx(20, abs=1)


@pytest.mark.parametrize(("autopilot", "law"), [("ardupilot", "arduplane"), ("px4", "px4")])
def test_an_autopilot_that_says_what_it_is_flies_its_own_law(learn, autopilot, law):
    found = learn(flown("textbook"), autopilot, OURS[law])  # whatever it did
    assert (found.law, found.reason) == (law, "")


@pytest.mark.parametrize("law", ["px4", "px4_l1"])
def test_without_parameters_the_banks_tell_the_release_of_px4(learn, law):
    found = learn(flown(law), "px4", {})
    period = next(name for name in OURS[law] if name.endswith("PERIOD"))
    assert found.law == law
    assert found.values[period] == pytest.approx(OURS[law][period], abs=2)
    assert law_in_force("px4", {}, found.law) == law


@pytest.mark.parametrize(
    ("params", "law"),
    [
        ({"FW_L1_PERIOD": 18.0}, "px4_l1"),
        ({"NPFG_PERIOD": 10.0}, "px4"),
        ({"NPFG_PERIOD": 10.0, "FW_L1_PERIOD": 18.0}, "px4"),
        ({"NPFG_PERIOD": 10.0, "FW_L1_PERIOD": 18.0, "FW_USE_NPFG": 0.0}, "px4_l1"),
        ({}, "px4"),
    ],
)
def test_received_parameters_tell_the_release_of_px4(learn, params, law):
    assert law_in_force("px4", params, "") == law
    assert learn(flown("px4", banks=lambda t: np.full(len(t), np.nan)), "px4", params).law == law


def test_banks_that_no_law_asks_for_leave_none(learn):
    found = learn(flown("px4", banks=lambda t: 0.6 * np.sin(0.8 * t)), "generic", {})
    assert found.law == "" and "no known control law matches the commanded banks" in found.reason


@pytest.mark.parametrize("bank", [np.nan, radians(3)])
def test_without_a_turn_no_law_can_be_told(learn, bank):
    found = learn(flown("px4", banks=lambda t: np.full(len(t), bank)), "unknown", {})
    assert found.law == "" and "control law unknown" in found.reason
