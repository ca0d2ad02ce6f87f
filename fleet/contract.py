"""THE TABLE: one frozen struct per message on the bus. This file is the public interface of ParaUAV.

    key                                  class        from     what
    parauav/{uav}/sample                 Sample       gateway  telemetry rows on the fleet clock, about every 100 ms
    parauav/{uav}/status                 Status       gateway  link, mode, rates, losses (1 Hz and on change)
    parauav/{uav}/mission                Mission      gateway  the route on board and the current item
    parauav/{uav}/params                 Params       gateway  autopilot parameters
    parauav/{uav}/history                History      gateway  query only: the last minutes of one aircraft
    parauav/{uav}/model                  Model        worker   identified model with its verdict
    parauav/{uav}/prediction             Prediction   worker   mean path, prediction region, horizon; also queryable
    parauav/{uav}/mismatch               Mismatch     worker   location, effect, fit before and after; also queryable
    parauav/{uav}/alert                  Alert        worker   predicted conflict, geofence, ground, …; also queryable
                                                      gateway  a second sender with the same id; also queryable
    parauav/{uav}/proposal               Proposal     worker   changes of plan against an alert; also queryable
    parauav/{uav}/approval               Approval     operator a person approves an option, or its undo
    parauav/{uav}/execution              Execution    gateway  what was sent for it, and how it is flown; also queryable
    parauav/@fleet/state/{writer}        FleetState   worker   one row per UAV; also queryable
    parauav/@fleet/sample/{writer}       Samples      gateway  the same samples, those of many aircraft in one message
    parauav/@fleet/prediction/{writer}   Predictions  worker   query only: the newest prediction of all its aircraft
    parauav/@world/wind/{writer}         WindField    worker   one wind field from all aircraft; also queryable
    parauav/@world/siblings/{writer}     Siblings     worker   what aircraft of one type share; also queryable
    parauav/@gateway/{writer}            GatewayCounters gateway counters of one gateway; also queryable
    parauav/@claim/{writer}              Claim        worker   aircraft it writes for; every 0.25 s; also queryable
    parauav/@handover/{writer}           Handover     worker   query only, with a `HandoverRequest`: copies of twins
    parauav/@live/worker/{writer}/{lo-hi}/{incarnation}        liveliness token of a worker and the ids it may own

`*` and `**` never match a chunk that starts with `@`, so `parauav/*/prediction` is aircraft only.

Wire: a msgpack map; any msgpack library reads it. Arrays are maps `{dtype, shape, data}`. The Zenoh encoding
carries the version: `application/msgpack;parauav.prediction.2`. Fields may be added (with a default); a reader
refuses another major version. Worker results carry an attachment of 16 bytes, little endian: epoch u64, writer u64.
An epoch is the time of the claim [ms since 1970], at least the previous epoch plus one. Readers reject an epoch more
than 5 minutes ahead of their own clock and accept the highest of the others per UAV.

Time `t` is seconds since 1970 on the fleet clock. Angles in rad, SI throughout, NED and FRD frames.
"""

from collections.abc import Sequence
from enum import StrEnum
from math import prod
from typing import Annotated, Any, ClassVar

import msgspec
import numpy as np
from msgspec import Meta

from fleet.frames import Origin

DTYPES = ("<f4", "<f8", "<i4", "<i8", "|u1")
_DTYPES = {name: np.dtype(name) for name in DTYPES}
MAX_ITEMS = 1_000  # mission items accepted from outside


def about(text: str) -> Meta:
    """Annotate a field with its meaning and unit."""
    return Meta(description=text)


class Array(msgspec.Struct, frozen=True, gc=False):  # numbers form no reference cycles
    """A numpy array on the wire: `numpy.frombuffer(data, dtype).reshape(shape)`."""

    dtype: Annotated[str, about("numpy dtype string, little endian: " + " ".join(DTYPES))]
    shape: tuple[int, ...]
    data: bytes

    @classmethod
    def of(cls, values: Any, dtype: str = "<f4") -> "Array":
        """Wrap anything array-like as `dtype`."""
        a = np.ascontiguousarray(values, dtype=dtype)
        return cls(dtype, a.shape, a.tobytes())

    def numpy(self) -> np.ndarray:
        """Return the values as a read-only numpy array.

        Raises:
            ValueError: when dtype, shape and byte count disagree; the sender must correct it.
        """
        dtype, shape = _DTYPES.get(self.dtype), self.shape
        if dtype is None or len(shape) > 4 or (shape and not 0 <= min(shape) <= max(shape) < 2**31):
            raise ValueError(f"array: found dtype {self.dtype!r} shape {self.shape}, expected one of {DTYPES}; resend")
        n_bytes = prod(shape) * dtype.itemsize
        if n_bytes != len(self.data):
            raise ValueError(f"array: found {len(self.data)} bytes, shape {self.shape} needs {n_bytes}; resend")
        return np.frombuffer(self.data, dtype).reshape(shape)


class Rows(msgspec.Struct, frozen=True, gc=False):
    """Measurements of one type, each row with its own time."""

    t: Annotated[Array, about("fleet time of each row, (n,) <f8 [s since 1970]")]
    x: Annotated[Array, about("values, (n, k); columns as in COLUMNS, followed by those of EXTRA_COLUMNS or not")]


COLUMNS: dict[str, tuple[tuple[str, str], ...]] = {
    "attitude": (("phi", "rad"), ("theta", "rad"), ("psi", "rad"), ("p", "rad/s"), ("q", "rad/s"), ("r", "rad/s")),
    "imu": (("a_x", "m/s2"), ("a_y", "m/s2"), ("a_z", "m/s2"), ("p", "rad/s"), ("q", "rad/s"), ("r", "rad/s")),
    "position": (("lat", "1e-7 deg"), ("lon", "1e-7 deg"), ("alt", "mm above mean sea level")),
    "velocity": (("v_n", "m/s"), ("v_e", "m/s"), ("v_d", "m/s")),
    "air": (("Va", "m/s, as the autopilot reports it"), ("delta_t", "0..1"), ("climb", "m/s")),
    "servo": tuple((f"servo{i}", "us pulse width") for i in range(1, 9)),
    "command": (
        ("phi_c", "rad"),
        ("theta_c", "rad"),
        ("xtrack_error", "m"),
        ("alt_error", "m, setpoint minus actual"),
        ("Va_error", "m/s, setpoint minus actual"),
    ),
    "leg": (("seq", "current mission item"),),
    "wind": (("w_n", "m/s"), ("w_e", "m/s")),
    "target": (("lat", "1e-7 deg"), ("lon", "1e-7 deg"), ("alt", "mm above mean sea level")),
    "pressure": (("static", "Pa"),),
    "gnss": (("alt", "mm above mean sea level, as reported by the receiver"),),
    "height": (("above_home", "m"),),
    "bearing": (("target_bearing", "rad"),),
    "battery": (("voltage", "V"), ("current", "A"), ("remaining", "0..1")),
}
"""Columns of each `Rows` field of a `Sample`: name and unit, in wire order. Specific force and rates are FRD."""
EXTRA_COLUMNS = {"servo": tuple((f"servo{i}", "us pulse width, 0: no output") for i in range(9, 17))}
"""Columns that follow those of `COLUMNS` in the messages in which at least one of them is not 0, by field."""
ROW_WIDTHS: dict[str, tuple[int, ...]] = {
    name: (len(columns), len(columns) + len(EXTRA_COLUMNS[name])) if name in EXTRA_COLUMNS else (len(columns),)
    for name, columns in COLUMNS.items()
}
"""Possible numbers of columns of each field."""
FIRST_OPTIONAL_COLUMN = {"command": 2, "battery": 1}
"""Index of the first column that is nan where the autopilot does not report it, by field."""


