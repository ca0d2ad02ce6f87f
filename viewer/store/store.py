"""From the bus to memory: the latest of every topic per UAV, never an exception, never more than fits."""

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

MAX_VEHICLES = 2_000  # ids are written by strangers: more than this many are counted, not kept
COASTING_S = 1.0  # a prediction so long after the last sample is of no flight that anything can be laid beside [s]
SOON_S = 1.2  # in a crowd a sample is read at the latest when it has waited for so long [s]
WAIT_S = {Prediction: 3.0, Status: 2.0}  # in a crowd the newest of these is read so often, of who is well [s]
PAST_S = 65.0  # how long what is kept of a forecast is laid beside what happened [s]
MAX_AWAY = 10_000  # UAVs without room that are counted
MAX_LINKS = 64  # links whose sentences are kept
MAX_WRITERS = 16  # workers whose sentences are kept: a restarted one is another
# asked for at the start, so that a late viewer is complete
LATE = (Status, Mission, Model, Prediction, Alert, Mismatch, FleetState, Account)


class Feed:
    """Everything heard, one `Vehicle` per UAV; written by the bus's threads, read by the render thread."""

    def __init__(self, bus: Bus, clock: Callable[[], float] = time.monotonic) -> None:
        self._vehicles: dict[int, Vehicle] = {}
        self.inbox = Inbox()
        self._place: Place | None = None
        self.sentences: dict[int, str] = {}  # what each worker says of itself
        self._counts: Counter[str] = Counter()
        self.links: dict[str, str] = {}  # what gateways say of their links, where they say something
        self.away: set[int] = set()  # UAVs that there was no room for
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
        self.close: frozenset[int] = frozenset()  # whose letters are read as they come, also in a crowd
        self._newest: dict[type, Newest] = {kind: Newest(wait_s) for kind, wait_s in WAIT_S.items()}
        for kind in hears:
            bus.collect(kind, self._came(kind))

    @property
    def vehicles(self) -> dict[int, Vehicle]:
        """Return everyone heard of, up to date."""
        with self.lock:
            self._read()
            return self._vehicles

    @property
    def known(self) -> set[int]:
        """Name everyone heard of, but for letters that are not read yet."""
        with self.lock:
            return set(self._vehicles)

    @property
    def place(self) -> Place | None:
        """Return the frame of the scene; None before anybody was anywhere."""
        with self.lock:
            if self._place is None or not self.inbox.crowd:
                self._read()
            return self._place

    @property
    def counts(self) -> Counter[str]:
        """Return how many messages came of each class, and how many were strange or outdated."""
        with self.lock:
            self._read()
            return self._counts

    def listen(self) -> None:
        """Take in what came since the last call; call it some ten times a second."""
        self._bus.hand_out((Sample,) if self.inbox.crowd else ())
        with self.lock:
            for kind, newest in self._newest.items():
                for uav, letter in newest.due(self._clock()):
                    self._open(kind, uav, letter)

    def _came(self, kind: type) -> Callable[[list[Said]], None]:
        """Take in one class: samples are put aside, and in a crowd what comes every second; the rest is read."""
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
        """Return whether one of a crowd is not looked at closely, and such a message of it is known already."""
        if not self.inbox.crowd or uav in self.close:
            return False
        vehicle = self._vehicles.get(uav)
        return vehicle is not None and getattr(vehicle, kind.topic) is not None  # type: ignore[attr-defined]

    def _open(self, kind: type, uav: int | None, letter: Letter) -> None:
        """Read one letter, after the samples before it; the lock is held."""
        if not self.inbox.crowd:
            self._read()
        try:
            message: Any = decode_from(kind, uav, letter.payload)
        except ValueError:
            self._counts["strange"] += 1
            return
        self._hear(kind, message, letter.stamp, letter.now)

    def _read(self, uavs: Iterable[int] | None = None) -> None:
        """Read what was put aside, or what of it is of some UAVs; the lock is held."""
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
        """Return whether a router is there to hear anything through."""
        return bool(self._bus.router)

    @property
    def listening(self) -> str:
        """Name the key the first sign of life comes on."""
        return key(Sample, "*")

    def catch_up(self) -> None:
        """Ask everyone for what was said before we listened; what is newer by now is kept."""
        for kind in LATE:
            hear = self._guarded(kind)
            for message, stamp in self._bus.ask(kind):
                if not self._is_known(message):
                    hear(message, stamp)

    def _is_known(self, message: Any) -> bool:
        """Return whether something as new came by itself while we asked."""
        with self.lock:
            held = getattr(self._vehicles.get(getattr(message, "uav", -1)), message.topic, None)
        return held is not None and held.t >= message.t

    def all(self) -> list[Vehicle]:
        """Copy the UAVs, in order of their ids: nothing changes in them while they are drawn."""
        with self.lock:
            self._read(self.inbox.waiting(self._clock() - SOON_S) if self.inbox.crowd else None)
            return [self._vehicles[uav].still(self._clock()) for uav in sorted(self._vehicles)]

    def poses(self, uavs: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return where some UAVs are, how they are turned, and when that was heard; of others nothing is read.

        Returns:
            scene ENU (n, 3) [10 m], not a number where nobody told; phi theta psi (n, 3) [rad]; monotonic (n,) [s]
        """
        nowhere = np.full(3, np.nan)
        with self.lock:
            self._read(uavs if self.inbox.crowd else None)
            found = [self._vehicles[uav] for uav in uavs]
            places = [one.at if one.at is not None else nowhere for one in found]
            turns, heard = [one.attitude for one in found], [one.heard for one in found]
        return np.array(places).reshape(-1, 3), np.array(turns).reshape(-1, 3), np.array(heard)

    def one(self, uav: int) -> Vehicle | None:
        """Copy one UAV; None where it was never heard of."""
        with self.lock:
            self._read((uav,) if self.inbox.crowd else None)
            found = self._vehicles.get(uav)
            return found.still(self._clock()) if found is not None else None

    def said(self) -> list[str]:
        """Copy what the workers say of themselves."""
        with self.lock:
            return [text for text in self.sentences.values() if text]

    def trail(self, vehicle: Vehicle) -> np.ndarray:
        """Copy the flown trail: (n, 5) fleet time [s], scene ENU [10 m], Va [m/s]."""
        with self.lock:
            return vehicle.trail.rows()

    def track(self, vehicle: Vehicle) -> np.ndarray:
        """Copy the whole flown path, thinned: (n, 4) fleet time [s], scene ENU [10 m]."""
        with self.lock:
            return vehicle.track.rows()

    def past(self, vehicle: Vehicle) -> list[Kept]:
        """Copy what is kept of the forecasts of the last half minute, oldest first."""
        with self.lock:
            return list(vehicle.past)

    def fits(self, vehicle: Vehicle) -> np.ndarray:
        """Copy the history of fits: (n, 2) fleet time [s], mean over the states [%]."""
        with self.lock:
            return np.array(vehicle.fits, float).reshape(-1, 2)

    def _guarded(self, kind: type) -> Callable[[Any, Stamp | None], None]:
        """Wrap one hearer: under the lock, and a strange message is counted instead of raised."""

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
                vehicle.refused = now, f"A {kind.__name__.lower()} was refused: {error}"

    def _vehicle(self, uav: int) -> Vehicle:
        if uav not in self._vehicles:
            if len(self._vehicles) >= MAX_VEHICLES or not 0 <= uav < 1_000_000:
                if len(self.away) < MAX_AWAY:
                    self.away.add(uav)
                raise ValueError(
                    f"uav-{uav}: found {len(self._vehicles)} UAVs already or no id below 1,000,000, "
                    f"expected at most {MAX_VEHICLES}; open another viewer"
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
        """Begin anew elsewhere: where we are, nobody flies any more; the first position was a wrong one, say."""
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
        """Return whether a worker may speak for a UAV: not below the highest claim that still speaks."""
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
            return  # delayed, and newer is here
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
        """Learn who is played from a recording, and that the player still speaks; one who flies now is live again."""
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
        if stamp is not None and not self._believe(vehicle, stamp, now):  # without a stamp: of a gateway
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
        """Return the alerts in force, newest first."""
        with self.lock:
            now = self._clock()
            copies = [vehicle.still(now) for vehicle in self._vehicles.values() if vehicle.alerts]
            found = [(copy, alert.kind, alert) for copy in copies for alert in copy.alerts.values()]
        return sorted(found, key=lambda one: -one[2].t)


def _stamp_of(row: FleetRow) -> Stamp:
    """Return the claim of a row of the fleet table; the writer is a stranger's text."""
    hexadecimal = len(row.worker) == 16 and all(letter in "0123456789abcdef" for letter in row.worker)
    return Stamp(row.epoch, int(row.worker, 16) if hexadecimal else 0)
