"""One steady flight as tables: CSV, archive, MATLAB file, and ROS 2 bags as MCAP and SQLite."""

import io
import sqlite3
import tarfile
from pathlib import Path

import numpy as np

T0 = 1_600_000_000.0
N, DT = 200, 0.05
ROLL, PITCH, YAW = 0.1, 0.05, 0.3  # [rad]
P, Q, R = 0.01, -0.02, 0.03  # [rad/s]
SPEED, AIRSPEED = (10.0, 5.0, -1.0), 14.0  # NED [m/s]
PLACE = (47.4, 8.5, 520.0)  # [deg, deg, m]

MAP = """
vehicle = "fixed_wing"
autopilot = "ardupilot"
initial_mode = "AUTO"
[tables.all]
file = "FILE"
time = "t"
time_unit = "ms"
[attitude]
columns = ["roll", "pitch", "yaw", "p", "q", "r"]
units = ["deg", "deg", "deg", "deg/s", "deg/s", "deg/s"]
[position]
columns = ["lat", "lon", "alt"]
units = ["deg", "deg", "ft"]
[velocity]
columns = ["ve", "vn", "vu"]
units = "knot"
frame = "enu"
[air]
columns = ["va", "throttle"]
units = ["km/h", "percent"]
[servo]
columns = ["a", "e"]
units = ["normalised", "us"]
"""


def flight_columns() -> dict[str, np.ndarray]:
    """The flight in the units of `MAP`."""
    t = 1e3 * (T0 + DT * np.arange(N))
    values = {"roll": np.degrees(ROLL), "pitch": np.degrees(PITCH), "yaw": np.degrees(YAW)}
    values |= {"p": np.degrees(P), "q": np.degrees(Q), "r": np.degrees(R)}
    values |= {"lat": PLACE[0], "lon": PLACE[1], "alt": PLACE[2] / 0.3048}
    knot = 1852.0 / 3600.0
    values |= {"ve": SPEED[1] / knot, "vn": SPEED[0] / knot, "vu": -SPEED[2] / knot}
    values |= {"va": AIRSPEED * 3.6, "throttle": 60.0, "a": 0.2, "e": 1400.0}
    return {"t": t} | {name: np.full(N, value) for name, value in values.items()}


def csv_text(columns: dict[str, np.ndarray], separator: str = ",") -> str:
    rows = zip(*(values.tolist() for values in columns.values()), strict=True)
    return "\n".join([separator.join(columns), *(separator.join(map(repr, row)) for row in rows)]) + "\n"


def archive(files: dict[str, str]) -> bytes:
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w") as made:
        for name, text in files.items():
            info = tarfile.TarInfo(name)
            info.size = len(text.encode())
            made.addfile(info, io.BytesIO(text.encode()))
    return out.getvalue()


def per_topic() -> dict[str, str]:
    """The flight as ALFA's CSV files, those that a twin needs."""
    ns = np.array([round(1e9 * (T0 + DT * k)) for k in range(N)])

    def text(**columns: float | str) -> str:
        lines = [",".join(["%time", *(name.replace("__", ".") for name in columns)])]
        lines += [",".join([str(t), *map(str, columns.values())]) for t in ns.tolist()]
        return "\n".join(lines) + "\n"

    w, x, y, z = quaternion_enu()
    imu = {"field__orientation__w": w, "field__orientation__x": x, "field__orientation__y": y}
    imu |= {"field__orientation__z": z, "field__angular_velocity__x": P, "field__angular_velocity__y": -Q}
    imu |= {"field__angular_velocity__z": -R, "field__linear_acceleration__x": 0.5}
    imu |= {"field__linear_acceleration__y": -0.2, "field__linear_acceleration__z": 9.8}
    v = {"field__twist__linear__x": SPEED[1], "field__twist__linear__y": SPEED[0], "field__twist__linear__z": -SPEED[2]}
    place = {"field__latitude": PLACE[0], "field__longitude": PLACE[1], "field__altitude": PLACE[2] - 35.0}
    hud = {"field__airspeed": AIRSPEED, "field__throttle": 0.6, "field__altitude": PLACE[2], "field__climb": 1.0}
    channels = {f"field__channels{k}": 1500 + 10 * k for k in range(8)}
    tables = {"imu-data": imu, "local_position-velocity": v, "global_position-global": place, "vfr_hud": hud}
    tables |= {"rc-out": channels, "state": {"field__armed": 1, "field__mode": "GUIDED"}}
    return {f"flight7-mavros-{name}.csv": text(**columns) for name, columns in tables.items()}


