"""Proposals of a worker: a twin of a simulated flight, and other aircraft that are made to cross its path."""

import copy
import dataclasses

import msgspec
import numpy as np
import pytest

from fleet.contract import Alert, AlertKind, Array, Change, Item, Prediction, Proposal
from fleet.frames import Origin, to_geodetic
from fleet.terrain.areas import POLYGON_OUT, Area
from tests.support.memory_bus import MemoryBus
from tests.twin_worker.prediction.test_endurance import battery
from twin_worker.alerts.conflict_probability import Separation
from twin_worker.alerts.traffic import TrafficPicture
from twin_worker.ownership.twin_store import OwnedTwin
from twin_worker.proposals import candidates as changes
from twin_worker.proposals import speeds
from twin_worker.proposals.candidates import DECISION_S, Candidate, Deficit, Kind, Plan, to_change
from twin_worker.proposals.experiment import deficit, present, run
from twin_worker.proposals.mission_edits import insert, remove
from twin_worker.proposals.proposer import RENEW_S, AvoidedEvent, Proposer
from twin_worker.service.worker import Worker
from twin_worker.twin.state.state import Twin
from twin_worker.twin.steps.kinematic_prediction import predict_battery, recent_track
from twin_worker.twin.steps.predict_step import LOOK_BACK_ROTORS_S, predict

MEET_S = 60.0
OTHER = 3


@pytest.fixture(scope="module")
def path(flown) -> Prediction:
    """What the twin predicts of the present plan."""
    twin = copy.deepcopy(flown[0])
    (prediction,) = predict(twin, twin.telemetry.history.newest)
    return prediction


def crossing(path: Prediction, uav: int = OTHER, above: float = 0.0, at: float = MEET_S) -> Prediction:
    """Cross a predicted path at a right angle, `above` it [m]."""
    ahead, own = path.ahead.numpy().astype(float), path.path.numpy().astype(float)
    k = int(np.argmin(np.abs(ahead - at)))
    along = own[k + 1] - own[k - 1]
    aside = np.array([-along[1], along[0], 0.0]) / np.hypot(*along[:2])
    line = own[k] - [0.0, 0.0, above] + (ahead - ahead[k])[:, None] * 20.0 * aside
    tube = np.tile([8.0, 4.0, 3.0], (len(ahead), 1))
    return msgspec.structs.replace(
        path, uav=uav, path=Array.of(line), prediction_region_half_axes=Array.of(tube), controller=None
    )


class Fleet:
    """Proposer of one twin among predictions of others."""

    def __init__(self, twin: Twin, *others: Prediction) -> None:
        self.twin, self.others, self.asked = twin, others, 0
        self.proposer = Proposer(Separation(), self.copy_of, self.forecasts)

    @property
    def now(self) -> float:
        return self.twin.telemetry.history.newest

    def copy_of(self, uav: int) -> Twin | None:
        self.asked += uav == self.twin.config.uav
        return copy.deepcopy(self.twin) if uav == self.twin.config.uav else None

    def forecasts(self, now: float):
        picture = TrafficPicture()
        for prediction in self.others:
            picture.receive(prediction)
        picture.update_slots()
        return picture.forecasts(now)

    def alert(self, kind=AlertKind.CONFLICT, other=OTHER) -> Alert:
        return Alert(uav=1, t=self.now, kind=kind, other=other, probability=0.9, predicted_t=self.now + MEET_S)


def test_options_avoid_a_conflict_and_the_aircraft_flies_clear_of_it(twin, path):
    fleet = Fleet(twin, crossing(path))
    proposal = fleet.proposer.update(fleet.alert(), fleet.now)
    assert proposal.kind is AlertKind.CONFLICT and proposal.other == OTHER and proposal.probability > 0.25
    assert 1 <= len(proposal.options) <= 3 and proposal.valid_until > proposal.t
    for option in proposal.options:
        assert option.probability < 0.05 and option.changes and {one.uav for one in option.changes} == {1}
        (flown,) = option.paths
        near = apart(flown, crossing(path))
        assert near.min() > 20.0 and abs(near.min() - option.clearance_m) < 6.0
        assert option.sentence.startswith("UAV 1 ") and "UAV 3" in option.sentence
    assert len({option.changes for option in proposal.options}) == len(proposal.options)


