"""Write ULog bytes as PX4's logger does, one steady flight as its releases named things, and read it back."""

import io
import struct

import numpy as np

from fleet.telemetry.onboard_logs.ulog.reader import UlogLog

MAGIC = b"ULog\x01\x12\x35\x01"
START_US = 10_000_000
UTC_US = 1_600_000_000_000_000  # satellite time when the log's clock was zero
_TYPE = {
    "u4": "uint32_t",
    "f4": "float",
    "f8": "double",
    "u1": "uint8_t",
    "u2": "uint16_t",
    "i4": "int32_t",
    "u8": "uint64_t",
}
EARTH_M = 6_371_000.0


def message(kind: str, body: bytes) -> bytes:
    return struct.pack("<HB", len(body), ord(kind)) + body


def keyed(kind: str, key: str, value: bytes) -> bytes:
    return message(kind, bytes([len(key)]) + key.encode() + value)


def _fields(name: str, columns: dict) -> tuple[list[str], list[bytes]]:
    """Formats of a topic (nested ones first) and the dtype of a row."""
    formats, own, dtype = [], [], []
    for field, values in columns.items():
        if isinstance(values, dict):
            inner, inner_dtype = _fields(f"{name}_{field}", values)
            formats += inner
            own.append(f"{name}_{field} {field}")
            dtype.append((field, inner_dtype))
        else:
            many = f"[{values.shape[1]}]" if values.ndim > 1 else ""
            own.append(f"{_TYPE[values.dtype.str[1:]]}{many} {field}")
            dtype.append((field, values.dtype.newbyteorder("<"), values.shape[1:]))
    return [*formats, f"{name}:{';'.join(own)};"], np.dtype(dtype)


def _lay(columns: dict, into: np.ndarray) -> None:
    for field, values in columns.items():
        if isinstance(values, dict):
            _lay(values, into[field])
        else:
            into[field] = values


def ulog(topics: dict, *, info=(), params=None, texts=(), changed=(), start_us=START_US) -> bytes:
    """A log of `{"name" or "name.instance": {field: array}}`, rows in order of time."""
    out = [MAGIC, struct.pack("<Q", start_us), message("B", bytes(40))]
    rows, subscriptions, formats = [], [], {}
    for number, (full, columns) in enumerate(topics.items()):
        name, _, instance = full.partition(".")
        texts_of, dtype = _fields(name, columns)
        formats |= dict.fromkeys(texts_of)
        subscriptions.append(message("A", struct.pack("<BH", int(instance or 0), number) + name.encode()))
        table = np.zeros(len(columns["timestamp"]), dtype)
        _lay(columns, table)
        rows += [(int(row["timestamp"]), message("D", struct.pack("<H", number) + row.tobytes())) for row in table]
    out += [message("F", text.encode()) for text in formats]
    out += [keyed("I", key, value) for key, value in info]
    for name, value in (params or {}).items():
        kind = "int32_t" if isinstance(value, int) else "float"
        out.append(keyed("P", f"{kind} {name}", struct.pack("<i" if kind == "int32_t" else "<f", value)))
    out += subscriptions
    rows += [(t, message("L", struct.pack("<BQ", ord("0") + grade, t) + text.encode())) for t, grade, text in texts]
    rows += [(t, keyed("P", f"float {name}", struct.pack("<f", value))) for t, name, value in changed]
    return b"".join([*out, *(data for _, data in sorted(rows, key=lambda row: row[0]))])


def release(major: int, minor: int, patch: int) -> tuple[str, bytes]:
    return "uint32_t ver_sw_release", struct.pack("<I", major << 24 | minor << 16 | patch << 8 | 255)


# --- one steady flight --------------------------------------------------------------------------------------------

TRUTH = {
    "attitude": (0.1, 0.2, 0.3, 0.01, 0.02, 0.03),
    "imu": (1.0, 2.0, -9.8, 0.01, 0.02, 0.03),
    "position": (474000000, 85000000, 500000),
    "velocity": (10.0, 1.0, -0.5),
    "air": (15.0, 0.6, 0.5),
    "servo": (1600.0, 1400.0, 1500.0, 2000.0, 0.0, 0.0, 0.0, 0.0),
    "command": (0.15, 0.05, -4.0, 20.0, 2.0),
    "leg": (3.0,),
    "wind": (2.0, -1.0),
    "target": (474100000, 85100000, 520000),
    "pressure": (95500.0,),
    "gnss": (500000,),
}


