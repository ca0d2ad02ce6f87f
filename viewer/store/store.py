"""Store of received messages: the latest of every topic per UAV, with bounded memory and without exceptions."""

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from fleet.bus.bus_protocol import Bus, key
from fleet.bus.bus_protocol import Letter as Said
from fleet.bus.codec import Stamp, decode_from, encoding
from fleet.bus.epoch_fence import GIVE_UP_S, Fence
from fleet.contract import (
    Account,
    Alert,
    AlertKind,
    FleetRow,
    FleetState,
    Mismatch,
    Mission,
    Model,
    Prediction,
    Sample,
    State,
    Status,
)
from viewer.store.forecast import Kept, forecast
from viewer.store.place import Place, TooFar, checked, first_fix
from viewer.store.received.inbox import CROWD, Head, Inbox, Letter, Newest, read
from viewer.store.vehicle import ENDED_S, JUMP_S, Vehicle
from viewer.theme.events import MAX_RAISED

MAX_VEHICLES = 2_000  # ids are untrusted input: further UAVs are counted, not stored
COASTING_S = 1.0  # a prediction later than this after the last sample is not compared with the flight [s]
SOON_S = 1.2  # longest delay of a sample in a large fleet [s]
WAIT_S = {Prediction: 3.0, Status: 2.0}  # decoding interval in a large fleet for UAVs without alerts [s]
PAST_S = 65.0  # age up to which past predictions are compared with the flight [s]
MAX_AWAY = 10_000  # rejected UAVs that are counted
MAX_LINKS = 64  # links whose texts are stored
MAX_WRITERS = 16  # workers whose texts are stored; a restarted worker counts as new
# topics requested at the start, so that a late viewer is complete
LATE = (Status, Mission, Model, Prediction, Alert, Mismatch, FleetState, Account)