def apart(one, other: Prediction) -> np.ndarray:
    """Distance of a proposed path to a prediction at the same times [m]; both begin now."""
    t, ahead = one.ahead.numpy().astype(float), other.ahead.numpy().astype(float)
    theirs = np.column_stack([np.interp(t, ahead, column) for column in other.path.numpy().T])
    assert one.origin == other.origin
    return np.linalg.norm(one.path.numpy() - theirs, axis=1)


def test_no_option_where_nothing_is_predicted(twin, path):
    far = Fleet(twin, crossing(path, above=150.0))
    assert far.proposer.update(far.alert(), far.now).options == ()
    requested = far.proposer.on_request(1, far.now)
    assert requested.options == () and requested.kind is None and "nothing is predicted" in requested.sentence


def test_an_option_creates_no_conflict_with_a_third_aircraft(twin, path):
    alone = Fleet(twin, crossing(path))
    offered = {option.changes for option in alone.proposer.update(alone.alert(), alone.now).options}
    lid = [crossing(path, uav, above=above) for uav, above in ((4, 40.0), (5, -40.0))]
    among = Fleet(twin, crossing(path), *lid)
    proposal = among.proposer.update(among.alert(), among.now)
    assert {option.changes for option in proposal.options} != offered
    for option in proposal.options:
        for other in lid:
            (flown,) = option.paths
            assert apart(flown, other).min() > 20.0


def test_a_proposal_is_renewed_under_its_id_and_withdrawn_with_the_alert(twin, path):
    fleet = Fleet(twin, crossing(path))
    alert = fleet.alert()
    assert fleet.proposer.due(alert, fleet.now)
    first = fleet.proposer.update(alert, fleet.now)
    assert not fleet.proposer.due(alert, fleet.now + 0.5 * RENEW_S) and fleet.proposer.due(alert, fleet.now + RENEW_S)
    again = fleet.proposer.update(alert, fleet.now)
    assert again.id == first.id and [o.changes for o in again.options] == [o.changes for o in first.options]
    assert fleet.proposer.current(1) == [again] and fleet.proposer.withdraw(1, [alert], fleet.now) == []
    (withdrawn,) = fleet.proposer.withdraw(1, [], fleet.now + 1.0)
    assert withdrawn.id == first.id and withdrawn.options == () and "cleared" in withdrawn.sentence
    assert withdrawn.about == first.about and fleet.proposer.current(1) == []


def test_options_end_when_the_conflict_does(twin, path):
    fleet = Fleet(twin, crossing(path))
    first = fleet.proposer.update(fleet.alert(), fleet.now)
    fleet.others = (crossing(path, above=200.0),)
    ended = fleet.proposer.update(fleet.alert(), fleet.now)
    assert ended.id == first.id and ended.options == () and "not predicted" in ended.sentence
    assert fleet.proposer.update(fleet.alert(), fleet.now) is None  # published once


def test_a_lost_link_leaves_nothing_to_propose(twin, path):
    twin.telemetry.link_lost = True
    fleet = Fleet(twin, crossing(path))
    proposal = fleet.proposer.update(fleet.alert(), fleet.now)
    assert proposal.options == () and "link lost" in proposal.sentence


def test_a_low_leg_is_answered_with_a_climb(twin):
    low = copy.deepcopy(twin)
    items = low.onboard.mission.items
    items = tuple(msgspec.structs.replace(item, alt_m=15.0) if item.seq and item.lat_e7 else item for item in items)
    low.onboard.set_mission(msgspec.structs.replace(low.onboard.mission, items=items), low.first_item)
    low.confidence.tracker.censor_open()  # as with a new mission
    fleet = Fleet(low)
    before = present(copy.deepcopy(low))
    assert before.hazards[AlertKind.GROUND] > 0.5
    proposal = fleet.proposer.update(fleet.alert(AlertKind.GROUND, -1), fleet.now)
    assert proposal.options and any("climbs" in option.sentence for option in proposal.options)
    assert all(option.probability < 0.2 and option.clearance_m > 30.0 for option in proposal.options)


# --- candidates ------------------------------------------------------------------------------------------------------