class Message(msgspec.Struct, frozen=True, kw_only=True):
    """Base of all messages about one aircraft: its id and the time."""

    topic: ClassVar[str] = ""
    version: ClassVar[int] = 1

    uav: Annotated[int, about("UAV id: MAVLink system id + the link's offset")]
    t: Annotated[float, about("fleet time of the newest content [s since 1970]")]


class Sample(Message, frozen=True, kw_only=True, gc=False):
    """Telemetry rows of one aircraft since the previous message; a field without new rows is absent."""

    topic: ClassVar[str] = "sample"

    attitude: Rows | None = None
    imu: Rows | None = None
    position: Rows | None = None
    velocity: Rows | None = None
    air: Rows | None = None
    servo: Rows | None = None
    command: Rows | None = None
    leg: Rows | None = None
    wind: Annotated[Rows | None, about("estimated by the autopilot, the direction it blows to [m/s]")] = None
    target: Annotated[Rows | None, about("guidance target reported by the autopilot")] = None
    pressure: Annotated[Rows | None, about("raw barometer reading [Pa]")] = None
    gnss: Annotated[Rows | None, about("raw reading of the satellite receiver")] = None
    height: Annotated[Rows | None, about("above home, as reported by the autopilot [m]")] = None
    bearing: Annotated[Rows | None, about("to the guidance target, or course of the path that is followed [rad]")] = (
        None
    )
    battery: Annotated[Rows | None, about("of the propulsion: voltage, current, remaining share")] = None


class Link(StrEnum):
    """State of the radio link to one aircraft."""

    LIVE = "live"
    LOST = "lost"


class Status(Message, frozen=True, kw_only=True):
    """State of the link and of the aircraft."""

    topic: ClassVar[str] = "status"

    link: Link = Link.LIVE
    mode: Annotated[str, about("flight mode as named by the autopilot, e.g. AUTO")] = ""
    armed: bool = False
    autopilot: Annotated[str, about("ardupilot, px4 or generic")] = "generic"
    vehicle: Annotated[str, about("fixed_wing, quadplane, multirotor, helicopter or unknown")] = "unknown"
    rates_hz: Annotated[dict[str, float], about("received rate of each message [Hz]")] = {}
    received: Annotated[int, about("messages received")] = 0
    missed: Annotated[int, about("messages lost, from gaps in the sequence number")] = 0
    rejected: Annotated[int, about("messages or fields rejected (not finite, out of range, stale)")] = 0
    clock_offset_s: Annotated[float, about("fleet time minus the aircraft's boot time [s]")] = 0.0
    clock_jumps: Annotated[int, about("number of jumps of the aircraft's clock")] = 0
    clock_advance_s: Annotated[
        float, about("sum of the forward corrections of timestamps that lagged behind their arrival [s]")
    ] = 0.0
    clock_drift: Annotated[
        float | None, about("drift of the aircraft's clock behind the fleet clock [s/s]; null: not known yet")
    ] = None
    latency_s: Annotated[float, about("mean delay of messages relative to the fastest of the last 30 s [s]")] = 0.0
    latency_worst_s: Annotated[float, about("the same, maximum since the previous status [s]")] = 0.0
    round_trip_s: Annotated[float | None, about("minimum recent round-trip time (TIMESYNC) [s]; null: no reply")] = None
    gps_offset_s: Annotated[
        float | None, about("fleet time minus satellite time of the same instant (SYSTEM_TIME) [s]; null: not reported")
    ] = None
    home: Annotated[
        tuple[int, int, int] | None,
        about("home: latitude, longitude [1e-7 deg], altitude above mean sea level [mm]; null: not reported yet"),
    ] = None
    sentence: Annotated[str, about("note for the operator, or empty")] = ""


class Item(msgspec.Struct, frozen=True, kw_only=True):
    """One mission item of MAVLink (MISSION_ITEM_INT)."""

    seq: int
    command: Annotated[int, about("MAV_CMD")]
    frame: Annotated[int, about("MAV_FRAME")] = 3
    param1: float = 0.0
    param2: float = 0.0
    param3: float = 0.0
    param4: float = 0.0
    lat_e7: Annotated[int, about("[1e-7 deg]")] = 0
    lon_e7: Annotated[int, about("[1e-7 deg]")] = 0
    alt_m: Annotated[float, about("altitude in the item's frame [m]")] = 0.0

    @classmethod
    def at(
        cls, position: tuple[float, float, float], *, seq: int, command: int, frame: int, params: Sequence[float] = ()
    ) -> "Item":
        """Return an item at latitude, longitude [deg] and altitude [m], with its first parameters."""
        p1, p2, p3, p4 = (*params, 0.0, 0.0, 0.0, 0.0)[:4]
        lat_e7, lon_e7 = (round(x * 1e7) for x in position[:2])
        place = {"lat_e7": lat_e7, "lon_e7": lon_e7, "alt_m": position[2]}
        return cls(seq=seq, command=command, frame=frame, param1=p1, param2=p2, param3=p3, param4=p4, **place)  # type: ignore[arg-type]


class Mission(Message, frozen=True, kw_only=True):
    """The route and the fence items on board; item 0 of an ArduPilot mission is home."""

    topic: ClassVar[str] = "mission"

    items: tuple[Item, ...] = ()
    fence: Annotated[tuple[Item, ...], about("fence items (MAV_CMD_NAV_FENCE_*); empty where none were received")] = ()
    seq: Annotated[int, about("current item when this was sent; -1 unknown")] = -1
    complete: Annotated[bool, about("every item was received")] = False
    sentence: Annotated[str, about("error in the mission, or empty")] = ""


class Params(Message, frozen=True, kw_only=True):
    """Autopilot parameters, in the autopilot's names and units; always finite."""

    topic: ClassVar[str] = "params"

    values: dict[str, float] = {}
    complete: bool = False
    sentence: str = ""


