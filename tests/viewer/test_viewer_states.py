"""What is wrong with the picture as a whole, said in words: no router, too many UAVs, damaged recordings, no fleet."""

import threading
from pathlib import Path
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
from rich.console import Console

from fleet.commands.live.status import fleet_table
from fleet.contract import (
    FleetRow,
    FleetState,
    GatewayCounters,
    LinkCounters,
    Outcome,
    Status,
    TwinState,
    claimed_horizon_s,
)
from gateway.link_spec import read_spec
from gateway.links.recorded import ReplayLink
from gateway.pipeline import Pipeline
from tests.gateway.test_gateway import flight
from tests.support.memory_bus import MemoryBus
from tests.support.pretend_feed import HOSTILE, STAMP, Clock, PretendUav, T, feed_of
from viewer.panels.charts import band
from viewer.panels.detail import figures_html, limitations, status_html
from viewer.scene.camera import set_initial_view
from viewer.scene.fleet_arrays import display_status
from viewer.scene.ground import RINGS_M
from viewer.scene.labels import CameraView
from viewer.scene.selection.selected import selection_text
from viewer.store import store as feeds
from viewer.store.place import UNIT_M
from viewer.store.states import MAX_TEXT, notices
from viewer.store.store import FleetStore
from viewer.store.vehicle import Vehicle
from viewer.text.words import empty_html, horizon_text, status_label, summary_html
from viewer.theme.palette import DARK, STATUS_COLOURS


@pytest.fixture
def clock() -> Clock:
    return Clock()


class Adrift(MemoryBus):
    router = ""


def damaged(sentence: str, link: str = "replay:flight.tlog?speed=4") -> GatewayCounters:
    return GatewayCounters(t=T, links=(link,), per_link=(LinkCounters(link=link, sentence=sentence),))


def test_a_router_that_is_away_is_said_with_its_seconds_and_forgotten_when_it_is_back(clock: Clock) -> None:
    feed = FleetStore(bus := Adrift(), clock)
    assert "No router</b> for 0 s" in notices(feed, "", DARK, 50.0)
    assert "for 12 s" in notices(feed, "", DARK, 62.0)
    bus.router = "back"
    assert notices(feed, "", DARK, 63.0) == "" == notices(FleetStore(MemoryBus(), clock), "", DARK, 63.0)
    bus.router = ""
    assert "for 0 s" in notices(feed, "", DARK, 70.0)