def test_an_experiment_leaves_the_twin_as_it_was(twin):
    experiment = present(twin)
    plan = Plan.of(twin, experiment.prediction)
    before = predict(copy.deepcopy(twin), fleet_time(twin))[0]
    run(plan, changes.candidates(plan, AlertKind.CONFLICT, 20.0, None, Deficit()))
    assert msgspec.msgpack.encode(predict(copy.deepcopy(twin), fleet_time(twin))[0]) == msgspec.msgpack.encode(before)


def fleet_time(twin: Twin) -> float:
    return twin.telemetry.history.newest


def test_each_kind_of_change_is_flown(twin):
    experiment = present(twin)
    plan = Plan.of(twin, experiment.prediction)
    values = (*VALUES, (Kind.SKIP, float(plan.seq)))
    by_kind = {e.candidate.kind: e for e in run(plan, [Candidate(1, kind, value) for kind, value in values])}
    for kind, _ in values:
        assert kind in by_kind, kind
        assert msgspec.msgpack.decode(msgspec.msgpack.encode(by_kind[kind].change), type=Change)
    end = {kind: e.prediction.path.numpy()[-1] for kind, e in by_kind.items()}
    middle = {kind: e.prediction.path.numpy()[60, 2] for kind, e in by_kind.items()}
    present_path = experiment.prediction.path.numpy()
    assert middle[Kind.ALTITUDE] == pytest.approx(present_path[60, 2] - 40.0, abs=12.0)  # up is negative
    assert np.linalg.norm(end[Kind.SPEED] - present_path[-1]) > 100.0
    hold = by_kind[Kind.HOLD].prediction.path.numpy()
    assert np.hypot(*(hold - hold[0])[:, :2].T).max() < 400.0
    assert by_kind[Kind.RETURN].change.mode == "return" and by_kind[Kind.SKIP].change.items is None


VALUES = ((Kind.SPEED, 18.0), (Kind.ALTITUDE, 40.0), (Kind.HOLD, 0.0), (Kind.RETURN, 0.0))


def test_a_multirotor_flies_its_candidates(hovered):
    experiment = present(hovered)
    plan = Plan.of(hovered, experiment.prediction)
    tried = changes.candidates(plan, AlertKind.CONFLICT, 20.0, None, Deficit())
    by_kind = {one.candidate.kind: one for one in run(plan, tried)}
    assert {Kind.SPEED, Kind.ALTITUDE, Kind.HOLD} <= by_kind.keys()
    assert all(one.prediction.method == "copter" for one in by_kind.values())
    before, slow = (one.prediction.path.numpy() for one in (experiment, by_kind[Kind.SPEED]))
    length = [float(np.linalg.norm(np.diff(path[:30], axis=0), axis=1).sum()) for path in (before, slow)]
    assert length[1] < 0.95 * length[0]
    higher = max(
        (one for one in run(plan, tried) if one.candidate.kind is Kind.ALTITUDE), key=lambda e: e.candidate.value
    )
    assert higher.prediction.path.numpy()[-1, 2] < before[-1, 2] - 10.0


def test_a_wait_of_a_multirotor_is_no_circle_that_an_upload_would_begin_anew(hovered):
    plan = Plan.of(hovered, present(hovered).prediction)
    current = min(item.seq for item in plan.ahead)
    for command, circles in ((18, True), (19, False)):  # LOITER_TURNS, LOITER_TIME, at the place that it is at then
        lat, lon, _ = to_geodetic(plan.prediction.ned_origin(), plan.at(DECISION_S)).astype(int).tolist()
        here = {"command": command, "lat_e7": lat, "lon_e7": lon, "param1": 60.0}
        items = tuple(msgspec.structs.replace(i, **here) if i.seq == current else i for i in plan.items)
        changed = dataclasses.replace(plan, items=items)
        assert changed.is_circling(DECISION_S) is circles


def low_on_battery(twin: Twin, share: float) -> Twin:
    """Let the battery of a multirotor have this share at the first row of the battery's flight."""
    twin.environment.battery = battery(share)
    recent = recent_track(twin, LOOK_BACK_ROTORS_S, with_attitude=False)
    assert recent is not None
    twin.environment.store_battery_forecast(predict_battery(twin, recent), twin.telemetry.history.newest)
    return twin