def quaternion(phi: float, theta: float, psi: float) -> list[float]:
    c, s = np.cos(np.array([phi, theta, psi]) / 2), np.sin(np.array([phi, theta, psi]) / 2)
    return [
        c[0] * c[1] * c[2] + s[0] * s[1] * s[2],
        s[0] * c[1] * c[2] - c[0] * s[1] * s[2],
        c[0] * s[1] * c[2] + s[0] * c[1] * s[2],
        c[0] * c[1] * s[2] - s[0] * s[1] * c[2],
    ]


def topic(hz: float, seconds: float, **fields) -> dict:
    """Constant columns at a rate; a whole number is uint8, `("i4", x)` has its type named, else float."""
    n = round(hz * seconds)
    columns = {"timestamp": (START_US + 1e6 * np.arange(n) / hz).astype("<u8")}

    def column(value):
        if isinstance(value, dict):
            return {name: column(inner) for name, inner in value.items()}
        kind, value = value if isinstance(value, tuple) else ("u1" if isinstance(value, int) else "f4", value)
        return np.tile(np.array(value, "<" + kind if kind != "u1" else "u1"), (n, *[1] * np.ndim(value)))

    return columns | {name: column(value) for name, value in fields.items()}


def flight(version: tuple[int, int], seconds: float = 5.0) -> dict:
    """Topics of TRUTH as that release named them."""
    q, rates, acc = quaternion(0.1, 0.2, 0.3), [0.01, 0.02, 0.03], [1.0, 2.0, -9.8]
    place = {"lat": ("f8", 47.4), "lon": ("f8", 8.5), "alt": 500.0}
    whole = {"lat": ("i4", 474000000), "lon": ("i4", 85000000), "alt": ("i4", 500000)}
    double = {"latitude_deg": ("f8", 47.4), "longitude_deg": ("f8", 8.5), "altitude_msl_m": ("f8", 500.0)}
    ned = {"vel_n_m_s": 10.0, "vel_e_m_s": 1.0, "vel_d_m_s": -0.5, "vel_ned_valid": 1, "fix_type": 3}
    utc = {"time_utc_usec": ("u8", 0)}
    away = {"x": EARTH_M * np.radians(0.01), "y": 0.0, "z": -100.0, "ref_lat": ("f8", 47.39), "ref_lon": ("f8", 8.5)}
    local = away | {"ref_alt": 400.0, "vx": 10.0, "vy": 1.0, "vz": -0.5}
    local |= dict.fromkeys(("xy_global", "z_global", "v_xy_valid", "v_z_valid"), 1)
    there = {"lat": ("f8", 47.41), "lon": ("f8", 8.51), "alt": 520.0, "valid": 1, "type": 0}
    outputs = [1600.0, 1400.0, 1500.0, 2000.0] + [0.0] * 12
    wind = {"windspeed_north": 2.0, "windspeed_east": -1.0}
    sixteen, fourteen, eleven = version >= (1, 16), version >= (1, 14), version >= (1, 11)
    barometer = {"pressure": 95500.0 if fourteen else 955.0}
    said = {
        "sensor_combined": {"gyro_rad": rates, "accelerometer_m_s2": acc},
        "vehicle_local_position": local,
        "airspeed": {"indicated_airspeed_m_s": 15.0, "true_airspeed_m_s": 15.4},
        "position_setpoint_triplet": {"current": there},
        "mission_result": {"seq_current": ("i4", 3)},
        "vehicle_gps_position": utc | (double if fourteen else whole) | ned,
        "sensor_gps": utc | (double if fourteen else whole) | ned,
        "vehicle_attitude": {"q": q},
        "vehicle_status": {"nav_state": 3, "arming_state": 2, "system_type": 1, "system_id": 7},
        "vehicle_attitude_setpoint": {"q_d": quaternion(0.15, 0.05, 0.3)},
        "mission": {"current_seq": ("i4", 3)},
        "vehicle_global_position": place,
        "sensor_baro": barometer,
    }
    if version >= (1, 8):
        said["vehicle_air_data"] = {"baro_pressure_pa": 95500.0}
    if not sixteen:
        said["vehicle_attitude_setpoint"] |= {"roll_body": 0.15, "pitch_body": 0.05}
    if eleven:
        said["vehicle_angular_velocity"] = {"xyz": rates}
        said["vehicle_acceleration"] = {"xyz": acc}
        named = "equivalent_airspeed_m_s" if version < (1, 12) else "calibrated_airspeed_m_s"
        said["airspeed_validated"] = {named: 15.0}
        said["position_controller_status"] = {"xtrack_error": -4.0}
    else:
        said["vehicle_attitude"] |= {"rollspeed": 0.01, "pitchspeed": 0.02, "yawspeed": 0.03}
        said["vehicle_global_position"] |= {"vel_n": 10.0, "vel_e": 1.0, "vel_d": -0.5}
        said["fw_pos_ctrl_status"] = {"xtrack_error": -4.0}
        said["offboard_mission"] = {"current_seq": ("i4", 3)}
    said["tecs_status"] = _tecs(version)
    if fourteen:
        said["vehicle_thrust_setpoint"] = {"xyz": [0.6, 0.0, 0.0]}
        said["vehicle_thrust_setpoint.1"] = {"xyz": [0.0, 0.0, -0.2]}
        said["actuator_servos"] = {"control": [0.2, -0.2, 0.0, 1.0, *[float("nan")] * 4]}
        said["actuator_motors"] = {"control": [0.6, 0.4, 0.5, 1.0, *[float("nan")] * 8]}
        said["wind"] = said["airspeed_wind"] = wind
        said["navigator_mission_item"] = {"sequence_current": ("u2", 3)}
    else:
        said["wind_estimate"] = wind
        said["actuator_outputs"] = {"output": outputs}
        said["actuator_controls_0"] = {"control": [0.0, 0.0, 0.0, 0.6]}
        said["actuator_controls_1"] = {"control": [0.0, 0.0, 0.0, 0.1]}
    hz = {"vehicle_status": 2.0, "mission_result": 1.0, "wind": 5.0, "sensor_combined": 100.0}
    made = {name: topic(hz.get(name, 10.0), seconds, **fields) for name, fields in said.items()}
    for name in ("vehicle_gps_position", "sensor_gps"):
        made[name]["time_utc_usec"] = made[name]["timestamp"] + np.uint64(UTC_US)
    if sixteen:
        made["vtol_vehicle_status"] = topic(2.0, seconds, vehicle_vtol_state=3)
        made["vtol_vehicle_status"]["vehicle_vtol_state"][4:] = 1
        made["vtol_vehicle_status"]["vehicle_vtol_state"][7:] = 4
    return made


