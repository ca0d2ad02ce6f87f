"""What a twin does when the link goes, and with everything nobody should send: it says so, and nothing breaks."""

import msgspec
import numpy as np
import pytest

from fleet.contract import EVENT_TEXTS, Alert, AlertKind, Event, Link, Mission, Sample, TwinState
from tests.support import flights as f
from tests.support.flights import HERE, ROUTE, drive, item, predictions, published, shifted, status
from twin_worker.twin.step import Twin, advance, fleet_row

# --- the link --------------------------------------------------------------------------------------------------------


def test_a_lost_link_coasts_up_to_the_horizon_says_its_age_and_comes_back(twin, heard, sighted):
    end = twin.telemetry.history.newest
    results = []
    for k in range(1, int(sighted) + 6):
        results += published(advance(twin, (), end + k))
    (alert,) = [r for r in results if isinstance(r, Alert) and r.kind is AlertKind.LINK_LOST]
    assert alert.active and alert.sentence.startswith("uav-1: no samples;")
    *coasting, last = [p for p in predictions(results) if p.coast_s]
    assert int(sighted) - 5 <= len(coasting) <= int(sighted)
    assert all(p.state is TwinState.LINK_LOST and p.event is Event.LINK_LOST and p.event_t > end for p in coasting)
    ages = [p.coast_s for p in coasting]
    assert ages == sorted(ages) and ages[-1] == pytest.approx(sighted, abs=1.5)
    assert all("link lost" in p.sentence and " ago" not in p.sentence for p in coasting)
    assert coasting[-1].t == pytest.approx(end + ages[-1], abs=1.0)  # it flies on
    assert all(0.0 < p.horizon_s <= sighted for p in coasting)
    tubes = [p.prediction_region_half_axes.numpy() for p in coasting if p.method == coasting[-1].method]
    grown = tubes[-1][:60].mean(axis=0) / tubes[0][:60].mean(axis=0)  # height control ends the growth of the third
    assert (grown[:2] > 1.0).all() and grown[2] > 0.9 and tubes[-1][0, 0] > 1.5 * tubes[0][0, 0]
    assert fleet_row(twin, end + 15.0).state is TwinState.LINK_LOST

    assert last.event is Event.COASTING_EXPIRED and last.horizon_s == 0.0 and last.state is TwinState.LINK_LOST
    assert "the confidence horizon is over" in last.sentence and last.coast_s == pytest.approx(sighted, abs=1.5)
    assert last.event_text.startswith(EVENT_TEXTS[Event.COASTING_EXPIRED])

    results = drive(twin, shifted(heard, end + 18.0 - f.T0, 3.0))
    (alert,) = [r for r in results if isinstance(r, Alert) and r.kind is AlertKind.LINK_LOST]
    assert not alert.active and "link back" in alert.sentence
    back = predictions(results)[-1]
    assert back.coast_s == 0.0 and twin.prediction.state is not TwinState.LINK_LOST
    assert back.event is Event.LINK_RESTORED and EVENT_TEXTS[Event.LINK_RESTORED] in back.event_text


def test_a_loss_beyond_the_horizon_is_told_of_before_the_end_of_it(twin):
    end = twin.telemetry.history.newest
    results = [r for k in range(1, 200) for r in published(advance(twin, (), end + k))]
    told = list(dict.fromkeys(p.event for p in predictions(results)))
    assert told[-2:] == [Event.LINK_LOST, Event.COASTING_EXPIRED]


def test_the_gateway_may_know_first(twin):
    end = twin.telemetry.history.newest
    results = list(advance(twin, [status(twin, link=Link.LOST)], end + 1.5))
    assert [r.active for r in results if isinstance(r, Alert)] == [True]


def test_a_link_lost_before_anything_was_learnt_is_lost_all_the_same():
    twin = Twin.of(4)
    drive(twin, f.messages(f.turn(1.5), uav=4))
    advance(twin, (), twin.telemetry.history.newest + 10.0)
    assert fleet_row(twin, 0.0).state is TwinState.LINK_LOST


