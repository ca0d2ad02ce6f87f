"""Messages and JSON schemas of Foxglove: LocationFix, GeoJSON, SceneUpdate, Log.

The schemas list the fields that ParaUAV writes; names, types and enumerations are those of Foxglove.
Source: Foxglove documentation, "Message schemas".
"""

import json
import math
from typing import Any

import numpy as np

from fleet.contract import Alert, Prediction
from fleet.export.features import path_features
from fleet.export.geometry import PredictedPath, enu
from fleet.export.map_files import geojson
from fleet.frames import Origin

FRAME = "map"  # east, north, up from the first position
_INFO, _WARNING = 2, 3  # foxglove.Log.Level
_PATH_COLOUR = {"r": 0.17, "g": 0.77, "b": 0.6, "a": 1.0}
_REGION_COLOUR = {"r": 0.17, "g": 0.77, "b": 0.6, "a": 0.25}
_NO_TURN = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}


def _object(title: str, **fields: Any) -> dict[str, Any]:
    """Return the schema of an object; all its fields are required."""
    return {"title": title, "type": "object", "properties": fields, "required": list(fields)}


def _list(items: dict[str, Any]) -> dict[str, Any]:
    return {"type": "array", "items": items}


_NUMBER, _TEXT, _FLAG, _INTEGER = ({"type": name} for name in ("number", "string", "boolean", "integer"))
_TIME = _object("time", sec=_INTEGER, nsec=_INTEGER)
_DURATION = _object("duration", sec=_INTEGER, nsec=_INTEGER)
_VECTOR = _object("foxglove.Vector3", x=_NUMBER, y=_NUMBER, z=_NUMBER)
_POINT = _object("foxglove.Point3", x=_NUMBER, y=_NUMBER, z=_NUMBER)
_QUATERNION = _object("foxglove.Quaternion", x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER)
_POSE = _object("foxglove.Pose", position=_VECTOR, orientation=_QUATERNION)
_COLOUR = _object("foxglove.Color", r=_NUMBER, g=_NUMBER, b=_NUMBER, a=_NUMBER)
_LINE = _object(
    "foxglove.LinePrimitive",
    type=_INTEGER,
    pose=_POSE,
    thickness=_NUMBER,
    scale_invariant=_FLAG,
    points=_list(_POINT),
    color=_COLOUR,
    colors=_list(_COLOUR),
    indices=_list(_INTEGER),
)
_SPHERE = _object("foxglove.SpherePrimitive", pose=_POSE, size=_VECTOR, color=_COLOUR)
_PAIR = _object("foxglove.KeyValuePair", key=_TEXT, value=_TEXT)
_UNUSED = {name: _list({"type": "object"}) for name in ("arrows", "cubes", "cylinders", "triangles", "texts", "models")}
_ENTITY = _object(
    "foxglove.SceneEntity",
    timestamp=_TIME,
    frame_id=_TEXT,
    id=_TEXT,
    lifetime=_DURATION,
    frame_locked=_FLAG,
    **{"metadata": _list(_PAIR), "lines": _list(_LINE), "spheres": _list(_SPHERE), **_UNUSED},
)
SCHEMAS: dict[str, dict[str, Any]] = {
    schema["title"]: schema
    for schema in (
        _object(
            "foxglove.LocationFix",
            timestamp=_TIME,
            frame_id=_TEXT,
            latitude=_NUMBER,
            longitude=_NUMBER,
            altitude=_NUMBER,
            position_covariance=_list(_NUMBER),
            position_covariance_type=_INTEGER,
        ),
        _object("foxglove.GeoJSON", geojson=_TEXT),
        _object("foxglove.SceneUpdate", deletions=_list({"type": "object"}), entities=_list(_ENTITY)),
        _object("foxglove.Log", timestamp=_TIME, level=_INTEGER, message=_TEXT, name=_TEXT, file=_TEXT, line=_INTEGER),
    )
}
"""JSON schema of each message by name."""


def nanoseconds(t: float) -> int:
    """Convert a time [s since 1970] to nanoseconds; 0 when it is none."""
    return round(t * 1e9) if math.isfinite(t) and 0 <= t < 1.8e10 else 0