def _tecs(version: tuple[int, int]) -> dict:
    if version >= (1, 14):
        return {"altitude_sp": 520.0, "true_airspeed_sp": 17.0, "true_airspeed_filtered": 15.0}
    if version >= (1, 12):
        speeds = {"true_airspeed_sp": 17.0, "true_airspeed_filtered": 15.0}
    elif version >= (1, 8):
        speeds = {"airspeed_sp": 17.0, "airspeed_filtered": 15.0}
    else:
        return {"altitudeSp": 520.0, "altitude_filtered": 500.0, "airspeedSp": 17.0, "airspeed_filtered": 15.0}
    return {"altitude_sp": 520.0, "altitude_filtered": 500.0} | speeds


# --- reading it back --------------------------------------------------------------------------------------------------


def read(data: bytes, name: str = "x.ulg") -> UlogLog:
    return UlogLog(lambda: io.BytesIO(data), name)


def rows(log: UlogLog) -> dict:
    """All chunks put together."""
    chunks = list(log.chunks())
    fields = {field for chunk in chunks for field in chunk.rows}
    return {
        field: tuple(np.concatenate([chunk.rows[field][i] for chunk in chunks if field in chunk.rows]) for i in (0, 1))
        for field in fields
    }


def said(log: UlogLog, what: str) -> list:
    return [s.value for chunk in log.chunks() for s in chunk.events if s.kind == what]
