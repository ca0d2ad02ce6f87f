"""Requests to the aircraft of one link, limited to the capacity of the link."""

from collections.abc import Collection, Hashable, Iterable, Sequence
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect

from fleet.contract import Link
from fleet.telemetry.mavlink.aircraft_link import AircraftLink
from gateway.onboard.parameter_cache_check import Cache
from gateway.onboard.questions import DIAGNOSIS_HZ, IMU_HZ, WANTED_HZ, RequestScheduler, size_of
from gateway.record.tape import format_size

# Other ground stations use 255: they must not receive our answers, and an aircraft must detect the loss of theirs.
SYSTEM, COMPONENT = 254, dialect.MAV_COMP_ID_MISSIONPLANNER
HEARTBEAT_S = 1.0
MIN_SHARE = 0.1  # minimum share of the wanted rates: lower rates are not useful
_HYSTERESIS = 0.15  # smaller relative changes of the share are ignored
WANTED_BYTES_S = sum(hz * size_of(name) for name, hz in WANTED_HZ.items())
"""Data rate of the wanted messages of one aircraft [bytes/s]."""
DIAGNOSIS_BYTES_S = IMU_HZ * size_of("RAW_IMU") + DIAGNOSIS_HZ["LOCAL_POSITION_NED"] * size_of("LOCAL_POSITION_NED")
"""Data rate of what only diagnosis needs, of one aircraft [bytes/s]."""
MIN_DIAGNOSIS_SHARE = 0.4  # minimum share of the rates for diagnosis: 10 Hz of the IMU


class RequestSender:
    """Sender of heartbeats and requests on one link.

    Args:
        budget: rate at which its aircraft may send together [bytes/s]
        cache: parameters and missions of earlier connections; None: no cache
    """

    def __init__(self, budget: float = float("inf"), cache: Cache | None = None) -> None:
        self.share = 1.0  # of the wanted rates that fits the link, the same for all of its aircraft
        self.diagnosis_share = 0.0  # the same of the rates for diagnosis, which are the first to be reduced
        self.sentence = ""  # note for the operator if not all of them fit
        self.suspended: Collection[int] = ()  # ids of aircraft whose mission must not be requested now
        self._budget, self._cache = budget, cache
        self._mav = dialect.MAVLink(None, srcSystem=SYSTEM, srcComponent=COMPONENT)
        self._schedulers: dict[int, RequestScheduler] = {}
        self._heartbeat_t = float("-inf")

    def tick(
        self, now: float, all_aircraft: Iterable[AircraftLink], known_peers: Sequence[Hashable] = ()
    ) -> list[tuple[Hashable, bytes]]:
        """Return the messages to send now: (peer, bytes).

        Args:
            now: fleet time [s since 1970]
            all_aircraft: the aircraft of the link
            known_peers: peers that get a heartbeat before they send
        """
        live = [aircraft for aircraft in all_aircraft if aircraft.link is Link.LIVE and aircraft.source is not None]
        out: list[tuple[Hashable, bytes]] = []
        if now - self._heartbeat_t >= HEARTBEAT_S:
            self._heartbeat_t = now
            kind, none = dialect.MAV_TYPE_GCS, dialect.MAV_AUTOPILOT_INVALID
            beat = dialect.MAVLink_heartbeat_message(kind, none, 0, 0, dialect.MAV_STATE_ACTIVE, 3)
            out += [
                (source, self.pack(beat))
                for source in dict.fromkeys([*known_peers, *(recipient.source for recipient in live)])
            ]
        self._update_shares(live)
        shares = self.share, self.diagnosis_share
        for craft in live:
            scheduler = self._schedulers.get(craft.system)
            if scheduler is None or scheduler.aircraft is not craft:
                scheduler = self._schedulers[craft.system] = RequestScheduler(craft, now, self._cache)
            requests = scheduler.requests(now, *shares, mission=craft.uav not in self.suspended)
            out += [(craft.source, self.pack(message)) for message in requests]
        return out

    def _update_shares(self, live: Sequence[AircraftLink]) -> None:
        """Fit the wanted rates of these aircraft to the rest of the budget: they also send unrequested messages."""
        requested = WANTED_HZ if self.diagnosis_share == 0.0 else {**WANTED_HZ, **DIAGNOSIS_HZ}
        unrequested = sum(
            hz * size_of(name) for aircraft in live for name, hz in aircraft.rates.items() if name not in requested
        )
        wanted, for_diagnosis = WANTED_BYTES_S * len(live), DIAGNOSIS_BYTES_S * len(live)
        rest = float(np.clip((self._budget - unrequested - wanted) / for_diagnosis, 0.0, 1.0)) if live else 0.0
        rest = rest if rest >= MIN_DIAGNOSIS_SHARE else 0.0
        if _has_changed(rest, self.diagnosis_share):
            self.diagnosis_share = rest
        fitting = float(np.clip((self._budget - unrequested) / wanted, MIN_SHARE, 1.0)) if live else 1.0
        if _has_changed(fitting, self.share):
            self.share = fitting
        self.sentence = ""
        if self.share < 1.0:
            required, budget = format_size(wanted + unrequested), format_size(self._budget)
            self.sentence = (
                f"{len(live)} aircraft would send {required}/s, the budget is {budget}/s: {self.share:.0%} of the "
                "wanted rates are requested; raise --budget if the link has more capacity"
            )

    def pack(self, message: Any) -> bytes:
        """Return the bytes of a message of this gateway, with the next sequence number."""
        packed = bytes(message.pack(self._mav))
        self._mav.seq = (self._mav.seq + 1) % 256
        return packed


def _has_changed(share: float, previous: float) -> bool:
    """Return whether a share differs by more than the hysteresis, or starts or ceases to be 0 or 1."""
    ends = (0.0, 1.0)
    return abs(share - previous) > _HYSTERESIS * previous or any((share == end) != (previous == end) for end in ends)