def quaternion_enu() -> tuple[float, float, float, float]:
    """The attitude as ROS has it, ENU and FLU: roll, -pitch, pi/2 - yaw."""
    half = np.array([ROLL, -PITCH, np.pi / 2 - YAW]) / 2
    (cr, cp, cy), (sr, sp, sy) = np.cos(half), np.sin(half)
    w, x = cr * cp * cy + sr * sp * sy, sr * cp * cy - cr * sp * sy
    y, z = cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy
    return float(w), float(x), float(y), float(z)


# --- ROS 2 bags ------------------------------------------------------------------------------------------------------

_LINE = "=" * 80
_TIME = f"{_LINE}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
_HEADER = (
    f"std_msgs/Header header\n{{}}\n{_LINE}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\n"
    f"string frame_id\n{_TIME}"
)
_VECTOR = f"{_LINE}\nMSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n"
_TWIST = f"{_LINE}\nMSG: geometry_msgs/Twist\ngeometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n{_VECTOR}"
_QUATERNION = f"{_LINE}\nMSG: geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w\n"
_WAYPOINT = "uint8 frame\nuint16 command\nbool is_current\nbool autocontinue\n" + "".join(
    f"{kind} {name}\n"
    for kind, name in (
        *(("float32", f"param{k}") for k in range(1, 5)),
        *(("float64", name) for name in ("x_lat", "y_long", "z_alt")),
    )
)
MAVROS = {
    "imu/data": (
        "sensor_msgs/msg/Imu",
        _HEADER.format(
            "geometry_msgs/Quaternion orientation\nfloat64[9] orientation_covariance\n"
            "geometry_msgs/Vector3 angular_velocity\ngeometry_msgs/Vector3 linear_acceleration"
        )
        + _QUATERNION
        + _VECTOR,
    ),
    "global_position/global": (
        "sensor_msgs/msg/NavSatFix",
        _HEADER.format("float64 latitude\nfloat64 longitude\nfloat64 altitude"),
    ),
    "local_position/velocity_local": (
        "geometry_msgs/msg/TwistStamped",
        _HEADER.format("geometry_msgs/Twist twist") + _TWIST,
    ),
    "vfr_hud": (
        "mavros_msgs/msg/VfrHud",
        _HEADER.format("float32 airspeed\nfloat32 throttle\nfloat32 altitude\nfloat32 climb"),
    ),
    "rc/out": ("mavros_msgs/msg/RCOut", _HEADER.format("uint16[] channels")),
    "state": ("mavros_msgs/msg/State", _HEADER.format("bool armed\nstring mode")),
    "mission/waypoints": (
        "mavros_msgs/msg/WaypointList",
        f"uint16 current_seq\nmavros_msgs/Waypoint[] waypoints\n{_LINE}\nMSG: mavros_msgs/Waypoint\n{_WAYPOINT}",
    ),
}


def _mavros_values(stamp: dict) -> dict[str, dict]:
    w, x, y, z = quaternion_enu()

    def vector(a: float, b: float, c: float) -> dict[str, float]:
        return {"x": a, "y": b, "z": c}

    header = {"header": {"stamp": stamp, "frame_id": "base_link"}}
    twist = {"linear": vector(SPEED[1], SPEED[0], -SPEED[2]), "angular": vector(0.0, 0.0, 0.0)}
    plain = {"is_current": False, "autocontinue": True, "param1": 0.0, "param2": 0.0, "param3": 0.0, "param4": 0.0}
    items = [
        plain | {"frame": 0 if k == 0 else 3, "command": 16, "x_lat": 47.4 + 0.01 * k, "y_long": 8.5, "z_alt": 100.0}
        for k in range(4)
    ]
    return {
        "imu/data": header
        | {"orientation": {"x": x, "y": y, "z": z, "w": w}, "orientation_covariance": [0.0] * 9}
        | {"angular_velocity": vector(P, -Q, -R), "linear_acceleration": vector(0.5, -0.2, 9.8)},
        "global_position/global": header | {"latitude": PLACE[0], "longitude": PLACE[1], "altitude": PLACE[2] + 47.0},
        "local_position/velocity_local": header | {"twist": twist},
        "vfr_hud": header | {"airspeed": AIRSPEED, "throttle": 0.6, "altitude": PLACE[2], "climb": 1.0},
        "rc/out": header | {"channels": [1500 + 10 * k for k in range(8)]},
        "state": header | {"armed": True, "mode": "AUTO"},
        "mission/waypoints": {"current_seq": 2, "waypoints": items},
    }