class History(Message, frozen=True, kw_only=True):
    """Recent messages of one aircraft, oldest first; `?seconds=20` limits the length."""

    topic: ClassVar[str] = "history"

    since: Annotated[float, about("fleet time from which on the history is complete [s since 1970]")] = 0.0
    samples: tuple[Sample, ...] = ()
    statuses: tuple[Status, ...] = ()


class Outcome(StrEnum):
    """Outcome of an identification; an outcome other than VERIFIED is not an error.

    VERIFIED: fit above the threshold and above persistence, consistent with held-out data, and with a stated power.
    PLAUSIBLE: fit above the threshold and above persistence only; the model predicts as a verified one does.
    """

    VERIFIED = "verified"
    PLAUSIBLE = "plausible"
    INSUFFICIENT_DATA = "insufficient_data"
    NOT_IDENTIFIABLE = "not_identifiable"
    BELOW_THRESHOLD = "below_threshold"
    WORSE_THAN_LAST = "worse_than_last"
    DRIFTING = "drifting"
    DIVERGED = "diverged"

    @property
    def is_accepted(self) -> bool:
        """Return whether the model may predict."""
        return self in (Outcome.VERIFIED, Outcome.PLAUSIBLE)


class Verdict(msgspec.Struct, frozen=True, kw_only=True):
    """Validation of a model on data it was not identified from."""

    outcome: Outcome
    sentence: str
    fit: Annotated[dict[str, float], about("100 (1 - nrmse) per state at `horizon_s` [%]")] = {}
    fit_persistence: Annotated[dict[str, float], about("the same for the persistence forecast (last value) [%]")] = {}
    fit_by_length: Annotated[
        dict[str, float], about("mean fit of both axes by free-run length in s, e.g. lon16, lat16 [%]")
    ] = {}
    whiteness: Annotated[
        dict[str, float], about("share of one-step residual autocorrelations within the bounds of white noise, 0..1")
    ] = {}
    horizon_s: Annotated[float, about("free-run length of the fit [s]")] = 0.0
    threshold: Annotated[float, about("omega: minimum mean fit [%]")] = 0.0
    attempts: Annotated[int, about("identification attempts for this verdict")] = 0
    derivative_error: Annotated[
        dict[str, float],
        about("estimated error of each group of derivatives that is inconsistent with held-out data [%]"),
    ] = {}
    detectable_error: Annotated[
        dict[str, float],
        about("power: smallest error of a group of derivatives that is rejected with 95 % probability, up to 50 [%]"),
    ] = {}


class LinearModel(msgspec.Struct, frozen=True, kw_only=True):
    """Discrete linear model about a trim point: x' = A x + B u + c, y = x (C = I, D = 0).

    Source: Huang 2021 eq. 2-4.
    """

    states: Annotated[tuple[str, ...], about("state names: u w q theta | phi psi p r v")]
    inputs: Annotated[tuple[str, ...], about("input names: delta_e delta_t | delta_a delta_r")]
    A: Array
    B: Array
    C: Array
    D: Array
    x_trim: Annotated[Array, about("state at trim, u v w through the air, (n,) [m/s, rad, rad/s]")]
    u_trim: Annotated[Array, about("input at trim, (m,) [-]")]
    dt_s: Annotated[float, about("sample time [s]")]


class SiblingData(msgspec.Struct, frozen=True, kw_only=True):
    """What the data of one aircraft alone say about the terms that aircraft of its type share.

    The terms are those of `SiblingType`; likelihood of them theta: exp(-theta' information theta / 2 + score' theta).
    """

    airframe_type: Annotated[str, about("type: vehicle, airframe file or parameter, mass class")]
    airspeed: Annotated[float, about("of the derivatives [m/s]")]
    throttle: Annotated[float, about("mean delta_t [-]")]
    information: Annotated[Array, about("(k, k) <f8")]
    score: Annotated[Array, about("(k,) <f8")]


class Derivatives(msgspec.Struct, frozen=True, kw_only=True):
    """Coupled model: specific force [m/s2], angular acceleration [rad/s2] per unit of each term, and wind.

    Terms and letters: `fleet.physics.wrench`.
    """

    names: Annotated[tuple[str, ...], about("X_0 X_u ... N_0 w_n w_e")]
    value: Annotated[Array, about("(n,) <f8")]
    covariance: Annotated[Array, about("(n, n) <f4")]
    variance_reduction: Annotated[Array, about("relative reduction of each prior variance by the data, (n,) 0..1")]
    U0: Annotated[float, about("airspeed of the trim point of the derivatives [m/s]")]
    W0: Annotated[float, about("velocity down the body at trim [m/s]")]
    tau_s: Annotated[Array, about("lags of delta_a delta_e delta_r delta_t, (4,) [s]")]
    prior: Annotated[str, about("airframe used as prior for what the data do not identify")] = ""
    window_t0: Annotated[float, about("first instant of the identification window [s since 1970]")] = 0.0
    window_s: Annotated[float, about("length of the identification window [s]")] = 0.0
    sentence: Annotated[str, about("parameters identified from the data and those set by the prior")] = ""
    data: Annotated[SiblingData | None, about("for aircraft of its type; null: its type is not known")] = None
    siblings: Annotated[int, about("aircraft of its type that the prior was learnt from; 0: none")] = 0


class RotorDynamics(msgspec.Struct, frozen=True, kw_only=True):
    """Model of a multirotor: thrust and drag over mass, and the answer of the attitude to its command.

    Terms and letters: `twin_worker.identification.multirotor.rotor_model`.
    """

    names: Annotated[tuple[str, ...], about("k e k_c k_h d c w_n w_e phi_0 theta_0 wn_phi zeta_phi b_phi ...")]
    value: Annotated[Array, about("(n,) <f8")]
    covariance: Annotated[Array, about("(n, n) <f8")]
    variance_reduction: Annotated[Array, about("relative reduction of each prior variance by the data, (n,) 0..1")]
    hover_input: Annotated[float, about("mean motor input of the window, 0..1")]
    airspeed: Annotated[float, about("mean airspeed of the window, with the estimated wind [m/s]")]
    has_command: Annotated[bool, about("the commanded attitude was received; else its parameters are the prior's")]
    window_t0: Annotated[float, about("first instant of the identification window [s since 1970]")] = 0.0
    window_s: Annotated[float, about("length of the identification window [s]")] = 0.0
    sentence: Annotated[str, about("thrust, drag and wind with their standard deviations")] = ""


