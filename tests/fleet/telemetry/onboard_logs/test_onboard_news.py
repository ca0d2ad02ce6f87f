"""An onboard log of any kind becomes the same news as a radio would have brought."""

import numpy as np
import pytest

from fleet.contract import Mission, Params, Sample, Status
from fleet.telemetry.mavlink.onboard_log import Chunk, OnboardEvent
from fleet.telemetry.onboard_logs.onboard_news import DEFAULT_EPOCH_S, aircraft_of, log_steps
from tests.support.flights import item
from tests.support.talker import of

ITEMS = (item(0), item(1, north=500.0), item(2, north=500.0, east=500.0))


class Log:
    """A made-up log of 40 s in two chunks: attitude at 10 Hz, the item in force only where it changes."""

    name, system, autopilot, vehicle, firmware = "made-up", 4, "ardupilot", "fixed_wing", "ArduPlane V4.5"
    epoch_s: float | None = 1.7e9
    skipped = ()

    def chunks(self):
        legs = (([0.5, 12.3], [1, 2]), ([33.0], [3]))
        said = (
            [
                OnboardEvent(0.1, "param", ("AIRSPEED_CRUISE", 22.0)),
                OnboardEvent(0.2, "mission", ITEMS),
                OnboardEvent(0.3, "mode", "AUTO"),
                OnboardEvent(5.0, "armed", True),
            ],
            [OnboardEvent(21.0, "text", (2, "engine failure")), OnboardEvent(30.0, "mode", "RTL")],
        )
        for k, (when, seq) in enumerate(legs):
            t = 20.0 * k + np.arange(0, 20, 0.1)
            rows = {"attitude": (t, np.full((200, 6), 0.1)), "leg": (np.array(when), np.array(seq, float)[:, None])}
            yield Chunk(rows, said[k], {"ATT": 200, "MODE": 1})


@pytest.fixture(scope="module")
def news():
    log = Log()
    return [n for _, step in log_steps(log, aircraft_of(log, offset=-1)) for n in step]


def rows(news, field):
    parts = [getattr(s, field) for s in of(Sample, news) if getattr(s, field) is not None]
    return tuple(np.concatenate([getattr(p, k).numpy() for p in parts]) for k in "tx")


def test_rows_come_in_time_in_small_steps(news):
    t, x = rows(news, "attitude")
    assert t - 1.7e9 == pytest.approx(np.arange(0, 40, 0.1), abs=1e-6)
    assert x.shape == (400, 6)
    assert {n.uav for n in news} == {3}
    assert max(len(s.attitude.t.numpy()) for s in of(Sample, news) if s.attitude) <= 2


def test_the_item_in_force_is_said_once_a_second(news):
    t, x = rows(news, "leg")
    assert (np.diff(t) > 0).all()
    assert np.diff(t).max() <= 1.0 + 1e-6
    for since, seq in ((1.0, 1), (12.0, 1), (13.0, 2), (32.0, 2), (34.0, 3)):
        assert x[np.searchsorted(t, 1.7e9 + since, side="right") - 1, 0] == seq


def test_what_is_said_reaches_status_mission_and_parameters(news):
    seen = [(s.t - 1.7e9, s.mode, s.armed) for s in of(Status, news)]
    assert next(mode for t, mode, _ in seen if 1 < t < 29) == "AUTO"
    assert seen[-1][1:] == ("RTL", True)
    assert not next(armed for t, _, armed in seen if t > 1)
    assert any("engine failure" in s.sentence for s in of(Status, news))
    assert of(Mission, news)[-1].items == ITEMS and of(Mission, news)[-1].complete
    assert of(Params, news)[-1].values == {"AIRSPEED_CRUISE": 22.0}
    assert of(Status, news)[-1].rates_hz["ATT"] == pytest.approx(10.0, rel=0.3)
    assert of(Status, news)[-1].missed == 0


def test_a_log_without_a_date_begins_in_the_year_2000():
    log = Log()
    log.epoch_s = None
    first = next(n for _, step in log_steps(log, aircraft_of(log, 0)) for n in step if isinstance(n, Sample))
    assert first.t == pytest.approx(DEFAULT_EPOCH_S, abs=1.0)