def test_a_link_lost_for_a_day_is_not_flown_for_a_day(twin):
    end = twin.telemetry.history.newest
    results = published(advance(twin, (), end + 86_400.0))
    assert [r for r in results if isinstance(r, Alert)]
    assert [(p.event, p.horizon_s) for p in predictions(results)] == [(Event.COASTING_EXPIRED, 0.0)]
    assert not published(advance(twin, (), end + 2 * 86_400.0))
    row = fleet_row(twin, end + 86_400.0)
    assert row.state is TwinState.LINK_LOST and row.prediction_age_s > 80_000


# --- hostile ---------------------------------------------------------------------------------------------------------

NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize("value", [NAN, INF, -1e300, 1e300, 0.0])
def test_absurd_parameters_never_raise(twin, value):
    assert twin.onboard.params is not None
    absurd = msgspec.structs.replace(twin.onboard.params, values=dict.fromkeys(twin.onboard.params.values, value))
    twin.onboard.plan_changed_t = -np.inf
    twin.onboard.params = absurd  # as if it had come long ago
    published(advance(twin, [absurd], twin.telemetry.history.newest))
    twin.onboard.plan_changed_t = -np.inf
    published(advance(twin, (), twin.telemetry.history.newest + 4.0))


@pytest.mark.parametrize(
    "items",
    [
        (item(0),),
        (item(0), item(1, 177, param1=1.0, param2=-1.0)),
        (item(0), item(1, 177, param1=2.0, param2=-1.0), item(2, 177, param1=1.0, param2=-1.0)),
        (item(0), item(1, north=100.0), item(2, north=100.0), item(3, 177, param1=1.0, param2=-1.0)),
        (item(0), item(1, param1=NAN, param2=INF, param3=NAN, param4=NAN, alt_m=NAN)),
        (item(0), item(1, 16, alt_m=1e300), item(2, 22), item(3, 21)),
    ],
)
def test_hostile_missions_never_raise(twin, items):
    drive(twin, [Mission(uav=1, t=twin.telemetry.history.newest, items=items)])
    twin.onboard.plan_changed_t = -np.inf
    results = published(advance(twin, (), twin.telemetry.history.newest + 1.5))
    assert predictions(results)
    assert all(p.method in ROUTE or p.sentence for p in predictions(results))


@pytest.mark.parametrize("value", [NAN, INF, -INF, 1e300, -1e38, 1e9, 9e4, 0.0])
@pytest.mark.parametrize("kind", ["attitude", "velocity", "position", "servo", "air", "command", "leg"])
def test_hostile_rows_never_raise(twin, kind, value):
    laid = f.turn(3.0)
    wide = len(laid[kind][1][0])
    end = twin.telemetry.history.newest
    laid = {k: (t - f.T0 + end, x) for k, (t, x) in laid.items()}
    laid[kind] = (laid[kind][0], np.full((len(laid[kind][0]), wide), value))
    batch = [f.sample(1, end + 3.0, **laid)]
    published(advance(twin, batch, end + 3.0))
    published(advance(twin, (), end + 8.0))
    fresh = Twin.of(1)
    published(advance(fresh, batch, end + 3.0))
    assert fresh.telemetry.origin is None or abs(fresh.telemetry.origin.lat_e7) <= 9e8


def test_a_position_that_lies_is_no_origin():
    for x in (f.rows([f.T0], [[NAN, 1.0, 2.0]]), f.rows([f.T0], [[1.0]]), f.rows(np.empty(0), np.empty((0, 3)))):
        twin = Twin.of(1)
        advance(twin, [Sample(uav=1, t=f.T0, position=x)], f.T0)
        assert twin.telemetry.origin is None
    advance(twin, [f.sample(1, position=([f.T0], [list(HERE)]))], f.T0)
    assert twin.telemetry.origin == HERE