def test_more_uavs_than_fit_are_counted_once_each(clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(feeds, "MAX_VEHICLES", 3)
    monkeypatch.setattr(feeds, "MAX_AWAY", 4)
    feed, _, bus = feed_of(clock, 3)
    for _ in range(3):
        for uav in (7, 8, 5_000_000, -1, 9, 10):
            bus.publish(Status(uav=uav, t=T))
    assert len(feed.vehicles) == 3 and len(feed.rejected_uavs) == 4
    said = notices(feed, "", DARK, clock.now)
    assert "Too many UAVs" in said and ", 4 more are received" in said
    assert "3 UAVs" in summary_html(feed.all(), feed, DARK, clock.now)


def test_what_could_not_be_read_of_a_recording_is_said_and_escaped(clock: Clock) -> None:
    feed, _, bus = feed_of(clock, 1)
    bus.publish(damaged(f"flight.tlog: 73750 damaged bytes skipped {HOSTILE} {'x' * 10_000}"))
    said = notices(feed, "", DARK, clock.now)
    assert "Recording damaged" in said and "73750 damaged bytes" in said
    assert "<img" not in said and len(said) < 3 * MAX_TEXT
    bus.publish(damaged(""))
    assert notices(feed, "", DARK, clock.now) == ""


def test_a_damaged_recording_reaches_the_page(clock: Clock, tmp_path: Path) -> None:
    path = tmp_path / "flight.tlog"
    good = bytearray(flight(10.0))
    good[len(good) // 3 : len(good) // 3 + 900] = b"\x07" * 900
    path.write_bytes(good)
    feed = FleetStore(bus := MemoryBus(), clock)
    Pipeline([ReplayLink(read_spec(f"replay:{path}?speed=max"))], bus).run(threading.Event())
    said = notices(feed, "", DARK, clock.now)
    assert (
        "Recording damaged</b>: flight.tlog: " in said and "damaged bytes skipped" in said and len(feed.vehicles) == 1
    )


def test_links_without_end_are_bounded(clock: Clock) -> None:
    feed, _, bus = feed_of(clock, 1)
    for k in range(500):
        bus.publish(damaged("late", f"udpin:0.0.0.0:{k}"))
    assert len(feed.links) == feeds.MAX_LINKS and "<b>Link</b>: late" in notices(feed, "", DARK, clock.now)


def test_no_fleet_is_said_with_what_is_received_and_what_to_check(clock: Clock) -> None:
    feed = FleetStore(MemoryBus(), clock)
    clock.now += 42
    page = empty_html(feed, clock.now)
    assert all(
        text in page for text in ("No aircraft yet", "parauav/@fleet/sample/*", "42 s", "0 messages", "`fleet up`")
    )
    assert "start `twin_worker`" in page and "none found yet; its first start compiles" in page


def test_an_empty_page_describes_gateway_and_worker_from_their_messages(clock: Clock) -> None:
    feed = FleetStore(bus := MemoryBus(), clock)
    counters = GatewayCounters(t=T, links=("udpin:127.0.0.1:14550",), sentence="no aircraft received yet")
    bus.publish(counters)
    bus.publish(FleetState(t=0.0, sentence="compiling <b>"))
    page = empty_html(feed, clock.now)
    assert "running (udpin:127.0.0.1:14550); no aircraft received yet" in page and "compiling &lt;b&gt;" in page
    assert "2 messages, none with the position of an aircraft" in page and "none found" not in page
    bus.publish(msgspec.structs.replace(counters, uavs=(3, 4), sentence=""))
    bus.publish(FleetState(t=T))
    assert "2 aircraft send, none has sent a position yet" in empty_html(feed, clock.now)


def test_an_aircraft_whose_worker_compiles_says_so(clock: Clock) -> None:
    vehicle = Vehicle(0)
    vehicle.sample_received = clock.now
    assert "`twin_worker` compiles for a minute" in " ".join(limitations(vehicle, clock.now))
    texts = limitations(vehicle, clock.now, ["compiling, 20 s so far"])
    assert texts == ["Its twin is not ready: compiling, 20 s so far."]


def test_ten_thousand_letters_of_status_are_cut_and_words_stay_words(clock: Clock) -> None:
    feed, _, bus = feed_of(clock, 1)
    bus.publish(Status(uav=0, t=T + 1, mode=HOSTILE * 50, sentence=HOSTILE + "y" * 10_000))
    page = status_html(feed.get(0), DARK, clock.now)
    assert "<img" not in page and "yyy" in page and len(page) < 4_000


def test_identifying_says_why_there_is_no_horizon_and_for_how_long(clock: Clock) -> None:
    feed, _, bus = feed_of(clock, 2)
    uav = PretendUav(1)
    for k in range(1, 46):
        clock.now += 1
        bus.publish(uav.sample(T + k - 1, T + k))
        bus.publish(uav.model(T + k), STAMP)
    page = status_html(feed.get(1), DARK, clock.now)
    assert "No horizon yet" in page and "window has 41 samples" in page and "after 45 s of telemetry" in page


def test_who_is_lost_is_not_said_to_have_a_slow_worker(clock: Clock) -> None:
    feed, _, bus = feed_of(clock, 1)
    bus.publish(PretendUav(0).prediction(T, 0.0), STAMP)
    for k in range(1, 8):
        clock.now += 1.0
        bus.publish(PretendUav(0).sample(T + k - 1, T + k))
    behind = status_html(feed.get(0), DARK, clock.now)
    assert "is overloaded; assign fewer" in behind and "recording" not in behind
    clock.now += 5.0
    lost = status_html(feed.get(0), DARK, clock.now)
    assert "12 s old." in lost and "No sample for 5 s" in lost and "overloaded" not in lost


def test_an_empty_page_looks_at_the_ground_and_its_first_ring() -> None:
    server = SimpleNamespace(initial_camera=SimpleNamespace())
    set_initial_view(server)
    start, turn = server.initial_camera, np.linspace(0.0, 2 * np.pi, 40)
    ring = RINGS_M[0] / UNIT_M * np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=-1)
    spots, depth = CameraView(start.position, start.look_at, start.fov, 1.0).project(ring)
    assert (depth > 0).all() and (np.abs(spots) < 0.5).all() and np.ptp(spots[:, 0]) > 0.3


def test_the_newest_verification_says_which_fit_the_predictions_use(clock: Clock) -> None:
    feed, _, bus = feed_of(clock, 1)
    model = PretendUav(0).model(T + 1)
    assert model.active_verdict is not None
    bus.publish(model, STAMP)
    assert "earlier model" not in status_html(feed.vehicles[0], DARK, clock.now)
    earlier = msgspec.structs.replace(model.active_verdict, fit={"u": 2.0, "w": 4.0})
    bus.publish(msgspec.structs.replace(model, t=T + 2, active_verdict=earlier), STAMP)
    page = status_html(feed.vehicles[0], DARK, clock.now)
    assert (
        "predictions use an earlier model, whose own verification had fit 3 %" in page
        and "3 %" in page.split("newest verification")[0]
    )


@pytest.mark.parametrize(
    ("fit", "horizon_s", "text", "colour", "told"),
    [
        (88.0, 34.0, "verified", DARK.verified, "measured on past predictions."),
        (8.0, 34.0, "low fit", DARK.predicting, "although the model alone is inaccurate"),
        (88.0, 6.0, "short horizon", DARK.predicting, "wind, route or control law are not"),
    ],
)
def test_a_verified_model_is_green_only_with_fit_and_horizon(
    clock: Clock, fit: float, horizon_s: float, text: str, colour: str, told: str
) -> None:
    feed, _, bus = feed_of(clock, 5)
    one = PretendUav(4)
    verdict = msgspec.structs.replace(one.model(T).verdict, fit={"u": fit})
    bus.publish(msgspec.structs.replace(one.model(T + 1), verdict=verdict, active_verdict=verdict), STAMP)
    bus.publish(msgspec.structs.replace(one.prediction(T + 1, 0.0), horizon_s=horizon_s), STAMP)
    vehicle = feed.get(4)
    label = status_label(vehicle, DARK, clock.now)
    assert (label.text, label.colour) == (text, colour)
    assert STATUS_COLOURS[display_status(vehicle, clock.now)] == ("verified" if text == "verified" else "predicting")
    page = status_html(vehicle, DARK, clock.now)
    assert told in page and "without the route" in page and f"{horizon_s:.0f} s" in page
    assert (f"border-color:{DARK.verified}" in page) == (fit > 50)


def test_a_plausible_model_has_its_own_colour_and_a_verified_one_its_power(clock: Clock) -> None:
    feed, _, bus = feed_of(clock, 5)
    one = PretendUav(4)
    text = "uav-4: fit 88 %; consistent, would have detected an error of 14 % in aileron effectiveness"
    verified = msgspec.structs.replace(
        one.model(T).verdict,
        outcome=Outcome.VERIFIED,
        sentence=text,
        detectable_error={"aileron_effectiveness": 14.2, "<b>": 20.0},
    )
    plausible = msgspec.structs.replace(verified, outcome=Outcome.PLAUSIBLE, detectable_error={})
    for k, (verdict, state) in enumerate(((plausible, TwinState.PLAUSIBLE), (verified, TwinState.VERIFIED))):
        bus.publish(msgspec.structs.replace(one.model(T + 1 + k), verdict=verdict, active_verdict=verdict), STAMP)
        bus.publish(msgspec.structs.replace(one.prediction(T + 1 + k, 0.0), state=state, horizon_s=34.0), STAMP)
        vehicle, colour = feed.get(4), DARK.plausible if k == 0 else DARK.verified
        vehicle.row = msgspec.structs.replace(vehicle.row, state=state)
        label, page = status_label(vehicle, DARK, clock.now), status_html(vehicle, DARK, clock.now)
        assert (label.text, label.colour) == (state.value, colour) and f"border-color:{colour}" in page
        assert STATUS_COLOURS[display_status(vehicle, clock.now)] == state.value
        figures = figures_html(vehicle, clock.now)
        assert ("would have detected an error of: aileron effectiveness 14 %, &lt;b&gt; 20 %" in figures) == (k == 1)
    assert "would have detected an error of 14 % in aileron effectiveness" in page


def test_a_horizon_that_has_passed_is_none_everywhere(clock: Clock) -> None:
    feed, _, bus = feed_of(clock, 1)
    bus.publish(msgspec.structs.replace(PretendUav(0).prediction(T + 1, 0.0), horizon_s=4.0), STAMP)
    assert feed.get(0).record(clock.now).horizon_s == 4.0
    assert np.isfinite(band(feed.get(0), np.zeros((0, 30)), clock.now)[3]).any()
    clock.now += 9.0
    record = feed.get(0).record(0.0)  # a snapshot has its own instant
    assert record.horizon_s == 0.0 and horizon_text(record) == "–" and record.prediction_age_s > 5.0
    assert "link lost 9 s" in selection_text(feed.get(0), clock.now) and "prediction" in selection_text(feed.get(0), 0)
    assert np.isnan(band(feed.get(0), np.zeros((0, 30)), clock.now)[3]).all()  # no line at a horizon


@pytest.mark.parametrize(
    ("horizon_s", "age_s", "claimed_s"),
    [(4.0, None, 4.0), (4.0, 3.9, 4.0), (4.0, 4.1, 0.0), (0.4, 0.1, 0.0), (0.0, 0.0, 0.0), (np.nan, 1.0, 0.0)],
)
def test_fleet_status_and_page_show_the_same_horizon_of_a_prediction_of_an_age(
    clock: Clock, horizon_s: float, age_s: float | None, claimed_s: float
) -> None:
    assert claimed_horizon_s(horizon_s, age_s) == claimed_s and claimed_horizon_s(4.0, 4.0) == 0.0
    row = FleetRow(uav=0, state=TwinState.VERIFIED, verdict="", horizon_s=horizon_s, prediction_age_s=age_s)
    console = Console(width=200, record=True)
    console.print(fleet_table([row]))
    figures = console.export_text().splitlines()[1].split()
    assert figures[3] == (f"{claimed_s:.0f}" if claimed_s else "-")
    feed, _, bus = feed_of(clock, 1)
    bus.publish(msgspec.structs.replace(PretendUav(0).prediction(T + 1, 0.0), horizon_s=horizon_s), STAMP)
    vehicle = feed.get(0)
    vehicle.instant = clock.now + vehicle.forecast.t + (age_s or 0.0) - vehicle.time.t
    assert vehicle.record(0.0).horizon_s == pytest.approx(claimed_s)