class Model(Message, frozen=True, kw_only=True):
    """Active model (none before the first accepted one), newest identification window and its verdict."""

    topic: ClassVar[str] = "model"
    version: ClassVar[int] = 2

    method: Annotated[str, about("dynamics (coupled derivatives) or paper (two linear axes)")]
    verdict: Annotated[Verdict, about("of the newest identification")]
    active_verdict: Annotated[Verdict | None, about("of the model below; null before any was accepted")] = None
    longitudinal: LinearModel | None = None
    lateral: LinearModel | None = None
    derivatives: Annotated[Derivatives | None, about("of the coupled model; null for method paper")] = None
    rotors: Annotated[RotorDynamics | None, about("of a multirotor; null for wings")] = None
    shrinkage_weights: Annotated[
        dict[str, float], about("weight of the model against persistence in a 10 s free run, from held-out data, 0..1")
    ] = {}
    window_t0: Annotated[float, about("first instant of the identification window [s since 1970]")] = 0.0
    window_s: Annotated[float, about("length of the identification window [s]")] = 0.0
    interpolated: Annotated[float, about("share of the window that was interpolated, 0..1")] = 0.0
    wind_n: Annotated[float, about("estimated wind, north, the direction it blows to [m/s]")] = 0.0
    wind_e: Annotated[float, about("estimated wind, east [m/s]")] = 0.0
    active_effect: Annotated[
        str, about("missing physics added to the active model, and since when; empty: as identified")
    ] = ""


class TwinState(StrEnum):
    """State of one aircraft's twin; the most severe applicable state."""

    UNCLAIMED = "unclaimed"
    WAITING = "waiting"
    IDENTIFYING = "identifying"
    PLAUSIBLE = "plausible"
    VERIFIED = "verified"
    PREDICTING = "predicting"
    LINK_LOST = "link_lost"


class Controller(msgspec.Struct, frozen=True, kw_only=True):
    """Control law of a prediction and its parameters, grouped by provenance.

    Names and units are the autopilot's.
    """

    law: Annotated[str, about("e.g. arduplane: L1 + TECS")]
    received: Annotated[dict[str, float], about("reported by the autopilot")] = {}
    identified: Annotated[dict[str, float], about("not reported; identified from flight data")] = {}
    default: Annotated[dict[str, float], about("neither; the autopilot's default is assumed")] = {}
    overridden: Annotated[dict[str, float], about("what-if only: set by the request")] = {}


class Event(StrEnum):
    """Event that restarted the current prediction or made it coast; `Prediction.event_text` has the details."""

    MODE = "mode"
    MISSION = "mission"
    TARGET = "target"
    PARAMETERS = "parameters"
    TAKE_OFF = "take_off"
    LANDING = "landing"
    TOUCH_DOWN = "touch_down"
    LINK_LOST = "link_lost"
    LINK_RESTORED = "link_restored"
    COASTING_EXPIRED = "coasting_expired"
    POSITION_LOST = "position_lost"
    POSITION_RESTORED = "position_restored"
    CLOCK = "clock"
    ORIGIN = "origin"


EVENT_TEXTS: dict[Event, str] = {
    Event.MODE: "flight mode changed: previous predictions are invalid",
    Event.MISSION: "mission on board changed: previous predictions are invalid",
    Event.TARGET: "guidance target changed: previous predictions are invalid",
    Event.PARAMETERS: "autopilot parameters changed: previous predictions are invalid",
    Event.TAKE_OFF: "take-off: predictions along the route start",
    Event.LANDING: "landing: predictions end at the touch-down point",
    Event.TOUCH_DOWN: "touch-down: predictions along the route end",
    Event.LINK_LOST: "link lost: the twin predicts from the last valid state",
    Event.LINK_RESTORED: "link restored: the twin predicts from telemetry again",
    Event.COASTING_EXPIRED: "confidence horizon exceeded: no prediction until telemetry returns",
    Event.POSITION_LOST: "positions stopped but other telemetry continues: the twin predicts from the last position",
    Event.POSITION_RESTORED: "positions received again: the twin predicts from telemetry again",
    Event.CLOCK: "the aircraft's clock jumped: estimates on the old time base are discarded",
    Event.ORIGIN: "the origin of the local frame was moved to the aircraft",
}
"""Text of each event."""


class BatteryForecast(msgspec.Struct, frozen=True, kw_only=True):
    """Predicted remaining share of a multirotor's battery; negative: it is empty before."""

    remaining: Annotated[float, about("as reported, 0..1")]
    power_w: Annotated[float, about("present power [W]")] = 0.0
    end: Annotated[float | None, about("at the end of the mission; null: none is flown")] = None
    end_sigma: Annotated[float | None, about("its standard deviation")] = None
    end_s: Annotated[float | None, about("time to the end of the mission [s]")] = None
    home: Annotated[float, about("on the ground at home if it returns now")] = 0.0
    home_sigma: Annotated[float, about("its standard deviation")] = 0.0
    last_item: Annotated[
        int, about("last mission item after which it reaches home with 95 %; -1: every one, or none if `home` is short")
    ] = -1
    sentence: Annotated[str, about("e.g. lands with 12 ± 3 %; cannot reach home after item 9")] = ""


METHOD_TEXTS = {
    "both": "mean of coupled and point-mass model",
    "hybrid": "point-mass model",
    "dynamics": "coupled model",
    "paper": "linear model",
    "greybox": "guidance law without a model",
    "copter": "multirotor model",
    "route_wind": "route at the commanded airspeed",
    "route_speed": "route at the present ground speed",
    "constant_turn": "present turn",
    "constant_velocity": "present velocity",
    "imm": "turn rate without a route",
}
"""Text of each `Prediction.method`."""


class AlternativePath(msgspec.Struct, frozen=True, kw_only=True):
    """Path that the aircraft may fly instead of the predicted one, at the same look-aheads."""

    probability: Annotated[float, about("of this path; the rest is that of `Prediction.path`, 0..1")]
    path: Annotated[Array, about("mean position, NED from origin, (n, 3) <f4 [m]")]
    sentence: Annotated[str, about("what the aircraft does on it, and why the probability")] = ""