PX4 = {
    "vehicle_attitude": ("px4_msgs/msg/VehicleAttitude", "uint64 timestamp\nfloat32[4] q\n"),
    "vehicle_angular_velocity": ("px4_msgs/msg/VehicleAngularVelocity", "uint64 timestamp\nfloat32[3] xyz\n"),
    "vehicle_global_position": (
        "px4_msgs/msg/VehicleGlobalPosition",
        "uint64 timestamp\nfloat64 lat\nfloat64 lon\nfloat32 alt\n",
    ),
    "vehicle_status": (
        "px4_msgs/msg/VehicleStatus",
        "uint64 timestamp\nuint8 nav_state\nuint8 arming_state\nuint8 system_type\n",
    ),
}


def _px4_values(us: int) -> dict[str, dict]:
    half = np.array([ROLL, PITCH, YAW]) / 2
    (cr, cp, cy), (sr, sp, sy) = np.cos(half), np.sin(half)
    q = [cr * cp * cy + sr * sp * sy, sr * cp * cy - cr * sp * sy]
    q += [cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy]
    return {
        "vehicle_attitude": {"timestamp": us, "q": [float(e) for e in q]},
        "vehicle_angular_velocity": {"timestamp": us, "xyz": [P, Q, R]},
        "vehicle_global_position": {"timestamp": us, "lat": PLACE[0], "lon": PLACE[1], "alt": PLACE[2]},
        "vehicle_status": {"timestamp": us, "nav_state": 3, "arming_state": 2, "system_type": 1},
    }


def _bag(px4: bool):
    """Topic, type, definition, log time [ns] and message, in order of time."""
    for k in range(N):
        ns = round(1e9 * (T0 + DT * k))
        stamp = {"sec": ns // 10**9, "nanosec": ns % 10**9}
        values = _px4_values(round(1e6 * (50 + DT * k))) if px4 else _mavros_values(stamp)
        for name, (kind, definition) in (PX4 if px4 else MAVROS).items():
            topic = f"/fmu/out/{name}_v1" if px4 else f"/uas7/mavros/{name}"
            if name not in ("mission/waypoints", "state", "vehicle_status") or k % 20 == 0:
                yield topic, kind, definition, ns + 2_000_000, values[name]


def write_mcap(path: Path, *, px4: bool = False) -> Path:
    from mcap_ros2.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file)
        schemas: dict[str, object] = {}
        for topic, kind, definition, ns, message in _bag(px4):
            if kind not in schemas:
                schemas[kind] = writer.register_msgdef(kind, definition)
            writer.write_message(topic, schemas[kind], message, log_time=ns, publish_time=ns)
        writer.finish()
    return path


def write_sqlite(path: Path, *, px4: bool = False, definitions: bool = True) -> Path:
    """Write a bag as ROS 2 Iron does; without `definitions` as Humble does."""
    from mcap.reader import make_reader

    mcap = write_mcap(path.with_suffix(".made"), px4=px4)
    base = sqlite3.connect(path)
    base.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)")
    base.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)")
    if definitions:
        base.execute(
            "CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT, encoding TEXT, "
            "encoded_message_definition TEXT, type_description_hash TEXT)"
        )
    numbers: dict[str, int] = {}
    with mcap.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            if channel.topic not in numbers:
                number = numbers[channel.topic] = len(numbers) + 1
                base.execute("INSERT INTO topics VALUES(?, ?, ?, 'cdr')", (number, channel.topic, schema.name))
                if definitions:
                    row = (number, schema.name, "ros2msg", schema.data.decode(), "")
                    base.execute("INSERT INTO message_definitions VALUES(?, ?, ?, ?, ?)", row)
            row = (numbers[channel.topic], message.log_time, message.data)
            base.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES(?, ?, ?)", row)
    base.commit()
    base.close()
    mcap.unlink()
    return path