def test_a_battery_that_is_empty_before_the_end_is_answered_with_a_shorter_mission(hovered):
    fleet = Fleet(low_on_battery(hovered, 0.38))
    alert = Alert(uav=7, t=fleet.now, kind=AlertKind.BATTERY, active=True, probability=1.0)
    computed = fleet.proposer.compute(AvoidedEvent.of(alert), fleet.now)
    assert computed is not None and computed.proposal.options and "empty battery" in computed.proposal.sentence
    first = computed.proposal.options[0]
    assert first.probability < 0.2 and "leaves out its last waypoint" in first.sentence
    assert "ends with" in first.sentence and "of its battery" in first.sentence
    before = {item.seq: item for item in hovered.onboard.mission.items}
    changed = first.changes[0]
    assert len(changed.items) == len(before) - 1 and changed.items[-1].command == 20  # it still returns to launch
    full = Fleet(low_on_battery(copy.deepcopy(hovered), 0.9))
    unneeded = full.proposer.compute(AvoidedEvent.of(alert), full.now)
    assert unneeded is not None and not unneeded.proposal.options


def test_a_landing_or_a_return_is_proposed_where_no_shorter_mission_is_enough(hovered):
    fleet = Fleet(low_on_battery(hovered, 0.25))
    plan = Plan.of(hovered, present(hovered).prediction)
    tried = run(plan, changes.candidates(plan, AlertKind.BATTERY, 20.0, None, Deficit()))
    by_kind = {one.candidate.kind: one.hazards[AlertKind.BATTERY] for one in tried}
    assert by_kind[Kind.LAND] < 0.01 < 0.9 < by_kind[Kind.SHORTEN] and Kind.HOLD not in by_kind
    landing = next(one for one in tried if one.candidate.kind is Kind.LAND).prediction
    home_below = (hovered.home.alt_mm - landing.origin[2]) * -1e-3
    assert landing.path.numpy()[-1, 2] == pytest.approx(home_below, abs=1.0)  # on the ground, not below it
    alert = Alert(uav=7, t=fleet.now, kind=AlertKind.BATTERY, active=True, probability=1.0)
    options = fleet.proposer.compute(AvoidedEvent.of(alert), fleet.now).proposal.options
    assert options and all(option.changes[0].mode in ("land", "return") for option in options)


def test_speeds_stay_within_the_limits_of_the_autopilot(twin):
    plan = Plan.of(twin, present(twin).prediction)
    low, high = speeds.speed_limits(twin)
    found = [
        c.value for c in changes.candidates(plan, AlertKind.CONFLICT, 20.0, None, Deficit()) if c.kind is Kind.SPEED
    ]
    assert found and all(low <= V <= high for V in found) and low == twin.received_params["AIRSPEED_MIN"]


def test_inserted_and_removed_items_keep_the_jumps(twin):
    items = twin.onboard.mission.items
    jump = msgspec.structs.replace(items[-1], seq=items[-1].seq + 1, command=177, param1=3.0, param2=-1.0)
    mission = (*items, jump)
    new = msgspec.structs.replace(items[2], seq=2)
    longer = insert(mission, new)
    assert [item.seq for item in longer] == list(range(len(mission) + 1)) and longer[-1].param1 == 4.0
    assert remove(longer, 2) == mission
    assert remove(mission, 5)[-1].param1 == 3.0 and remove(mission, 2)[-1].param1 == 2.0


def test_no_item_is_lowered_below_the_minimum_height(twin):
    plan = Plan.of(twin, present(twin).prediction)
    lowest = min(item.alt_m for item in plan.ahead)
    assert to_change(plan, Candidate(1, Kind.ALTITUDE, plan.min_height_m - lowest - 1.0)) is None
    assert to_change(plan, Candidate(1, Kind.ALTITUDE, 30.0)) is not None


# --- the worker ------------------------------------------------------------------------------------------------------