class Prediction(Message, frozen=True, kw_only=True):
    """Predicted path of one aircraft, its prediction region and confidence horizon."""

    topic: ClassVar[str] = "prediction"
    version: ClassVar[int] = 2

    state: TwinState
    method: Annotated[
        str,
        about(
            "dynamics (identified coupled model and controller twin in closed loop on the mission), "
            "paper (the same with two linear axes), "
            "copter (multirotor: the route at limited speed, acceleration and jerk behind a lag, or position hold), "
            "greybox (fixed wing without a model: L1 guidance and lags on the route), "
            "route_wind (the route at the commanded airspeed in the estimated wind), "
            "route_speed (the route at the present ground speed), constant_turn, constant_velocity (from the present "
            "motion alone, where they were better on this route) or imm (no route: turn rate only)"
        ),
    ]
    law: Annotated[str, about("active controller twin, e.g. arduplane: L1 + TECS")] = ""
    origin: Annotated[tuple[int, int, int], about("NED origin: lat, lon [1e-7 deg], alt [mm AMSL]")]
    ahead: Annotated[Array, about("look-ahead from `t`, increasing, unequally spaced, (n,) <f4 [s]")]
    path: Annotated[Array, about("mean position, NED from origin, (n, 3) <f4 [m]")]
    prediction_region_half_axes: Annotated[
        Array, about("half-axes of the simultaneous region: along, cross, vertical, (n, 3) <f4 [m]")
    ]
    quantile: Annotated[float, about("nominal coverage of the prediction region, 0..1")] = 0.9
    axis_quantile: Annotated[float, about("nominal coverage of each half-axis alone; 0: as of independent axes")] = 0.0
    alternatives: Annotated[
        tuple[AlternativePath, ...],
        about("other paths, where a discrete event is in doubt; the region is the union of the boxes about all paths"),
    ] = ()
    horizon_s: Annotated[
        float,
        about(
            "confidence horizon from `t`: `quantile` of similar predictions stay within 10 %; below 0.5 s, or once the "
            "prediction is older, nothing is claimed [s]"
        ),
    ] = 0.0
    horizon_open: Annotated[bool, about("true: still below 10 % at the end of `ahead`")] = False
    early_exceedance: Annotated[float, about("probability that the error exceeds 10 % within 10 s, 0..1")] = 0.0
    coverage: Annotated[
        float, about("empirical coverage of the prediction region, 0..1; nan before any evaluation")
    ] = float("nan")
    coverage_n: Annotated[int, about("past predictions behind `coverage`")] = 0
    rollout_age_s: Annotated[
        float, about("age of the rollout propagated from the newest position; 0: a new rollout [s]")
    ] = 0.0
    coverage_propagated: Annotated[
        float | None, about("as `coverage`, propagated rollouts only, up to 60 s, 0..1; null before any")
    ] = None
    coverage_propagated_n: Annotated[int, about("past predictions behind `coverage_propagated`")] = 0
    calibration: Annotated[str, about("calibration table of region and horizon, and its adaptation")] = ""
    coast_s: Annotated[float, about("time predicted without telemetry since the last sample [s]")] = 0.0
    seq: Annotated[int, about("mission item the prediction starts on; -1 none")] = -1
    sentence: Annotated[str, about("limitation of this prediction, or empty")] = ""
    event: Annotated[Event | None, about("last event that restarted it or made it coast")] = None
    event_t: Annotated[float, about("time of that event; 0 never [s since 1970]")] = 0.0
    event_text: Annotated[str, about("text of the event, with details")] = ""
    controller: Annotated[
        Controller | None,
        about("active law and parameters; null: unchanged. Sent on change, every 10 s and to queries"),
    ] = None
    battery: Annotated[
        BatteryForecast | None, about("of a multirotor whose battery current is received; null: not known")
    ] = None

    def ned_origin(self) -> Origin:
        """Return the origin as a named tuple."""
        return Origin(*self.origin)


MIN_HORIZON_S = 0.5  # a shorter confidence horizon counts as none [s]


def claimed_horizon_s(horizon_s: float, age_s: float | None) -> float:
    """Return the confidence horizon of a prediction of this age: 0 where it has passed or is none, else unchanged [s].

    Args:
        horizon_s: `Prediction.horizon_s` or `FleetRow.horizon_s`, from the time of the prediction [s]
        age_s: of the prediction [s]; None: unknown
    """
    passed = age_s is not None and age_s >= horizon_s
    return 0.0 if passed or not horizon_s >= MIN_HORIZON_S else horizon_s