class Feed:
    """All received data, one `Vehicle` per UAV; written by bus threads, read by the render thread."""

    def __init__(self, bus: Bus, clock: Callable[[], float] = time.monotonic) -> None:
        self._vehicles: dict[int, Vehicle] = {}
        self.inbox = Inbox()
        self._place: Place | None = None
        self.sentences: dict[int, str] = {}  # status text of each worker
        self._counts: Counter[str] = Counter()
        self.links: dict[str, str] = {}  # texts of gateways about their links
        self.away: set[int] = set()  # UAVs beyond MAX_VEHICLES
        self.since = clock()
        self.lock = threading.Lock()
        self._bus, self._clock, self._fence = bus, clock, Fence(clock)
        hears: dict[type, Callable[[Any, Stamp | None, float], None]] = {
            Sample: self._sample,
            Status: self._keep("status"),
            Mission: self._keep("mission"),
            Account: self._account,
            Model: self._model,
            Prediction: self._prediction,
            Alert: self._alert,
            Mismatch: self._mismatch,
            FleetState: self._fleet,
        }
        self._hears = hears
        self.close: frozenset[int] = frozenset()  # UAVs decoded on arrival, also in a large fleet
        self._newest: dict[type, Newest] = {kind: Newest(wait_s) for kind, wait_s in WAIT_S.items()}
        for kind in hears:
            bus.collect(kind, self._came(kind))

    @property
    def vehicles(self) -> dict[int, Vehicle]:
        """Return all UAVs, after decoding queued samples."""
        with self.lock:
            self._read()
            return self._vehicles

    @property
    def known(self) -> set[int]:
        """Return the ids of all UAVs, without decoding queued samples."""
        with self.lock:
            return set(self._vehicles)

    @property
    def place(self) -> Place | None:
        """Return the scene frame; None before the first position."""
        with self.lock:
            if self._place is None or not self.inbox.crowd:
                self._read()
            return self._place

    @property
    def counts(self) -> Counter[str]:
        """Return the number of messages of each class, and of malformed and outdated ones."""
        with self.lock:
            self._read()
            return self._counts

    def listen(self) -> None:
        """Receive the messages since the last call; call it about ten times per second."""
        self._bus.hand_out((Sample,) if self.inbox.crowd else ())
        with self.lock:
            for kind, newest in self._newest.items():
                for uav, letter in newest.due(self._clock()):
                    self._open(kind, uav, letter)

    def _came(self, kind: type) -> Callable[[list[Said]], None]:
        """Return the callback of one class: it queues samples and deferrable messages and decodes the others."""
        newest, named_so = self._newest.get(kind), encoding(kind)

        def came(letters: list[Said]) -> None:
            now = self._clock()
            sound = [letter for letter in letters if letter[2] == named_so]
            with self.lock:
                self._counts["strange"] += len(letters) - len(sound)
                if kind is Sample:
                    return self.inbox.put(sound, now)
                for uav, payload, _, stamp in sound:
                    letter = Letter(payload, now, stamp)
                    if newest is None or uav is None or not self._may_wait(kind, uav):
                        if newest is not None and uav is not None:
                            newest.drop(uav)
                        self._open(kind, uav, letter)
                    else:
                        newest.put(uav, letter)

        return came

    def _may_wait(self, kind: type, uav: int) -> bool:
        """Return whether decoding may wait: large fleet, UAV not immediate, an earlier message present."""
        if not self.inbox.crowd or uav in self.close:
            return False
        vehicle = self._vehicles.get(uav)
        return vehicle is not None and getattr(vehicle, kind.topic) is not None  # type: ignore[attr-defined]

    def _open(self, kind: type, uav: int | None, letter: Letter) -> None:
        """Decode one message, after the samples before it; the caller owns the lock."""
        if not self.inbox.crowd:
            self._read()
        try:
            message: Any = decode_from(kind, uav, letter.payload)
        except ValueError:
            self._counts["strange"] += 1
            return
        self._hear(kind, message, letter.stamp, letter.now)

    def _read(self, uavs: Iterable[int] | None = None) -> None:
        """Decode the queued samples of all or some UAVs; the caller owns the lock."""
        for uav, letter in self.inbox.take(uavs):
            try:
                sample = read(letter.payload)
            except ValueError:
                self._counts["strange"] += 1
                continue
            if sample.uav == uav:
                self._hear(Sample, sample, None, letter.now)
            else:
                self._counts["strange"] += 1
        self.inbox.crowd = len(self._vehicles) > CROWD

    @property
    def router(self) -> bool:
        """Return whether a router is connected."""
        return bool(self._bus.router)

    @property
    def listening(self) -> str:
        """Return the key expression of samples."""
        return key(Sample, "*")

    def catch_up(self) -> None:
        """Request the latest messages published before the start; keep newer ones."""
        for kind in LATE:
            hear = self._guarded(kind)
            for message, stamp in self._bus.ask(kind):
                if not self._is_known(message):
                    hear(message, stamp)

    def _is_known(self, message: Any) -> bool:
        """Return whether an equally new message arrived during the request."""
        with self.lock:
            held = getattr(self._vehicles.get(getattr(message, "uav", -1)), message.topic, None)
        return held is not None and held.t >= message.t

    def all(self) -> list[Vehicle]:
        """Return snapshots of all UAVs in the order of their ids."""
        with self.lock:
            self._read(self.inbox.waiting(self._clock() - SOON_S) if self.inbox.crowd else None)
            return [self._vehicles[uav].still(self._clock()) for uav in sorted(self._vehicles)]

    def poses(self, uavs: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return positions, attitudes and arrival times of some UAVs; do not decode others.

        Returns:
            scene ENU (n, 3) [10 m], NaN where unknown; phi theta psi (n, 3) [rad]; monotonic (n,) [s]
        """
        nowhere = np.full(3, np.nan)
        with self.lock:
            self._read(uavs if self.inbox.crowd else None)
            found = [self._vehicles[uav] for uav in uavs]
            places = [one.at if one.at is not None else nowhere for one in found]
            turns, heard = [one.attitude for one in found], [one.heard for one in found]
        return np.array(places).reshape(-1, 3), np.array(turns).reshape(-1, 3), np.array(heard)

    def one(self, uav: int) -> Vehicle | None:
        """Return a snapshot of one UAV; None when it is unknown."""
        with self.lock:
            self._read((uav,) if self.inbox.crowd else None)
            found = self._vehicles.get(uav)
            return found.still(self._clock()) if found is not None else None

    def said(self) -> list[str]:
        """Return the status texts of the workers."""
        with self.lock:
            return [text for text in self.sentences.values() if text]

    def trail(self, vehicle: Vehicle) -> np.ndarray:
        """Copy the flown trail: (n, 5) data time [s], scene ENU [10 m], Va [m/s]."""
        with self.lock:
            return vehicle.trail.rows()

    def track(self, vehicle: Vehicle) -> np.ndarray:
        """Copy the whole flown path, thinned: (n, 4) data time [s], scene ENU [10 m]."""
        with self.lock:
            return vehicle.track.rows()

    def past(self, vehicle: Vehicle) -> list[Kept]:
        """Copy the past predictions of the last minute, oldest first."""
        with self.lock:
            return list(vehicle.past)

    def fits(self, vehicle: Vehicle) -> np.ndarray:
        """Copy the history of fits: (n, 2) data time [s], mean over the states [%]."""
        with self.lock:
            return np.array(vehicle.fits, float).reshape(-1, 2)

    def _guarded(self, kind: type) -> Callable[[Any, Stamp | None], None]:
        """Return a handler of one class that takes the lock and counts malformed messages."""

        def hear(message: Any, stamp: Stamp | None) -> None:
            with self.lock:
                if not self.inbox.crowd:
                    self._read()
                self._hear(kind, message, stamp, self._clock())

        return hear

    def _hear(self, kind: type, message: Any, stamp: Stamp | None, now: float) -> None:
        try:
            self._hears[kind](message, stamp, now)
            self._counts[kind.__name__] += 1
        except (ValueError, IndexError, TypeError, OverflowError) as error:
            self._counts["strange"] += 1
            if (vehicle := self._vehicles.get(getattr(message, "uav", -1))) is not None:
                vehicle.refused = now, f"A {kind.__name__.lower()} was rejected: {error}"

    def _vehicle(self, uav: int) -> Vehicle:
        if uav not in self._vehicles:
            if len(self._vehicles) >= MAX_VEHICLES or not 0 <= uav < 1_000_000:
                if len(self.away) < MAX_AWAY:
                    self.away.add(uav)
                raise ValueError(
                    f"uav-{uav}: found {len(self._vehicles)} UAVs or an id of 1,000,000 or more, "
                    f"expected at most {MAX_VEHICLES} UAVs; open another viewer"
                )
            self._vehicles[uav] = Vehicle(uav)
        return self._vehicles[uav]

    def _sample(self, sample: Head, _: Stamp | None, now: float) -> None:
        if self._place is None and (origin := first_fix(sample)) is not None:
            self._place = Place(origin)
        if self._place is None:
            return
        vehicle = self._vehicle(sample.uav)
        try:
            vehicle.hear_sample(sample, self._place, now)
        except TooFar:
            others = (v for v in self._vehicles.values() if v is not vehicle and v.at is not None)
            if (origin := first_fix(sample)) is None or any(now - v.heard < GIVE_UP_S for v in others):
                raise
            self._move(Place(origin))
            vehicle.hear_sample(sample, self._place, now)
        vehicle.note(sample, now)

    def _move(self, place: Place) -> None:
        """Move the scene origin: no UAV flies near the old one, as after a wrong first position."""
        self._place = place
        for vehicle in self._vehicles.values():
            vehicle.forget()

    def _keep(self, name: str) -> Callable[[Any, Stamp | None, float], None]:
        def hear(message: Any, _: Stamp | None, now: float) -> None:
            vehicle = self._vehicle(message.uav)
            setattr(vehicle, name, message)
            vehicle.note(message, now)

        return hear

    def _believe(self, vehicle: Vehicle, stamp: Stamp | None, now: float) -> bool:
        """Return whether the fencing token of a worker message is current for a UAV."""
        if not self._fence.believes(vehicle.uav, stamp):
            self._counts["outdated"] += 1
            return False
        vehicle.believed = now
        return True

    def _model(self, model: Model, stamp: Stamp | None, now: float) -> None:
        vehicle = self._vehicle(model.uav)
        if not self._believe(vehicle, stamp, now):
            return
        vehicle.model = model
        vehicle.note(model, now)
        fits = [fit for fit in model.verdict.fit.values() if np.isfinite(fit)]
        if fits and np.isfinite(model.t):
            vehicle.fits.append((model.t, float(np.clip(np.mean(fits), 0, 100))))

    def _prediction(self, message: Prediction, stamp: Stamp | None, now: float) -> None:
        vehicle = self._vehicle(message.uav)
        if not self._believe(vehicle, stamp, now):
            return
        if vehicle.prediction is not None and 0 < vehicle.prediction.t - message.t < JUMP_S:
            return  # delayed: a newer one is present
        vehicle.note(message, now)
        vehicle.controller = message.controller or vehicle.controller
        if self._place is None and message.path.shape[0]:
            self._place = Place(checked(message.ned_origin()))
        found = forecast(message, self._place, now) if self._place is not None else None
        vehicle.prediction, vehicle.forecast = message, found
        if found is None:
            return
        if vehicle.past and found.t < vehicle.past[-1].t - JUMP_S:
            vehicle.past.clear()
        coasting = message.coast_s > COASTING_S
        vehicle.sure = vehicle.sure if coasting else found
        if not coasting and (not vehicle.past or found.t - vehicle.past[-1].t >= 0.9):
            vehicle.past.append(found.kept(vehicle.past[-1] if vehicle.past else None))
            while vehicle.past[0].t < found.t - PAST_S:
                vehicle.past.popleft()

    def _mismatch(self, found: Mismatch, stamp: Stamp | None, now: float) -> None:
        vehicle = self._vehicle(found.uav)
        if self._believe(vehicle, stamp, now) and np.isfinite(found.t):
            vehicle.mismatch = found
            vehicle.note(found, now)

    def _account(self, account: Account, _: Stamp | None, now: float) -> None:
        """Update link texts and which UAVs are replayed from a recording."""
        for link in account.per_link[:MAX_LINKS]:
            self.links.pop(link.link, None)
            if link.sentence and len(self.links) < MAX_LINKS:
                self.links[link.link] = link.sentence
        played = bool(account.links) and all(link.startswith("replay:") for link in account.links)
        for uav in account.uavs:
            vehicle = self._vehicles.get(uav)
            if vehicle is not None and (played or now - vehicle.player > ENDED_S):
                vehicle.player = now if played else -np.inf

    def _alert(self, alert: Alert, stamp: Stamp | None, now: float) -> None:
        vehicle = self._vehicle(alert.uav)
        if stamp is not None and not self._believe(vehicle, stamp, now):  # no token: from a gateway
            return
        vehicle.note(alert, now)
        others = {about: held for about, held in vehicle.alerts.items() if about != alert.about}
        if len(others) < MAX_RAISED or not alert.active:
            vehicle.alerts = {**others, alert.about: alert} if alert.active else others

    def _fleet(self, fleet: FleetState, stamp: Stamp | None, now: float) -> None:
        self.sentences[stamp.writer if stamp else 0] = fleet.sentence
        while len(self.sentences) > MAX_WRITERS:
            del self.sentences[next(iter(self.sentences))]
        for row in fleet.rows:
            vehicle = self._vehicle(row.uav)
            if row.state is not State.UNCLAIMED and self._believe(vehicle, _stamp_of(row), now):
                vehicle.row = row

    def alerts(self) -> list[tuple[Vehicle, AlertKind, Alert]]:
        """Return the active alerts, newest first."""
        with self.lock:
            now = self._clock()
            copies = [vehicle.still(now) for vehicle in self._vehicles.values() if vehicle.alerts]
            found = [(copy, alert.kind, alert) for copy in copies for alert in copy.alerts.values()]
        return sorted(found, key=lambda one: -one[2].t)


def _stamp_of(row: FleetRow) -> Stamp:
    """Return the fencing token of a fleet table row; the writer is untrusted text."""
    hexadecimal = len(row.worker) == 16 and all(letter in "0123456789abcdef" for letter in row.worker)
    return Stamp(row.epoch, int(row.worker, 16) if hexadecimal else 0)
