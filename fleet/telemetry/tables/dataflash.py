"""DataFlash table: one row per message and `Sample` field, ArduPilot from 2013 to 2026. A new source is a new row.

All unit conversions of DataFlash to SI, NED, FRD and rad are here. ArduPilot renames its fields: a row applies if the
log has all fields that the row reads; of the active applicable rows the highest rank wins. Values are scaled by their
format letter (`c` in units, `L` in degrees), identically for binary and text logs.

A field whose columns come from several messages has `PARTS`: the first part defines the times, the others are
interpolated to them. Fields without source are omitted: copters log no cross-track error, so they have no `command`.
Source: ArduPilot's Log.cpp of Plane and Copter and AP_Logger's LogStructure.h, releases 2013 to 2026.
"""

from math import pi
from typing import Any

import numpy as np

from fleet.frames import wrap
from fleet.telemetry.tables.row import MAX_MAGNITUDE, FieldSource

DEG = pi / 180  # [rad/deg]

PARTS: dict[str, tuple[tuple[str, int], ...]] = {
    "attitude": (("attitude", 3), ("attitude: rates", 3)),
    "air": (("air", 1), ("air: throttle", 1), ("air: climb", 1)),
    "command": (("command", 2), ("command: errors", 3)),
    "servo": (("servo", 14), ("servo: 15, 16", 2)),
}
"""`Sample` field -> its parts, (name as in `Row.field`, how many columns), in column order."""
OPTIONAL_PARTS = {"servo: 15, 16"}
"""Parts without which the field consists of its first part."""

ANGLES, RATES = "attitude", "attitude: rates"

_FIX_3D = 3  # minimum GPS status of a 3D fix
_NO_FIX_DEG = 0.01  # within 1 km of latitude 0, longitude 0
_LAST_NAV = 95  # last navigation MAV_CMD; later ones are conditions and actions, except
_EXTRA_NAV = (213, 42702, 42703)  # set yaw and speed, script time, attitude time


def _angles(m: Any) -> tuple[Any, ...]:
    return (m.Roll * DEG, m.Pitch * DEG, wrap(m.Yaw * DEG))


def _gyro(m: Any) -> tuple[Any, ...]:
    return (m.GyrX, m.GyrY, m.GyrZ)


def _rate(m: Any, unit: Any) -> tuple[Any, ...]:
    return (m.R * unit, m.P * unit, m.Y * unit)


def _imu(m: Any) -> tuple[Any, ...]:
    return (m.AccX, m.AccY, m.AccZ, m.GyrX, m.GyrY, m.GyrZ)


def _position(m: Any) -> tuple[Any, ...]:
    return (np.rint(m.Lat * 1e7), np.rint(m.Lng * 1e7), np.rint(m.Alt * 1e3))


def _has_position(m: Any) -> Any:
    return (abs(m.Lat) > _NO_FIX_DEG) | (abs(m.Lng) > _NO_FIX_DEG)


def _fix(m: Any) -> Any:
    return (m.Status >= _FIX_3D) & _has_position(m)


def _course_velocity(m: Any) -> tuple[Any, ...]:
    return (m.Spd * np.cos(m.GCrs * DEG), m.Spd * np.sin(m.GCrs * DEG), m.VZ)


def _ned(m: Any) -> tuple[Any, ...]:
    return (m.VN, m.VE, m.VD)


def _started(m: Any) -> Any:
    return (m.VN != 0) | (m.VE != 0) | (m.VD != 0)  # exact zeros: the filter has not started


def _wind(m: Any) -> tuple[Any, ...]:
    return (m.VWN, m.VWE)  # direction the wind blows to


def _has_wind(m: Any) -> Any:
    return (m.VWN != 0) | (m.VWE != 0)  # exact zeros: no wind estimate


def _outputs(m: Any, names: str) -> tuple[Any, ...]:
    outputs = tuple(getattr(m, name) for name in names.split())
    width = 8 if len(outputs) <= 8 else 14
    return (*outputs, *(outputs[0] * 0.0,) * (width - len(outputs)))  # an output that is not logged is 0, as in MAVLink


def _is_plane(m: Any) -> Any:
    return np.isfinite(m.NavRoll)  # Copter's message of the same name has no NavRoll


def _copter_throttle(m: Any) -> tuple[Any, ...]:
    return (
        m.ThrOut * np.where(m.is_integer("ThrOut"), 1e-3, 1.0) + 0.0 * m.AngBst,
    )  # integers run to 1000, floats to 1


def _target(m: Any, altitude: Any) -> tuple[Any, ...]:
    return (np.rint(m.TLat * 1e7), np.rint(m.TLng * 1e7), np.rint(altitude * 1e3))


def _has_target(m: Any) -> Any:
    return (abs(m.TLat) > _NO_FIX_DEG) | (abs(m.TLng) > _NO_FIX_DEG)


