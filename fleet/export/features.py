"""Features of the map in one list, which GeoJSON and KML write: flown and predicted paths, regions, alerts."""

import math
from collections.abc import Iterable
from datetime import UTC, datetime
from typing import Any, NamedTuple

import numpy as np

from fleet.contract import Alert, AlertKey, Message, Mission, Prediction, Sample, Status
from fleet.export.geometry import PredictedPath, coordinates, ellipse, position_rows, predicted_path, rounded
from fleet.process.sanitise import printable

STEP_S = 1.0  # shortest time between two points of a flown path [s]
_MAX_T = 4e9  # latest time that is written as a date [s since 1970]


class MapFeature(NamedTuple):
    """One feature: its geometry as in GeoJSON (longitude, latitude [deg], altitude AMSL [m]) and its properties."""

    kind: str  # flown_path, position, predicted_path, beyond_horizon, prediction_region, horizon, alert
    uav: int
    geometry: str  # Point, LineString, Polygon; empty: none
    coordinates: Any
    t: float  # time of the content [s since 1970]
    properties: dict[str, Any]


class FlightSummary:
    """Content of an export about one aircraft, from its messages in order of reception."""

    def __init__(self, uav: int) -> None:
        self.uav = uav
        self.prediction: Prediction | None = None
        self.status: Status | None = None
        self.mission: Mission | None = None
        self.alerts: dict[AlertKey, Alert] = {}
        self.track: list[tuple[float, tuple[float, float, float]]] = []  # time [s since 1970], position

    def add(self, message: Message) -> None:
        """Add a message."""
        if isinstance(message, Prediction):
            self.prediction = message
        elif isinstance(message, Status):
            self.status = message
        elif isinstance(message, Mission):
            self.mission = message
        elif isinstance(message, Alert):
            self.alerts.pop(message.about, None)
            if message.active:
                self.alerts[message.about] = message
        elif isinstance(message, Sample):
            for t, position in zip(*position_rows(message), strict=True):
                if not self.track or t >= self.track[-1][0] + STEP_S:
                    self.track.append((float(t), tuple(position.tolist())))

    def features(self) -> list[MapFeature]:
        """Return all features; a prediction with invalid arrays is left out."""
        return [*self._track_features(), *self._prediction_features(), *self._alert_features()]

    def _track_features(self) -> Iterable[MapFeature]:
        if not self.track:
            return
        points = rounded(np.array([position for _, position in self.track]))
        mode = {} if self.status is None else {"mode": printable(self.status.mode), "link": self.status.link.value}
        begin, end = self.track[0][0], self.track[-1][0]
        if len(points) > 1:
            yield MapFeature("flown_path", self.uav, "LineString", points, end, {"begin": date(begin), **mode})
        yield MapFeature("position", self.uav, "Point", points[-1], end, mode)

    def _prediction_features(self) -> Iterable[MapFeature]:
        message = self.prediction
        if message is None:
            return
        try:
            path = predicted_path(message)
        except ValueError:
            return
        if path is None:
            return
        about = {
            "state": message.state.value,
            "method": printable(message.method),
            "horizon_s": round(path.horizon_s, 1),
            "coverage_nominal": message.quantile,
            "coast_s": round(message.coast_s, 1),
        }
        yield from path_features(self.uav, message.t, path, about)

    def _alert_features(self) -> Iterable[MapFeature]:
        for alert in self.alerts.values():
            properties: dict[str, Any] = {"alert": alert.kind.value, "text": printable(alert.sentence)}
            if alert.other >= 0:
                properties["other_uav"] = alert.other
            if alert.probability is not None and math.isfinite(alert.probability):
                properties["probability"] = alert.probability
            if alert.predicted_t is not None:
                properties["predicted_time"] = date(alert.predicted_t)
            place: list[Any] = [alert.lat, alert.lon, alert.alt or 0]
            if alert.lat is None or alert.lon is None or abs(alert.lat) > 9e8 or abs(alert.lon) > 1.8e9:
                place = list(self.track[-1][1]) if self.track else []
                properties["place"] = "aircraft" if place else "unknown"
            geometry, point = ("Point", rounded(np.array([place]))[0]) if place else ("", None)
            yield MapFeature("alert", self.uav, geometry, point, alert.t, properties)


def path_features(uav: int, t: float, path: PredictedPath, about: dict[str, Any]) -> list[MapFeature]:
    """Return the features of one prediction.

    Args:
        uav: its aircraft
        t: start of the prediction [s since 1970]
        path: its checked arrays
        about: properties of the predicted path
    """
    features = []
    inner = path.ahead[(path.ahead > path.ahead[0]) & (path.ahead < path.horizon_s)]
    trusted = np.unique(np.concatenate([[path.ahead[0]], inner, [max(path.horizon_s, path.ahead[0])]]))
    rest = np.unique(np.append(path.ahead[path.ahead > path.horizon_s], max(path.horizon_s, path.ahead[0])))
    for kind, ahead in (("predicted_path", trusted), ("beyond_horizon", rest)):
        if len(ahead) > 1:
            points = coordinates(path.origin, path.at(ahead)[0])
            features.append(MapFeature(kind, uav, "LineString", points, t, about))
    marks = path.marks()
    for ahead_s, heading in zip(marks.tolist(), path.headings(marks).tolist(), strict=True):
        (centre,), (half_axes,) = path.at(np.array([ahead_s]))
        ring = coordinates(path.origin, ellipse(centre, half_axes, heading))
        size = {"ahead_s": round(ahead_s, 1), "half_axes_m": [round(x, 2) for x in half_axes.tolist()]}
        features.append(MapFeature("prediction_region", uav, "Polygon", [ring], t + ahead_s, size))
    if len(marks):
        point = coordinates(path.origin, path.at(marks[-1:])[0])[0]
        seconds = {"horizon_s": round(path.horizon_s, 1)}
        features.append(MapFeature("horizon", uav, "Point", point, t + path.horizon_s, seconds))
    return features


def summarise(messages: Iterable[Message]) -> dict[int, FlightSummary]:
    """Summarise messages by UAV id."""
    flights: dict[int, FlightSummary] = {}
    for message in messages:
        flights.setdefault(message.uav, FlightSummary(message.uav)).add(message)
    return flights


def date(t: float) -> str:
    """Format a time [s since 1970] as ISO 8601; empty when it is none."""
    if not math.isfinite(t) or not 0 <= t < _MAX_T:
        return ""
    return datetime.fromtimestamp(t, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