def test_a_worker_publishes_a_proposal_for_its_alert_and_answers_queries(twin, path):
    bus, published = MemoryBus(), []
    worker = Worker(bus, range(1, 3), omega=0.0)
    worker.connect()
    worker.ownership.may_write = lambda: True
    worker._owned[1] = OwnedTwin(twin, epoch=9)
    bus.subscribe(Proposal, lambda message, stamp: published.append((message, stamp)))
    for prediction in (msgspec.structs.replace(path, controller=None), crossing(path)):
        worker.traffic.receive(prediction)
    now = twin.telemetry.history.newest
    for k in range(8):
        for alert in worker.traffic.assess(1, now + k):
            assert alert.kind is AlertKind.CONFLICT and alert.active
    assert worker.traffic.active(1)
    worker.proposals.run_once()
    ((proposal, stamp),) = published
    assert proposal.options and stamp.epoch == 9
    ((reply, _),) = bus.get(Proposal, 1)
    assert reply == proposal
    worker.traffic.release(1)
    worker.proposals.run_once()
    assert published[-1][0].options == () and published[-1][0].id == proposal.id
    assert [r.kind for r, _ in bus.get(Proposal, 1)] == [None]  # computed on request


# --- areas -----------------------------------------------------------------------------------------------------------

AREA_S, AREA_M = 55.0, 60.0  # when the predicted path reaches its middle, half of its side


def area_ahead(prediction: Prediction) -> Area:
    """Return a square no-fly area on a predicted path."""
    k = int(np.argmin(np.abs(prediction.ahead.numpy() - AREA_S)))
    centre = prediction.path.numpy()[k].astype(float)
    corners = centre + AREA_M * np.array([[-1, -1, 0], [-1, 1, 0], [1, 1, 0], [1, -1, 0]])
    lat, lon, _ = to_geodetic(prediction.ned_origin(), corners).T.astype(int).tolist()
    return Area("village", tuple(zip(lat, lon, strict=True)), exclusion=True)


def geofence_alert(fleet: Fleet) -> Alert:
    at = fleet.now + AREA_S
    return Alert(uav=1, t=fleet.now, kind=AlertKind.GEOFENCE, active=True, probability=1.0, predicted_t=at)


def test_a_no_fly_area_ahead_is_avoided_and_ways_around_it_are_tried(twin, path):
    twin.areas = (area_ahead(path),)
    fleet, plan = Fleet(twin), Plan.of(twin, path)
    short = deficit(plan, present(twin), AlertKind.GEOFENCE)
    tried = run(plan, changes.candidates(plan, AlertKind.GEOFENCE, 20.0, None, short))
    around = [one for one in tried if one.candidate.kind is Kind.DETOUR]
    assert around and present(twin).hazards[AlertKind.GEOFENCE] > 0.9
    clear = [one for one in around if one.hazards[AlertKind.GEOFENCE] < 0.1]
    assert clear and all(one.margin_m[AlertKind.GEOFENCE] > 0.0 for one in clear)
    sides = {np.sign(one.candidate.value) for one in around}
    assert sides == {1.0, -1.0}
    proposal = fleet.proposer.update(geofence_alert(fleet), fleet.now)
    assert proposal.options and "from the geofence" in proposal.options[0].sentence
    for option in proposal.options:
        flown = next(one for one in option.paths if one.uav == 1)
        depth = twin.areas[0].depth(flown.path.numpy().astype(float), Origin(*flown.origin))
        assert depth[flown.ahead.numpy() < 90.0].max() < 0.0


def test_fence_items_on_board_bind_changed_missions_too(twin, path):
    """A changed mission is uploaded; the fence on board stays."""
    area = area_ahead(path)
    vertices = tuple(
        Item(seq=k, command=POLYGON_OUT, param1=4.0, lat_e7=lat, lon_e7=lon)
        for k, (lat, lon) in enumerate(area.vertices)
    )
    mission = msgspec.structs.replace(twin.onboard.mission, fence=vertices)
    twin.onboard.set_mission(mission, twin.first_item)
    twin.onboard.set_params(
        msgspec.structs.replace(
            twin.onboard.params, values=twin.onboard.params.values | {"FENCE_ENABLE": 1.0, "FENCE_TYPE": 4.0}
        )
    )
    plan = Plan.of(twin, path)
    higher = run(plan, [Candidate(1, Kind.ALTITUDE, 20.0)])
    assert higher[0].hazards[AlertKind.GEOFENCE] > 0.9  # it passes the area, whatever its height