def time_stamp(t: float) -> dict[str, int]:
    """Return a time as seconds and nanoseconds."""
    sec, nsec = divmod(nanoseconds(t), 10**9)
    return {"sec": sec, "nsec": nsec}


def location_fix(t: float, uav: int, position: tuple[float, float, float]) -> dict[str, Any]:
    """Return a position [1e-7 deg, 1e-7 deg, mm] as LocationFix; its covariance is unknown."""
    lat, lon, alt = position
    place = {"latitude": lat * 1e-7, "longitude": lon * 1e-7, "altitude": alt * 1e-3}
    unknown = {"position_covariance": [0.0] * 9, "position_covariance_type": 0}
    return {"timestamp": time_stamp(t), "frame_id": f"uav-{uav}", **place, **unknown}


def map_prediction(message: Prediction, path: PredictedPath) -> dict[str, Any]:
    """Return predicted path, horizon and region of a prediction as GeoJSON."""
    about = {"state": message.state.value, "method": message.method, "horizon_s": round(path.horizon_s, 1)}
    features = path_features(message.uav, message.t, path, about)
    return {"geojson": json.dumps(geojson(features), allow_nan=False)}


def scene_prediction(message: Prediction, path: PredictedPath, origin: Origin) -> dict[str, Any]:
    """Return the predicted path up to the horizon as a line, and its region as ellipsoids, ENU from `origin` [m]."""
    ahead = np.unique(np.append(path.ahead[path.ahead < path.horizon_s], path.horizon_s))
    marks = path.marks()
    centres, half_axes = path.at(marks)
    line = {
        "type": 0,
        "pose": _pose(np.zeros(3), _NO_TURN),
        "thickness": 2.0,
        "scale_invariant": True,
        "points": [_xyz(p) for p in enu(path, path.at(ahead)[0], origin)],
        "color": _PATH_COLOUR,
        "colors": [],
        "indices": [],
    }
    spheres = [
        {"pose": _pose(centre, _yaw(heading)), "size": _xyz(2 * axes), "color": _REGION_COLOUR}
        for centre, axes, heading in zip(enu(path, centres, origin), half_axes, path.headings(marks), strict=True)
    ]
    about = {"state": message.state.value, "horizon_s": f"{path.horizon_s:.1f}"}
    entity = {
        "timestamp": time_stamp(message.t),
        "frame_id": FRAME,
        "id": f"uav-{message.uav} prediction",
        "lifetime": {"sec": math.ceil(path.horizon_s), "nsec": 0},
        "frame_locked": False,
        "metadata": [{"key": key, "value": value} for key, value in about.items()],
        "lines": [line] if len(ahead) > 1 else [],
        "spheres": spheres,
        **{name: [] for name in _UNUSED},
    }
    return {"deletions": [], "entities": [entity]}


def log(alert: Alert) -> dict[str, Any]:
    """Return an alert as a log message: a warning when raised, information when cleared."""
    return {
        "timestamp": time_stamp(alert.t),
        "level": _WARNING if alert.active else _INFO,
        "message": alert_text(alert),
        "name": f"uav-{alert.uav}",
        "file": "",
        "line": 0,
    }


def alert_text(alert: Alert) -> str:
    """Return the line of an alert in a log."""
    text = f"uav-{alert.uav}: {alert.kind.value.replace('_', ' ')}: {alert.sentence or 'no details'}"
    return text if alert.active else f"cleared: {text}"


def _xyz(values: np.ndarray) -> dict[str, float]:
    return {name: round(float(value), 3) for name, value in zip("xyz", values, strict=True)}


def _pose(position: np.ndarray, orientation: dict[str, float]) -> dict[str, Any]:
    return {"position": _xyz(position), "orientation": orientation}


def _yaw(heading: float) -> dict[str, float]:
    """Return the rotation from x = east to a heading clockwise from north [rad], about the vertical."""
    angle = math.pi / 2 - heading
    return {"x": 0.0, "y": 0.0, "z": math.sin(angle / 2), "w": math.cos(angle / 2)}