class WhatIfStart(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Start of a what-if; heading and speed are unchanged where null."""

    lat_e7: Annotated[int, about("[1e-7 deg]")]
    lon_e7: Annotated[int, about("[1e-7 deg]")]
    alt_mm: Annotated[int, about("[mm above mean sea level]")]
    heading: Annotated[float | None, about("of the nose, clockwise from north [rad]")] = None
    speed: Annotated[float | None, about("through the air; of a multirotor over ground [m/s]")] = None


class WhatIf(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Payload of a query on `parauav/{uav}/prediction`: hypothetical changes from now on. Affects no aircraft."""

    items: Annotated[
        tuple[Item, ...] | None, about("another mission, numbered as by the autopilot, at most 1,000 items")
    ] = None
    seq: Annotated[int | None, about("item to fly to first; null: the first of `items`, or the current one")] = None
    speed: Annotated[float | None, about("airspeed on the whole route, overrides the mission [m/s]")] = None
    start: WhatIfStart | None = None
    wind: Annotated[tuple[float, float] | None, about("north, east, the direction it blows to [m/s]")] = None
    params: Annotated[dict[str, float], about("parameters, in the autopilot's names and units")] = {}


class DiagnosisOutcome(StrEnum):
    """Outcome of a diagnosis."""

    NONE = "none"
    SUSPECTED = "suspected"
    NAMED = "named"
    UNKNOWN = "unknown"


class Cause(msgspec.Struct, frozen=True, kw_only=True):
    """One effect that explains the flight, named or suspected."""

    name: Annotated[str, about("effect, as listed by `fleet effects`; unknown: none of them")]
    channel: Annotated[str, about("where it acts, e.g. actuator, thrust, air, airspeed, or the name of a residual")] = (
        ""
    )
    surface: Annotated[str, about("aileron, elevator, rudder, all surfaces; empty: no surface")] = ""
    confusable_with: Annotated[tuple[str, ...], about("effects that this flight cannot distinguish from it")] = ()
    segments: Annotated[
        tuple[tuple[float, float], ...], about("active intervals; the last ends at the newest [s since 1970]")
    ] = ()
    parameters: Annotated[dict[str, float], about("estimated parameters, unit in the name")] = {}
    sigma: Annotated[dict[str, float], about("their standard deviations, same names and units")] = {}


class Mismatch(Message, frozen=True, kw_only=True):
    """Deviation of the flight from the twin, and the physics that explains it; answers queries."""

    topic: ClassVar[str] = "mismatch"
    version: ClassVar[int] = 2

    outcome: Annotated[
        DiagnosisOutcome, about("named: verified on held-out data; suspected: not; unknown: no effect explains it")
    ] = DiagnosisOutcome.NONE
    causes: Annotated[tuple[Cause, ...], about("most significant first; empty for none")] = ()
    fit_before: Annotated[
        float | None, about("rms residual on held-out data [standard deviations of nominal flight]; null: not verified")
    ] = None
    fit_after: Annotated[float | None, about("the same with the causes in the simulation [standard deviations]")] = None
    force_before: Annotated[float | None, about("rms error of specific force, held-out data [m/s2]")] = None
    force_after: Annotated[float | None, about("the same with the causes [m/s2]")] = None
    attitude_error_before: Annotated[float | None, about("rms attitude error of free runs of 5 s [deg]")] = None
    attitude_error_after: Annotated[float | None, about("the same with the causes [deg]")] = None
    flight_t0: Annotated[float, about("first instant of the diagnosed flight [s since 1970]")] = 0.0
    adapted: Annotated[bool, about("true: the prediction model includes the causes")] = False
    sentence: Annotated[str, about("summary, and which model predicts")] = ""

    @property
    def onset(self) -> float | None:
        """Return the onset of the first cause [s since 1970]; None without a cause."""
        return self.causes[0].segments[0][0] if self.causes and self.causes[0].segments else None


class AlertKind(StrEnum):
    """Type of an alert."""

    LINK_LOST = "link_lost"
    SHORT_HORIZON = "short_horizon"
    CONFLICT = "conflict"
    GEOFENCE = "geofence"
    GROUND = "ground"
    NOT_ACHIEVABLE = "not_achievable"
    BATTERY = "battery"
    SECOND_SENDER = "second_sender"


AlertKey = tuple[AlertKind, int]
"""Identity of an alert within one UAV: its kind, and the other UAV of a conflict (-1 none)."""


class Alert(Message, frozen=True, kw_only=True):
    """Warning for the operator, published when raised and, with `active` false, when cleared."""

    topic: ClassVar[str] = "alert"
    version: ClassVar[int] = 2

    kind: AlertKind
    active: bool = True
    sentence: str = ""
    other: Annotated[int, about("the other UAV of a conflict, always the higher id; -1 none")] = -1
    probability: Annotated[float | None, about("probability of the event, 0..1; null: it is present now")] = None
    predicted_t: Annotated[float | None, about("predicted time [s since 1970]; null: now")] = None
    lat: Annotated[int | None, about("latitude of the event [1e-7 deg]; null: no single position")] = None
    lon: Annotated[int | None, about("longitude of the event [1e-7 deg]")] = None
    alt: Annotated[int | None, about("height of the event above mean sea level [mm]")] = None

    @property
    def about(self) -> AlertKey:
        """Return the identity of the alert within its UAV."""
        return self.kind, self.other


class Change(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Change of one aircraft's plan that a proposal suggests; unchanged where null or empty."""

    uav: int
    speed: Annotated[float | None, about("airspeed from now on (DO_CHANGE_SPEED) [m/s]")] = None
    items: Annotated[tuple[Item, ...] | None, about("mission to upload, numbered as by the autopilot")] = None
    seq: Annotated[int | None, about("mission item to fly to first")] = None
    mode: Annotated[str, about("hold, return or land; empty: unchanged")] = ""


class ProposedPath(msgspec.Struct, frozen=True, kw_only=True):
    """Predicted path of one aircraft after the changes of an option, as in `Prediction`."""

    uav: int
    origin: Annotated[tuple[int, int, int], about("NED origin: lat, lon [1e-7 deg], alt [mm AMSL]")]
    ahead: Annotated[Array, about("look-ahead from the proposal's `t`, (n,) <f4 [s]")]
    path: Annotated[Array, about("mean position, NED from origin, (n, 3) <f4 [m]")]
    prediction_region_half_axes: Annotated[Array, about("along, cross, vertical, (n, 3) <f4 [m]")]


class Option(msgspec.Struct, frozen=True, kw_only=True):
    """One way to avoid the event of a proposal, with what the experiments predict for it."""

    sentence: Annotated[str, about("what changes, and why this option is offered")]
    changes: tuple[Change, ...]
    paths: tuple[ProposedPath, ...]
    probability: Annotated[float, about("remaining probability of the event, 0..1")]
    clearance_m: Annotated[float, about("predicted smallest distance to what is avoided [m]")]
    delay_s: Annotated[float, about("later arrival at the end of the route, sum over aircraft [s]")] = 0.0
    energy: Annotated[float, about("energy relative to the present plan [-]")] = 1.0
    deviation_m: Annotated[float, about("largest distance from the present plan [m]")] = 0.0


class Proposal(Message, frozen=True, kw_only=True):
    """At most three changes of plan that avoid one predicted event; withdrawn with no options."""

    topic: ClassVar[str] = "proposal"

    id: Annotated[str, about("unique identifier, which an approval repeats")]
    kind: Annotated[AlertKind | None, about("the alert that it answers; null: requested by a person")] = None
    other: Annotated[int, about("the other UAV of a conflict; -1 none")] = -1
    probability: Annotated[
        float | None, about("of the event with the present plans, 0..1; null: none is predicted")
    ] = None
    options: tuple[Option, ...] = ()
    present: Annotated[
        tuple[ProposedPath, ...],
        about("predicted paths of the aircraft that an option changes, with their present plans"),
    ] = ()
    valid_until: Annotated[float, about("fleet time after which it must not be approved [s since 1970]")] = 0.0
    sentence: Annotated[str, about("the event, and what the options avoid; or why there is none")] = ""

    @property
    def about(self) -> tuple[AlertKind | None, int]:
        """Return the identity of the event within its UAV; a newer proposal on it replaces the older one."""
        return self.kind, self.other


class Approval(Message, frozen=True, kw_only=True):
    """Approval of one option of a proposal by a person, or of the undo of its execution.

    It is published under the aircraft of the proposal. The router lets the role `operator` alone publish it.
    """

    topic: ClassVar[str] = "approval"

    proposal: Annotated[str, about("id of the proposal")]
    option: Annotated[int, about("index of the option, from 0")] = 0
    digest: Annotated[str, about("SHA-256 of the msgpack of the option's `changes`, 64 hex digits: what was shown")]
    who: Annotated[str, about("the person who approves")]
    undo: Annotated[bool, about("true: restore mission, item, speed and mode from before the execution")] = False


class ExecutionState(StrEnum):
    """State of an execution.

    APPROVED: every check passed, nothing sent yet.
    SENDING: commands are sent and acknowledged one after the other.
    ACCEPTED: every step is acknowledged; the flight is compared with the predicted path.
    REFUSED: a check failed; nothing was sent.
    FAILED: a step was not acknowledged; later steps were not sent.
    DONE: the predicted path has ended.
    UNDONE: the plan from before the execution is restored.
    """

    APPROVED = "approved"
    SENDING = "sending"
    ACCEPTED = "accepted"
    REFUSED = "refused"
    FAILED = "failed"
    DONE = "done"
    UNDONE = "undone"


class ExecutionStep(msgspec.Struct, frozen=True, kw_only=True):
    """One step of an execution."""

    uav: int
    sentence: Annotated[str, about("what is sent, or what was acknowledged")]
    accepted: Annotated[bool | None, about("acknowledged and verified; null: not yet")] = None
    t: Annotated[float | None, about("time of the result [s since 1970]")] = None


class Execution(Message, frozen=True, kw_only=True):
    """Execution of an approved proposal, published on every change."""

    topic: ClassVar[str] = "execution"

    proposal: Annotated[str, about("id of the proposal")]
    option: int = 0
    state: ExecutionState
    who: Annotated[str, about("the person who approved it")] = ""
    digest: Annotated[str, about("that of the approval; an undo repeats it")] = ""
    approved_t: Annotated[float, about("`t` of the approval [s since 1970]")] = 0.0
    undo: Annotated[bool, about("true: this approval asked for the undo")] = False
    steps: tuple[ExecutionStep, ...] = ()
    follows: Annotated[bool | None, about("the flight is within the predicted region; null: not compared")] = None
    can_undo: Annotated[bool, about("an undo can be approved")] = False
    dry_run: Annotated[bool, about("true: the messages were printed, not sent")] = False
    sentence: Annotated[str, about("why it was refused or failed, or how the flight follows the predicted path")] = ""


class WindEstimate(msgspec.Struct, frozen=True, kw_only=True):
    """Wind, gusts included, that a twin estimates where its aircraft is."""

    t: Annotated[float, about("fleet time [s since 1970]")]
    position: Annotated[tuple[int, int, int], about("lat, lon [1e-7 deg], altitude above sea level [mm]")]
    height_m: Annotated[float, about("above home [m]")]
    wind: Annotated[tuple[float, float], about("north and east, the direction it blows to [m/s]")]
    sigma: Annotated[float, about("standard deviation of one component [m/s]")]


class FleetRow(msgspec.Struct, frozen=True, kw_only=True):
    """One row of the fleet table."""

    uav: int
    state: TwinState
    verdict: Annotated[str, about("sentence of the last verdict")]
    fit: Annotated[dict[str, float], about("per state [%]")] = {}
    horizon_s: Annotated[float, about("confidence horizon of the newest prediction, from its time [s]")] = 0.0
    worker: Annotated[str, about("writer of the accepted results, 16 hex digits")] = ""
    sample_age_s: Annotated[float | None, about("since the newest sample arrived [s]")] = None
    prediction_age_s: Annotated[float | None, about("since the newest prediction [s]")] = None
    t10_s: Annotated[
        float | None, about("median time that past predictions stay within 10 % (M1) [s]; null before any")
    ] = None
    t10_censored: Annotated[float | None, about("share of them still within 10 % at their end, 0..1")] = None
    t10_n: Annotated[int, about("past predictions behind `t10_s`")] = 0
    epoch: Annotated[int, about("claim epoch of the writer")] = 0
    alerts: Annotated[tuple[str, ...], about("texts of the active alerts")] = ()
    mismatch: Annotated[str, about("outcome and causes, e.g. named thrust_loss; empty: none")] = ""
    wind: Annotated[WindEstimate | None, about("by its own filter [m/s]; null without airspeed")] = None
    battery: Annotated[str, about("remaining battery at the end of the mission and at home; empty: not known")] = ""


class FleetState(msgspec.Struct, frozen=True, kw_only=True):
    """The rows of one worker."""

    topic: ClassVar[str] = "@fleet/state"
    version: ClassVar[int] = 2

    t: Annotated[float, about("fleet time of the rows [s since 1970]")]
    rows: tuple[FleetRow, ...] = ()
    sentence: Annotated[str, about("e.g. compiling the twin's physics, once")] = ""
    tasks: Annotated[dict[str, int], about("tasks completed since start: predict, identify, ensemble")] = {}
    dropped_messages: Annotated[int, about("messages of its current aircraft dropped because a queue was full")] = 0


class WindField(msgspec.Struct, frozen=True, kw_only=True):
    """Wind in space and time, estimated from all aircraft by one worker at a time.

    w = g(h) profile + f + drift, with g(h) = [(h / 100 m)^(1/7), (h - 100 m) / 100 m] at the height h above ground.
    f drifts with `wind`: its covariance is sigma^2 exp(-d / length_m) exp(-lag / persistence_s), with d the distance
    of the positions moved back with the wind, vertical distances twice. drift is of one aircraft.
    """

    topic: ClassVar[str] = "@world/wind"
    version: ClassVar[int] = 1

    t: Annotated[float, about("time of the estimate [s since 1970]")]
    origin: Annotated[tuple[int, int, int], about("of `nodes` [1e-7 deg, 1e-7 deg, mm], at the ground")]
    uavs: Annotated[tuple[int, ...], about("aircraft whose estimates it contains")]
    wind: Annotated[tuple[float, float], about("mean at 100 m, north and east, where it blows to [m/s]")]
    wind_sigma: Annotated[float, about("standard deviation of its components [m/s]")]
    sigma: Annotated[float, about("standard deviation of f [m/s]")]
    length_m: Annotated[float, about("correlation length of f [m]")]
    persistence_s: Annotated[float, about("lifetime of f [s]")]
    drift_sigma: Annotated[float, about("standard deviation of the drift of one aircraft [m/s]")]
    drift_s: Annotated[float, about("correlation time of that drift [s]")]
    profile: Annotated[Array, about("factors of g for north and east, (2, 2) [m/s]")]
    nodes: Annotated[Array, about("positions of the nodes of f at t, NED, (b, 3) [m]")]
    values: Annotated[Array, about("f there, north and east, (b, 2) [m/s]")]
    covariance: Annotated[Array, about("of factors and f, one component, (b + 2, b + 2) [m2/s2]")]
    drifts: Annotated[Array, about("of each aircraft, north, east, variance, (n, 3) [m/s, m2/s2]")]


class SiblingDifference(msgspec.Struct, frozen=True, kw_only=True):
    """One aircraft deviates from all others of its type by more than chance."""

    uav: int
    group: Annotated[str, about("drag, lift, pitch, roll or yaw")]
    ratio: Annotated[float, about("relative deviation of the first term of the group [-]")]
    p: Annotated[float, about("probability of such a deviation by chance, 0..1")]
    sentence: str


class SiblingType(msgspec.Struct, frozen=True, kw_only=True):
    """Distribution of the derivatives of one type of aircraft without offsets; last: thrust minus drag."""

    airframe_type: str
    uavs: Annotated[tuple[int, ...], about("aircraft it was learnt from")]
    airspeed: Annotated[float, about("of the derivatives [m/s]")]
    throttle: Annotated[float, about("delta_t of the last term [-]")]
    mean: Annotated[Array, about("(k,) <f8")]
    covariance: Annotated[Array, about("of a further aircraft: spread, and uncertainty of the mean, (k, k) <f8")]
    differences: tuple[SiblingDifference, ...] = ()


class Siblings(msgspec.Struct, frozen=True, kw_only=True):
    """What aircraft of each type share, estimated by one worker at a time."""

    topic: ClassVar[str] = "@world/siblings"
    version: ClassVar[int] = 1

    t: Annotated[float, about("time of the estimate [s since 1970]")]
    types: tuple[SiblingType, ...] = ()


class Predictions(msgspec.Struct, frozen=True, kw_only=True):
    """The newest prediction of every aircraft of one worker, in one answer."""

    topic: ClassVar[str] = "@fleet/prediction"
    version: ClassVar[int] = 2

    t: Annotated[float, about("fleet time of the answer [s since 1970]")]
    predictions: Annotated[tuple[msgspec.Raw, ...], about("each a packed Prediction")] = ()
    epochs: Annotated[tuple[int, ...], about("claim epoch of each; readers accept the highest per aircraft")] = ()


MAX_UAV_ID = 999_999_999


class Samples(msgspec.Struct, frozen=True, kw_only=True, gc=False):
    """Samples of many aircraft in one message; each is also published under its own key.

    A subscriber to all aircraft receives one message for many of them. Workers, the viewer and `fleet record` receive
    samples in this form alone: a program that publishes samples must publish both.
    """

    topic: ClassVar[str] = "@fleet/sample"
    version: ClassVar[int] = 1

    t: Annotated[float, about("fleet time of the newest sample [s since 1970]")]
    uavs: Annotated[tuple[Annotated[int, Meta(ge=0, le=MAX_UAV_ID)], ...], about("UAV id of each sample")] = ()
    samples: Annotated[tuple[bytes, ...], about("each a packed Sample")] = ()


class LinkCounters(msgspec.Struct, frozen=True, kw_only=True):
    """Counters of one link since the gateway started; values in Hz and bytes/s are current rates."""

    link: Annotated[str, about("the link as configured")]
    datagrams: int = 0
    bytes_in: int = 0
    messages: int = 0
    bad_bytes: Annotated[int, about("bytes that were no MAVLink frame")] = 0
    bad_frames: Annotated[int, about("frames with a wrong checksum or an unknown message id")] = 0
    dropped: Annotated[int, about("datagrams received and dropped because decoding fell behind")] = 0
    overrun: Annotated[int | None, about("datagrams dropped by the operating system; null: not reported")] = None
    sent: Annotated[int, about("datagrams sent by the gateway itself")] = 0
    bytes_out: int = 0
    unsent: Annotated[int, about("messages not sent or forwarded: no peer, or the queue was full")] = 0
    bytes_s: Annotated[float, about("current receive rate [bytes/s]")] = 0.0
    messages_hz: Annotated[float, about("current receive rate [Hz]")] = 0.0
    recorded: Annotated[int, about("bytes of frames written to the .tlog, without timestamps")] = 0
    noise: Annotated[int, about("bytes not recorded because they belong to no frame")] = 0
    unrecorded: Annotated[int, about("bytes lost because the disk was full or too slow")] = 0
    unwritten: Annotated[int, about("bytes waiting for the disk or for the rest of their frame")] = 0
    rate_fraction: Annotated[float, about("requested fraction of the desired message rates, by budget, 0..1")] = 1.0
    sentence: Annotated[str, about("note for the operator, or empty")] = ""


class GatewayCounters(msgspec.Struct, frozen=True, kw_only=True):
    """Counters of one gateway."""

    topic: ClassVar[str] = "@gateway"
    version: ClassVar[int] = 2

    t: Annotated[float, about("fleet time of the count [s since 1970]")]
    links: tuple[str, ...] = ()
    uavs: tuple[int, ...] = ()
    datagrams: int = 0
    bytes_in: int = 0
    messages: int = 0
    bad_bytes: Annotated[int, about("bytes that were no MAVLink frame")] = 0
    bad_frames: Annotated[int, about("frames with a wrong checksum or an unknown message id")] = 0
    refused: Annotated[dict[str, int], about("valid frames rejected, by reason")] = {}
    published: Annotated[int, about("messages published while a router was connected")] = 0
    sentence: str = ""
    per_link: tuple[LinkCounters, ...] = ()
    router: Annotated[bool, about("a router is connected")] = True
    unsent: Annotated[int, about("messages not published because no router was connected")] = 0
    unconfirmed: Annotated[int, about("published in the second before the loss of a router was detected")] = 0
    removed: Annotated[int, about("recordings removed to stay within the budget")] = 0
    history_bytes: Annotated[int, about("size of the history stored for late joiners")] = 0
    wall_t: Annotated[float, about("send time by the gateway's own clock [s since 1970]")] = 0.0
    machine: Annotated[str, about("name of the machine it runs on")] = ""
    code: Annotated[str, about("hash of the sources it runs")] = ""


class Claim(msgspec.Struct, frozen=True, kw_only=True):
    """Aircraft that one worker writes for.

    Of two claims on one aircraft the higher epoch wins, then the higher writer. A claim more than 5 minutes ahead of
    the reader's own clock is rejected.
    """

    topic: ClassVar[str] = "@claim"
    version: ClassVar[int] = 2

    t: Annotated[float, about("send time by the worker's clock [s since 1970]")]
    worker: Annotated[str, about("writer, 16 hex digits")]
    owned: Annotated[tuple[tuple[int, int], ...], about("UAV id and epoch of each owned aircraft")] = ()
    without_history: Annotated[tuple[int, ...], about("owned aircraft whose earlier telemetry is still missing")] = ()
    leaving: Annotated[bool, about("true: it hands over all aircraft and stops")] = False
    machine: Annotated[str, about("name of the machine it runs on")] = ""
    code: Annotated[str, about("hash of the sources it runs")] = ""
    highest_claims: Annotated[
        tuple[tuple[int, int, str], ...],
        about("in query replies only: UAV id, epoch and writer of the highest known claim"),
    ] = ()


class Handover(msgspec.Struct, frozen=True, kw_only=True):
    """Copy of a twin for its new owner; the old owner writes until the new one does."""

    topic: ClassVar[str] = "@handover"
    version: ClassVar[int] = 2

    t: Annotated[float, about("time of the copy by the worker's clock [s since 1970]")]
    uav: Annotated[int, about("UAV id")]
    epoch: Annotated[int, about("epoch of the old owner; the new owner's is higher")]
    code: Annotated[str, about("hash of the sources that wrote `snapshot`; other versions must not read it")]
    snapshot: Annotated[bytes, about("twin, unprocessed messages, open conflicts, mismatch")] = b""


class HandoverRequest(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Payload of a query on `parauav/@handover/{writer}`: ids of the requested aircraft."""

    uavs: Annotated[tuple[int, ...], about("UAV ids")] = ()


PER_UAV: tuple[type[Message], ...] = (
    *(Sample, Status, Mission, Params, History),
    *(Model, Prediction, Mismatch, Alert, Proposal, Approval, Execution),
)
CONTROL: tuple[type, ...] = (FleetState, Samples, Predictions, WindField, Siblings, GatewayCounters, Claim, Handover)
QUERIES: dict[type, type] = {Prediction: WhatIf, Handover: HandoverRequest}  # optional payload of a query on a key
TOPICS: dict[str, type] = {c.topic: c for c in (*PER_UAV, *CONTROL)}  # type: ignore[attr-defined]


def meaning(hint: Any) -> str:
    """Return the description, with its unit, of an annotation."""
    metas = [m for m in getattr(hint, "__metadata__", ()) if isinstance(m, msgspec.Meta)]
    return " ".join(m.description for m in metas if m.description)