def _is_leg(m: Any) -> Any:
    return ((m.CId <= _LAST_NAV) | np.isin(m.CId, _EXTRA_NAV)) & (m.CNum > 0)


TABLE: tuple[FieldSource, ...] = (
    FieldSource("ATT", "attitude", _angles, rank=3),
    FieldSource("AHR2", "attitude", _angles, rank=2),
    FieldSource("EKF1", "attitude", _angles, rank=1),
    FieldSource("IMU", "attitude: rates", _gyro, rank=4, when=lambda m: m.I == 0),
    FieldSource("IMU", "attitude: rates", _gyro, rank=3),
    FieldSource("GYR", "attitude: rates", _gyro, rank=2, when=lambda m: m.I == 0),
    FieldSource("RATE", "attitude: rates", lambda m: _rate(m, DEG + 0.0 * m.AOutSlew), rank=1),
    FieldSource("RATE", "attitude: rates", lambda m: _rate(m, DEG / 100 + 0.0 * m.TimeMS), rank=1),  # either unit
    FieldSource("IMU", "imu", _imu, rank=2, when=lambda m: m.I == 0),
    FieldSource("IMU", "imu", _imu, rank=1),
    FieldSource("POS", "position", _position, rank=4, when=_has_position),
    FieldSource("GPS", "position", _position, rank=3, when=lambda m: (m.I == 0) & _fix(m)),
    FieldSource("GPS", "position", _position, rank=2, when=_fix),
    FieldSource("AHR2", "position", _position, rank=1, when=_has_position),
    FieldSource("XKF1", "velocity", _ned, rank=8, when=lambda m: (m.C == 0) & _started(m)),
    FieldSource("XKF1", "velocity", _ned, rank=7, when=_started),
    FieldSource("NKF1", "velocity", _ned, rank=6, when=lambda m: (m.C == 0) & _started(m)),
    FieldSource("NKF1", "velocity", _ned, rank=5, when=_started),
    FieldSource("EKF1", "velocity", _ned, rank=4, when=_started),
    FieldSource("GPS", "velocity", _course_velocity, rank=2, when=lambda m: (m.I == 0) & _fix(m)),
    FieldSource("GPS", "velocity", _course_velocity, rank=1, when=_fix),
    FieldSource("CTUN", "air", lambda m: (m.As,), rank=6),
    FieldSource("CTUN", "air", lambda m: (m.Aspd,), rank=5),
    FieldSource("ARSP", "air", lambda m: (m.Airspeed,), rank=4, when=lambda m: (m.I == 0) & (m.U != 0)),
    FieldSource("ARSP", "air", lambda m: (m.Airspeed,), rank=3, when=lambda m: m.U != 0),
    FieldSource("ARSP", "air", lambda m: (m.Airspeed,), rank=2),
    FieldSource("NTUN", "air", lambda m: (m.Arspd,), rank=1),
    FieldSource("CTUN", "air: throttle", lambda m: (m.ThO * 1e-2,), rank=4, when=_is_plane),  # per cent
    FieldSource("CTUN", "air: throttle", lambda m: (m.ThrOut * 1e-2,), rank=3, when=_is_plane),  # per cent
    FieldSource("CTUN", "air: throttle", lambda m: (m.ThO + 0.0 * m.ABst,), rank=2),  # Copter since 3.5, 0..1
    FieldSource("CTUN", "air: throttle", _copter_throttle, rank=1),
    FieldSource("XKF1", "air: climb", lambda m: (-m.VD,), rank=8, when=lambda m: (m.C == 0) & _started(m)),
    FieldSource("XKF1", "air: climb", lambda m: (-m.VD,), rank=7, when=_started),
    FieldSource("NKF1", "air: climb", lambda m: (-m.VD,), rank=6, when=lambda m: (m.C == 0) & _started(m)),
    FieldSource("NKF1", "air: climb", lambda m: (-m.VD,), rank=5, when=_started),
    FieldSource("EKF1", "air: climb", lambda m: (-m.VD,), rank=4, when=_started),
    FieldSource("BARO", "air: climb", lambda m: (m.CRt,), rank=3, when=lambda m: m.I == 0),
    FieldSource("BARO", "air: climb", lambda m: (m.CRt,), rank=2),
    FieldSource("GPS", "air: climb", lambda m: (-m.VZ,), rank=1, when=_fix),
    FieldSource("RCOU", "servo", lambda m: _outputs(m, " ".join(f"C{n}" for n in range(1, 15))), rank=11),
    FieldSource("RCOU", "servo", lambda m: _outputs(m, " ".join(f"C{n}" for n in range(1, 13))), rank=10),
    FieldSource("RCOU", "servo", lambda m: _outputs(m, "C1 C2 C3 C4 C5 C6 C7 C8"), rank=9),
    FieldSource("RCO2", "servo: 15, 16", lambda m: (m.C15, m.C16)),
    FieldSource("RCOU", "servo", lambda m: _outputs(m, "Ch1 Ch2 Ch3 Ch4 Ch5 Ch6 Ch7 Ch8"), rank=8),
    FieldSource("RCOU", "servo", lambda m: _outputs(m, "Chan1 Chan2 Chan3 Chan4 Chan5 Chan6 Chan7 Chan8"), rank=8),
    FieldSource("RCOU", "servo", lambda m: _outputs(m, "Ch1 Ch2 Ch3 Ch4 Ch5 Ch6"), rank=7),
    FieldSource("RCOU", "servo", lambda m: _outputs(m, "Ch1 Ch2 Ch3 Ch4"), rank=6),
    FieldSource("MOT", "servo", lambda m: _outputs(m, "Mot1 Mot2 Mot3 Mot4 Mot5 Mot6 Mot7 Mot8"), rank=5),
    FieldSource("MOT", "servo", lambda m: _outputs(m, "Mot1 Mot2 Mot3 Mot4 Mot5 Mot6"), rank=4),
    FieldSource("MOT", "servo", lambda m: _outputs(m, "Mot1 Mot2 Mot3 Mot4"), rank=3),
    FieldSource("ATT", "command", lambda m: (m.DesRoll * DEG, m.DesPitch * DEG), rank=3),
    FieldSource("CTUN", "command", lambda m: (m.NavRoll * DEG, m.NavPitch * DEG), rank=2),
    FieldSource("ATT", "command", lambda m: (m.RollIn * DEG, m.PitchIn * DEG), rank=1),
    FieldSource("NTUN", "command: errors", lambda m: (m.XT, m.AltE, m.AsE), rank=3),
    FieldSource("NTUN", "command: errors", lambda m: (m.XT, m.AltErr, m.AspdE), rank=2),
    FieldSource("NTUN", "command: errors", lambda m: (m.XT, m.AltErr, m.ArspdErr), rank=1),
    FieldSource("MISE", "leg", lambda m: (m.CNum,), rank=2, when=_is_leg),
    FieldSource("CMD", "leg", lambda m: (m.CNum,), rank=1, when=_is_leg),  # executed items; item lists are missions
    FieldSource("XKF2", "wind", _wind, rank=5, when=lambda m: (m.C == 0) & _has_wind(m)),
    FieldSource("XKF2", "wind", _wind, rank=4, when=_has_wind),
    FieldSource("NKF2", "wind", _wind, rank=3, when=lambda m: (m.C == 0) & _has_wind(m)),
    FieldSource("NKF2", "wind", _wind, rank=2, when=_has_wind),
    FieldSource("EKF2", "wind", _wind, rank=1, when=_has_wind),
    FieldSource("NTUN", "target", lambda m: _target(m, m.TAW), rank=2, when=_has_target),
    FieldSource(
        "NTUN",
        "target",
        lambda m: _target(m, m.TAlt * np.where(m.is_integer("TAlt"), 1e-2, 1.0)),  # integers are centimetres
        rank=1,
        when=_has_target,
    ),
    FieldSource("BARO", "pressure", lambda m: (m.Press,), rank=2, when=lambda m: (m.I == 0) & (m.Press > 0)),
    FieldSource("BARO", "pressure", lambda m: (m.Press,), rank=1, when=lambda m: m.Press > 0),
    FieldSource("GPS", "gnss", lambda m: (np.rint(m.Alt * 1e3),), rank=2, when=lambda m: (m.I == 0) & _fix(m)),
    FieldSource("GPS", "gnss", lambda m: (np.rint(m.Alt * 1e3),), rank=1, when=_fix),
)

ROWS: dict[str, tuple[FieldSource, ...]] = {
    name: tuple(row for row in TABLE if row.message == name) for name in {row.message for row in TABLE}
}

COLUMNS_OF: dict[str, slice] = {
    part: slice(sum(n for _, n in parts[:i]), sum(n for _, n in parts[: i + 1]))
    for parts in PARTS.values()
    for i, (part, _) in enumerate(parts)
}
"""Columns of the `Sample` field that a part fills; a field without parts fills all."""


def field_of(part: str) -> str:
    """Return the `Sample` field of a part."""
    return part.split(":")[0]


def is_plausible(part: str, values: np.ndarray) -> np.ndarray:
    """Return a mask of the rows of a part, (n, k), with all columns finite and within `MAX_MAGNITUDE`, (n,)."""
    highest = np.array(MAX_MAGNITUDE[field_of(part)])[COLUMNS_OF.get(part, slice(None))][: values.shape[-1]]
    return (np.abs(values) <= highest).all(axis=-1)
