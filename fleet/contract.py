"""THE TABLE: one frozen struct per message on the bus. This file is the public interface of ParaUAV.

    key                                  class        from     what
    parauav/{uav}/sample                 Sample       gateway  telemetry rows on the fleet clock, about every 100 ms
    parauav/{uav}/status                 Status       gateway  link, mode, rates, losses (1 Hz and on change)
    parauav/{uav}/mission                Mission      gateway  the route on board and the item in force
    parauav/{uav}/params                 Params       gateway  autopilot parameters
    parauav/{uav}/history                History      gateway  only answers: the last minutes of one aircraft
    parauav/{uav}/model                  Model        worker   identified model with its verdict
    parauav/{uav}/prediction             Prediction   worker   mean path, tube, horizon; also answers queries
    parauav/{uav}/mismatch               Mismatch     worker   where, what physics, fit before and after; queries too
    parauav/{uav}/alert                  Alert        worker   predicted conflict, fence, ground, …; answers queries
                                                      gateway  a second sender that uses this id; answers queries
    parauav/@fleet/state/{writer}        FleetState   worker   one row per UAV; answers queries
    parauav/@fleet/prediction/{writer}   Predictions  worker   only answers: the newest of all it holds
    parauav/@gateway/{writer}            Account      gateway  counters of one gateway; answers queries
    parauav/@claim/{writer}              Claim        worker   which aircraft it writes for; every 0.25 s; queries too
    parauav/@handover/{writer}           Handover     worker   answers a `Wanted` of another worker: twins to go on with
    parauav/@live/worker/{writer}/{lo-hi}/{incarnation}        a liveliness token: this worker lives, and may hold these

`*` and `**` never match a chunk that starts with `@`, so `parauav/*/prediction` is aircraft only.

Wire: a msgpack map; any msgpack library reads it. Arrays are maps `{dtype, shape, data}`. The Zenoh encoding
carries the version: `application/msgpack;parauav.prediction.1`. Fields may be added (with a default); a reader
refuses another major version. Worker results carry an attachment of 16 bytes, little endian: epoch u64, writer u64.
An epoch is the time of the claim [ms since 1970], or one above the last: readers refuse one over 5 minutes ahead of
their own clock, and keep the highest of the others per UAV.

Time `t` is seconds since 1970 on the fleet clock. Angles in rad, SI throughout, NED and FRD frames.
"""

from enum import StrEnum
from math import prod
from typing import Annotated, Any, ClassVar

import msgspec
import numpy as np
from msgspec import Meta

from fleet.frames import Origin

DTYPES = ("<f4", "<f8", "<i4", "<i8", "|u1")
_SIZES = {name: np.dtype(name).itemsize for name in DTYPES}
MAX_ITEMS = 1_000  # mission items accepted from outside


class Array(msgspec.Struct, frozen=True, gc=False):  # no cycle goes through numbers
    """A numpy array on the wire: `numpy.frombuffer(data, dtype).reshape(shape)`."""

    dtype: Annotated[str, Meta(description="numpy dtype string, little endian: " + " ".join(DTYPES))]
    shape: tuple[int, ...]
    data: bytes

    @classmethod
    def of(cls, values: Any, dtype: str = "<f4") -> "Array":
        """Wrap anything array-like as `dtype`."""
        a = np.ascontiguousarray(values, dtype=dtype)
        return cls(dtype, a.shape, a.tobytes())

    def numpy(self) -> np.ndarray:
        """Unwrap; read-only.

        Raises:
            ValueError: when dtype, shape and byte count disagree; the sender must repair it.
        """
        size, shape = _SIZES.get(self.dtype), self.shape
        if size is None or len(shape) > 4 or (shape and not 0 <= min(shape) <= max(shape) < 2**31):
            raise ValueError(f"array: found dtype {self.dtype!r} shape {self.shape}, expected one of {DTYPES}; resend")
        want = prod(shape) * size
        if want != len(self.data):
            raise ValueError(f"array: found {len(self.data)} bytes, shape {self.shape} needs {want}; resend")
        return np.frombuffer(self.data, self.dtype).reshape(self.shape)


class Rows(msgspec.Struct, frozen=True, gc=False):
    """Measurements of one kind, each row with its own time."""

    t: Annotated[Array, Meta(description="fleet time of each row, (n,) <f8 [s since 1970]")]
    x: Annotated[Array, Meta(description="values, (n, k); columns as in COLUMNS")]


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
        ("alt_error", "m, wanted minus flown"),
        ("Va_error", "m/s, wanted minus flown"),
    ),
    "leg": (("seq", "mission item in force"),),
    "wind": (("w_n", "m/s"), ("w_e", "m/s")),
    "target": (("lat", "1e-7 deg"), ("lon", "1e-7 deg"), ("alt", "mm above mean sea level")),
    "pressure": (("static", "Pa"),),
    "gnss": (("alt", "mm above mean sea level, as the receiver says"),),
    "height": (("above_home", "m"),),
}
"""Columns of each `Rows` field of a `Sample`: name and unit, in wire order. Specific force and rates are FRD."""
UNTOLD = {"command": 2}
"""Fields whose columns from this one on are nan where the autopilot does not tell them."""


class Message(msgspec.Struct, frozen=True, kw_only=True):
    """What every message has: the aircraft and the time."""

    topic: ClassVar[str] = ""
    version: ClassVar[int] = 1

    uav: Annotated[int, Meta(description="UAV id: MAVLink system id + the link's offset")]
    t: Annotated[float, Meta(description="fleet time of the newest content [s since 1970]")]


class Sample(Message, frozen=True, kw_only=True, gc=False):
    """Telemetry rows of one aircraft since the message before; a kind without news is absent."""

    topic: ClassVar[str] = "sample"

    attitude: Rows | None = None
    imu: Rows | None = None
    position: Rows | None = None
    velocity: Rows | None = None
    air: Rows | None = None
    servo: Rows | None = None
    command: Rows | None = None
    leg: Rows | None = None
    wind: Annotated[Rows | None, Meta(description="as the autopilot says, where it blows to [m/s]")] = None
    target: Annotated[Rows | None, Meta(description="the point the autopilot says it steers for")] = None
    pressure: Annotated[Rows | None, Meta(description="as the barometer says, no estimator in between [Pa]")] = None
    gnss: Annotated[Rows | None, Meta(description="as the satellite receiver says, no estimator in between")] = None
    height: Annotated[Rows | None, Meta(description="above home, as the autopilot says [m]")] = None


class Link(StrEnum):
    """State of the radio link to one aircraft."""

    LIVE = "live"
    LOST = "lost"


class Status(Message, frozen=True, kw_only=True):
    """How the link and the aircraft are."""

    topic: ClassVar[str] = "status"

    link: Link = Link.LIVE
    mode: Annotated[str, Meta(description="flight mode as the autopilot names it, e.g. AUTO")] = ""
    armed: bool = False
    autopilot: Annotated[str, Meta(description="ardupilot, px4 or generic")] = "generic"
    vehicle: Annotated[str, Meta(description="fixed_wing, quadplane, multirotor, helicopter or unknown")] = "unknown"
    rates_hz: Annotated[dict[str, float], Meta(description="received rate of each message [Hz]")] = {}
    received: Annotated[int, Meta(description="messages received")] = 0
    missed: Annotated[int, Meta(description="messages missed, from gaps in the sequence number")] = 0
    rejected: Annotated[int, Meta(description="messages or fields refused (not finite, out of range, stale)")] = 0
    clock_offset_s: Annotated[float, Meta(description="fleet time minus the aircraft's boot time [s]")] = 0.0
    clock_jumps: Annotated[int, Meta(description="times the aircraft's clock jumped")] = 0
    clock_advance_s: Annotated[
        float,
        Meta(description="sum of the steps by which telemetry that fell behind its arrival was dated anew, later [s]"),
    ] = 0.0
    clock_drift: Annotated[
        float | None, Meta(description="what the aircraft's clock loses on the fleet clock [s/s]; null: not known yet")
    ] = None
    latency_s: Annotated[
        float, Meta(description="how much later than the quickest of the last half minute messages come, mean [s]")
    ] = 0.0
    latency_worst_s: Annotated[float, Meta(description="the same, the latest since the status before [s]")] = 0.0
    round_trip_s: Annotated[
        float | None, Meta(description="to the aircraft and back, the quickest lately (TIMESYNC) [s]; null: no answer")
    ] = None
    gps_offset_s: Annotated[
        float | None,
        Meta(description="fleet time minus satellite time of the same instant (SYSTEM_TIME) [s]; null: not told"),
    ] = None
    sentence: Annotated[str, Meta(description="what an operator should know, or empty")] = ""


class Item(msgspec.Struct, frozen=True, kw_only=True):
    """One mission item as MAVLink knows it (MISSION_ITEM_INT)."""

    seq: int
    command: Annotated[int, Meta(description="MAV_CMD")]
    frame: Annotated[int, Meta(description="MAV_FRAME")] = 3
    param1: float = 0.0
    param2: float = 0.0
    param3: float = 0.0
    param4: float = 0.0
    lat_e7: Annotated[int, Meta(description="[1e-7 deg]")] = 0
    lon_e7: Annotated[int, Meta(description="[1e-7 deg]")] = 0
    alt_m: Annotated[float, Meta(description="altitude in the item's frame [m]")] = 0.0


class Mission(Message, frozen=True, kw_only=True):
    """The route on board; item 0 of an ArduPilot mission is home."""

    topic: ClassVar[str] = "mission"

    items: tuple[Item, ...] = ()
    seq: Annotated[int, Meta(description="item in force when this was sent; -1 unknown")] = -1
    complete: Annotated[bool, Meta(description="every item arrived")] = False
    sentence: Annotated[str, Meta(description="what is wrong with it, or empty")] = ""


class Params(Message, frozen=True, kw_only=True):
    """Autopilot parameters, named and scaled as the autopilot does; never non-finite."""

    topic: ClassVar[str] = "params"

    values: dict[str, float] = {}
    complete: bool = False
    sentence: str = ""


class History(Message, frozen=True, kw_only=True):
    """What one aircraft said lately, oldest first; `?seconds=20` asks for less of it."""

    topic: ClassVar[str] = "history"

    since: Annotated[float, Meta(description="fleet time from which on nothing is left out [s since 1970]")] = 0.0
    samples: tuple[Sample, ...] = ()
    statuses: tuple[Status, ...] = ()


class Outcome(StrEnum):
    """Verdict on an identification; not an error, an answer."""

    VERIFIED = "verified"
    STARVED = "starved"
    NOT_IDENTIFIABLE = "not_identifiable"
    BELOW_THRESHOLD = "below_threshold"
    WORSE_THAN_LAST = "worse_than_last"
    DRIFTING = "drifting"
    DIVERGED = "diverged"


class Verdict(msgspec.Struct, frozen=True, kw_only=True):
    """Whether a model deserves belief, out of sample."""

    outcome: Outcome
    sentence: str
    fit: Annotated[dict[str, float], Meta(description="100 (1 - nrmse) per state at `horizon_s` [%]")] = {}
    fit_hold: Annotated[dict[str, float], Meta(description="the same for holding the last value [%]")] = {}
    fit_at: Annotated[
        dict[str, float], Meta(description="mean fit of both axes by free-run length in s, e.g. lon16, lat16 [%]")
    ] = {}
    whiteness: Annotated[
        dict[str, float], Meta(description="share of one-step residual autocorrelations that are noise's, 0..1")
    ] = {}
    horizon_s: Annotated[float, Meta(description="free-run length the fit is over [s]")] = 0.0
    threshold: Annotated[float, Meta(description="omega: least mean fit [%]")] = 0.0
    tries: Annotated[int, Meta(description="identifications tried for this verdict")] = 0


class Linear(msgspec.Struct, frozen=True, kw_only=True):
    """Discrete linear model about a trim point: x' = A x + B u + c, y = x (C = I, D = 0).

    Source: Huang 2021 eq. 2-4.
    """

    states: Annotated[tuple[str, ...], Meta(description="state names: u w q theta | phi psi p r v")]
    inputs: Annotated[tuple[str, ...], Meta(description="input names: delta_e delta_t | delta_a delta_r")]
    A: Array
    B: Array
    C: Array
    D: Array
    x_trim: Annotated[Array, Meta(description="state at trim, u v w through the air, (n,) [m/s, rad, rad/s]")]
    u_trim: Annotated[Array, Meta(description="input at trim, (m,) [-]")]
    dt_s: Annotated[float, Meta(description="sample time [s]")]


class Derivatives(msgspec.Struct, frozen=True, kw_only=True):
    """Coupled model: specific force [m/s2], angular acceleration [rad/s2] per unit of each term, and wind.

    Terms and letters: `fleet.physics.wrench`.
    """

    names: Annotated[tuple[str, ...], Meta(description="X_0 X_u ... N_0 w_n w_e")]
    value: Annotated[Array, Meta(description="(n,) <f8")]
    covariance: Annotated[Array, Meta(description="(n, n) <f4")]
    told: Annotated[Array, Meta(description="share of each prior variance that the data removed, (n,) 0..1")]
    U0: Annotated[float, Meta(description="airspeed the derivatives belong to [m/s]")]
    W0: Annotated[float, Meta(description="velocity down the body at trim [m/s]")]
    tau_s: Annotated[Array, Meta(description="lags of delta_a delta_e delta_r delta_t, (4,) [s]")]
    prior: Annotated[str, Meta(description="airframe that holds what the data do not tell")] = ""
    window_t0: Annotated[float, Meta(description="first instant of the stretch it came from [s since 1970]")] = 0.0
    window_s: Annotated[float, Meta(description="length of that stretch [s]")] = 0.0
    sentence: Annotated[str, Meta(description="what the data identified and what the prior held")] = ""


class Model(Message, frozen=True, kw_only=True):
    """The model in force (none before the first verified one), the newest window and its verdict."""

    topic: ClassVar[str] = "model"

    method: Annotated[str, Meta(description="dynamics (coupled derivatives) or paper (two linear axes)")]
    verdict: Annotated[Verdict, Meta(description="of the newest identification")]
    in_force: Annotated[Verdict | None, Meta(description="of the model below; null before any was verified")] = None
    longitudinal: Linear | None = None
    lateral: Linear | None = None
    derivatives: Annotated[Derivatives | None, Meta(description="of the coupled model; null for method paper")] = None
    earned: Annotated[
        dict[str, float],
        Meta(description="share of a 10 s free run's departure from the mean that unseen flight bore out, 0..1"),
    ] = {}
    window_t0: Annotated[float, Meta(description="first instant of the identification window [s since 1970]")] = 0.0
    window_s: Annotated[float, Meta(description="length of the identification window [s]")] = 0.0
    interpolated: Annotated[float, Meta(description="share of the window that was interpolated, 0..1")] = 0.0
    wind_n: Annotated[float, Meta(description="estimated wind, north, the direction it blows to [m/s]")] = 0.0
    wind_e: Annotated[float, Meta(description="estimated wind, east [m/s]")] = 0.0
    extended: Annotated[
        str, Meta(description="missing physics put into the model in force, since when; empty: as identified")
    ] = ""


class State(StrEnum):
    """Where one aircraft's twin stands; the worst news wins."""

    UNCLAIMED = "unclaimed"
    WAITING = "waiting"
    IDENTIFYING = "identifying"
    VERIFIED = "verified"
    PREDICTING = "predicting"
    LINK_LOST = "link_lost"


class Controller(msgspec.Struct, frozen=True, kw_only=True):
    """The law a prediction is flown by and the parameters that matter to it, apart by how each is known.

    Names and units are the autopilot's.
    """

    law: Annotated[str, Meta(description="e.g. arduplane: L1 + TECS")]
    received: Annotated[dict[str, float], Meta(description="told by the autopilot")] = {}
    identified: Annotated[dict[str, float], Meta(description="not told; learnt from flight")] = {}
    default: Annotated[dict[str, float], Meta(description="not told, not learnt; the autopilot's default assumed")] = {}
    asked: Annotated[dict[str, float], Meta(description="what-if only: as the question has it")] = {}


class Event(StrEnum):
    """What began the present prediction anew, or what it coasts through; `Prediction.event_said` has the details."""

    MODE = "mode"
    MISSION = "mission"
    PARAMETERS = "parameters"
    TAKE_OFF = "take_off"
    LANDING = "landing"
    TOUCH_DOWN = "touch_down"
    LINK_LOST = "link_lost"
    LINK_BACK = "link_back"
    HORIZON_OVER = "horizon_over"
    TELEMETRY_BROKEN = "telemetry_broken"
    TELEMETRY_WHOLE = "telemetry_whole"
    CLOCK = "clock"
    ORIGIN = "origin"


SENTENCES: dict[Event, str] = {
    Event.MODE: "another flight mode: what was predicted before is void",
    Event.MISSION: "another mission on board: what was predicted before is void",
    Event.PARAMETERS: "the autopilot flies with other parameters: what was predicted before is void",
    Event.TAKE_OFF: "it has taken off: predictions on the route begin",
    Event.LANDING: "it is landing: what is predicted ends at the touch-down point",
    Event.TOUCH_DOWN: "it is on the ground: predictions on the route end",
    Event.LINK_LOST: "the link is lost: the twin flies on from the last good state",
    Event.LINK_BACK: "the link is back: the twin flies from telemetry again",
    Event.HORIZON_OVER: "the confidence horizon is over: nothing more is claimed until telemetry returns",
    Event.TELEMETRY_BROKEN: "positions have stopped while other telemetry comes: the twin flies on from the last one",
    Event.TELEMETRY_WHOLE: "positions come again: the twin flies from telemetry again",
    Event.CLOCK: "the aircraft's clock has jumped: what was learnt on the old time is forgotten",
    Event.ORIGIN: "the origin of the local frame has moved to the aircraft",
}
"""One sentence for each event."""


class Prediction(Message, frozen=True, kw_only=True):
    """Where one aircraft will be, and how far to trust that."""

    topic: ClassVar[str] = "prediction"

    state: State
    method: Annotated[
        str,
        Meta(
            description="dynamics (identified coupled model and controller twin in closed loop on the mission), "
            "paper (the same with two linear axes), "
            "copter (on rotors: the route at limited speed, acceleration and jerk behind a lag, or holding its place), "
            "greybox (fixed wing without a model: L1 guidance and lags on the route) or imm (no route: turn rate only)"
        ),
    ]
    law: Annotated[str, Meta(description="controller twin in force, e.g. arduplane: L1 + TECS")] = ""
    origin: Annotated[tuple[int, int, int], Meta(description="NED origin: lat, lon [1e-7 deg], alt [mm AMSL]")]
    ahead: Annotated[Array, Meta(description="look-ahead from `t`, rising, not evenly, (n,) <f4 [s]")]
    path: Annotated[Array, Meta(description="mean position, NED from origin, (n, 3) <f4 [m]")]
    tube: Annotated[Array, Meta(description="half-axes along, cross, vertical; to be held all at once, (n, 3) <f4 [m]")]
    quantile: Annotated[float, Meta(description="share of flights the tube is meant to hold, 0..1")] = 0.9
    axis_quantile: Annotated[
        float,
        Meta(description="share of flights that each half-axis alone holds; 0: as of independent axes"),
    ] = 0.0
    horizon_s: Annotated[float, Meta(description="confidence horizon: `quantile` of its like stay within 10 % [s]")] = (
        0.0
    )
    horizon_open: Annotated[bool, Meta(description="true: still below 10 % at the end of `ahead`")] = False
    held: Annotated[float, Meta(description="share of answered look-aheads inside the tube, 0..1; nan before any")] = (
        float("nan")
    )
    held_n: Annotated[int, Meta(description="past predictions behind `held`")] = 0
    rollout_age_s: Annotated[
        float, Meta(description="age of the rollout that is continued from the newest position; 0: a new rollout [s]")
    ] = 0.0
    coverage_renewed: Annotated[
        float | None, Meta(description="as `held`, of continued rollouts alone, up to 60 s, 0..1; null before any")
    ] = None
    coverage_renewed_n: Annotated[int, Meta(description="past predictions behind `coverage_renewed`")] = 0
    calibration: Annotated[str, Meta(description="table that tube and horizon rest on, and how far adapted")] = ""
    coast_s: Annotated[float, Meta(description="time flown by the twin alone since the last sample [s]")] = 0.0
    seq: Annotated[int, Meta(description="mission item the prediction starts on; -1 none")] = -1
    sentence: Annotated[str, Meta(description="what limits this prediction, or empty")] = ""
    event: Annotated[Event | None, Meta(description="what last made it begin anew, or what it coasts through")] = None
    event_t: Annotated[float, Meta(description="when that was; 0 never [s since 1970]")] = 0.0
    event_said: Annotated[str, Meta(description="the event's sentence, with its particulars")] = ""
    controller: Annotated[
        Controller | None,
        Meta(description="law and parameters in force; null: as last told. Told on change, every 10 s, to queries"),
    ] = None

    def ned_origin(self) -> Origin:
        """Return the origin as a named tuple."""
        return Origin(*self.origin)


class WhatIfStart(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where a what-if begins; heading and speed stay as they are where they are not given."""

    lat_e7: Annotated[int, Meta(description="[1e-7 deg]")]
    lon_e7: Annotated[int, Meta(description="[1e-7 deg]")]
    alt_mm: Annotated[int, Meta(description="[mm above mean sea level]")]
    heading: Annotated[float | None, Meta(description="of the nose, clockwise from north [rad]")] = None
    speed: Annotated[float | None, Meta(description="through the air; of a multirotor over ground [m/s]")] = None


class WhatIf(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Payload of a query on `parauav/{uav}/prediction`: what to fly otherwise from now on. Changes no aircraft."""

    items: Annotated[
        tuple[Item, ...] | None, Meta(description="another mission, numbered as the autopilot does, at most 1,000")
    ] = None
    seq: Annotated[
        int | None, Meta(description="item to fly to first; null: the first of `items`, or the one in force")
    ] = None
    speed: Annotated[
        float | None, Meta(description="airspeed wherever the mission commands none else or one [m/s]")
    ] = None
    start: WhatIfStart | None = None
    wind: Annotated[tuple[float, float] | None, Meta(description="north, east, where it blows to [m/s]")] = None
    params: Annotated[dict[str, float], Meta(description="parameters, in the autopilot's names and units")] = {}


class Found(StrEnum):
    """What became of a diagnosis."""

    NONE = "none"
    SUSPECTED = "suspected"
    NAMED = "named"
    UNKNOWN = "unknown"


class Cause(msgspec.Struct, frozen=True, kw_only=True):
    """One effect that explains the flight, named or suspected."""

    name: Annotated[str, Meta(description="effect, as `fleet effects` lists it; unknown: none of them")]
    channel: Annotated[str, Meta(description="where it lives, e.g. actuator, thrust, air, airspeed, or a residual")] = (
        ""
    )
    surface: Annotated[str, Meta(description="aileron, elevator, rudder, all surfaces; empty: no surface")] = ""
    rivals: Annotated[tuple[str, ...], Meta(description="effects it cannot be told from by this flight")] = ()
    segments: Annotated[
        tuple[tuple[float, float], ...], Meta(description="when, from and to; the last to the newest [s since 1970]")
    ] = ()
    parameters: Annotated[dict[str, float], Meta(description="its numbers, unit in the name")] = {}
    sigma: Annotated[dict[str, float], Meta(description="their standard deviations, same names and units")] = {}


class Mismatch(Message, frozen=True, kw_only=True):
    """Where flight and twin part ways, and what physics explains it; answers queries."""

    topic: ClassVar[str] = "mismatch"

    outcome: Annotated[
        Found, Meta(description="named: proven on data held out; suspected: not; unknown: no effect explains it")
    ] = Found.NONE
    causes: Annotated[tuple[Cause, ...], Meta(description="the most telling first; empty for none")] = ()
    fit_before: Annotated[
        float | None,
        Meta(description="rms residual on data held out [standard deviations of nominal flight]; null: not proven"),
    ] = None
    fit_after: Annotated[
        float | None, Meta(description="the same with the causes in the simulation [standard deviations]")
    ] = None
    force_before: Annotated[float | None, Meta(description="rms error of specific force, held out [m/s2]")] = None
    force_after: Annotated[float | None, Meta(description="the same with the causes [m/s2]")] = None
    stray_before: Annotated[float | None, Meta(description="rms attitude error of free flights of 5 s [deg]")] = None
    stray_after: Annotated[float | None, Meta(description="the same with the causes [deg]")] = None
    seen_t0: Annotated[float, Meta(description="first instant of the flight it was diagnosed on [s since 1970]")] = 0.0
    adapted: Annotated[bool, Meta(description="true: predictions are flown with the causes in the model")] = False
    sentence: Annotated[str, Meta(description="all of it in one sentence, and which model predicts")] = ""

    @property
    def onset(self) -> float | None:
        """Return when the first cause began [s since 1970]; None where there is none."""
        return self.causes[0].segments[0][0] if self.causes and self.causes[0].segments else None


class AlertKind(StrEnum):
    """What an alert warns of."""

    LINK_LOST = "link_lost"
    SHORT_HORIZON = "short_horizon"
    CONFLICT = "conflict"
    GEOFENCE = "geofence"
    GROUND = "ground"
    NOT_ACHIEVABLE = "not_achievable"
    SECOND_SENDER = "second_sender"


About = tuple[AlertKind, int]
"""What the alerts of one UAV are told apart by: the kind, and the other UAV of a conflict (-1 none)."""


class Alert(Message, frozen=True, kw_only=True):
    """A warning for the operator, raised once; the same with `active` false withdraws it, once."""

    topic: ClassVar[str] = "alert"

    kind: AlertKind
    active: bool = True
    sentence: str = ""
    other: Annotated[int, Meta(description="the other UAV of a conflict, always the higher id; -1 none")] = -1
    probability: Annotated[float | None, Meta(description="that it comes to pass, 0..1; null: it is so now")] = None
    at: Annotated[float | None, Meta(description="when it is predicted for [s since 1970]; null: now")] = None
    lat: Annotated[int | None, Meta(description="where, latitude [1e-7 deg]; null: no one place")] = None
    lon: Annotated[int | None, Meta(description="where, longitude [1e-7 deg]")] = None
    alt: Annotated[int | None, Meta(description="where, height above mean sea level [mm]")] = None

    @property
    def about(self) -> About:
        """Return what it is told apart by."""
        return self.kind, self.other


class FleetRow(msgspec.Struct, frozen=True, kw_only=True):
    """One line of the fleet table."""

    uav: int
    state: State
    verdict: Annotated[str, Meta(description="sentence of the last verdict")]
    fit: Annotated[dict[str, float], Meta(description="per state [%]")] = {}
    horizon_s: Annotated[float, Meta(description="confidence horizon of the newest prediction [s]")] = 0.0
    worker: Annotated[str, Meta(description="writer of the accepted results, 16 hex digits")] = ""
    sample_age_s: Annotated[float | None, Meta(description="since the newest sample arrived [s]")] = None
    prediction_age_s: Annotated[float | None, Meta(description="since the newest prediction was made [s]")] = None
    t10_s: Annotated[
        float | None, Meta(description="median time past predictions stayed within 10 % (M1) [s]; null before any")
    ] = None
    t10_censored: Annotated[float | None, Meta(description="share of them still within 10 % at their end, 0..1")] = None
    t10_n: Annotated[int, Meta(description="past predictions behind `t10_s`")] = 0
    epoch: Annotated[int, Meta(description="claim epoch of the writer")] = 0
    alerts: Annotated[tuple[str, ...], Meta(description="sentences of the alerts in force")] = ()
    mismatch: Annotated[str, Meta(description="what was found in words, e.g. named thrust_loss; empty: nothing")] = ""


class FleetState(msgspec.Struct, frozen=True, kw_only=True):
    """The rows of one worker."""

    topic: ClassVar[str] = "@fleet/state"
    version: ClassVar[int] = 1

    t: Annotated[float, Meta(description="fleet time of the rows [s since 1970]")]
    rows: tuple[FleetRow, ...] = ()
    sentence: Annotated[str, Meta(description="e.g. compiling the twin's physics, once")] = ""
    done: Annotated[dict[str, int], Meta(description="heavy work since it began: predict, identify, ensemble")] = {}
    shed: Annotated[int, Meta(description="messages of aircraft it holds now that it could not keep for them")] = 0


class Predictions(msgspec.Struct, frozen=True, kw_only=True):
    """The newest prediction of every aircraft of one worker, in one answer."""

    topic: ClassVar[str] = "@fleet/prediction"
    version: ClassVar[int] = 1

    t: Annotated[float, Meta(description="fleet time of the answer [s since 1970]")]
    predictions: Annotated[
        tuple[msgspec.Raw, ...], Meta(description="each a Prediction; ours unpack it when read")
    ] = ()
    epochs: Annotated[tuple[int, ...], Meta(description="claim of each; readers keep the highest of an aircraft")] = ()


class LinkAccount(msgspec.Struct, frozen=True, kw_only=True):
    """Counters of one link, since the gateway began unless a unit says otherwise."""

    link: Annotated[str, Meta(description="as it was given")]
    datagrams: int = 0
    bytes_in: int = 0
    messages: int = 0
    bad_bytes: Annotated[int, Meta(description="bytes that were no MAVLink frame")] = 0
    bad_frames: Annotated[int, Meta(description="frames with a wrong checksum or an unknown message id")] = 0
    dropped: Annotated[int, Meta(description="datagrams received and dropped because decoding fell behind")] = 0
    overrun: Annotated[
        int | None, Meta(description="datagrams the system dropped before we received them; null: not told")
    ] = None
    sent: Annotated[int, Meta(description="datagrams sent by the gateway itself")] = 0
    bytes_out: int = 0
    unsent: Annotated[int, Meta(description="messages not sent or forwarded: nobody at the far end, or no room")] = 0
    bytes_s: Annotated[float, Meta(description="received of late [bytes/s]")] = 0.0
    messages_hz: Annotated[float, Meta(description="received of late [Hz]")] = 0.0
    recorded: Annotated[int, Meta(description="bytes of frames written to the .tlog, stamps left out")] = 0
    noise: Annotated[int, Meta(description="bytes not recorded because they belong to no frame")] = 0
    unrecorded: Annotated[int, Meta(description="bytes the disk did not take, or not in time")] = 0
    unwritten: Annotated[int, Meta(description="bytes that wait for the disk or for the rest of their frame")] = 0
    share: Annotated[float, Meta(description="asked for of the rates wanted, for the sake of the budget, 0..1")] = 1.0
    sentence: Annotated[str, Meta(description="what an operator should know, or empty")] = ""


class Account(msgspec.Struct, frozen=True, kw_only=True):
    """Counters of one gateway."""

    topic: ClassVar[str] = "@gateway"
    version: ClassVar[int] = 1

    t: Annotated[float, Meta(description="fleet time of the count [s since 1970]")]
    links: tuple[str, ...] = ()
    uavs: tuple[int, ...] = ()
    datagrams: int = 0
    bytes_in: int = 0
    messages: int = 0
    bad_bytes: Annotated[int, Meta(description="bytes that were no MAVLink frame")] = 0
    bad_frames: Annotated[int, Meta(description="frames with a wrong checksum or an unknown message id")] = 0
    refused: Annotated[dict[str, int], Meta(description="good frames refused, by reason")] = {}
    published: Annotated[int, Meta(description="messages given to a router that was there")] = 0
    sentence: str = ""
    per_link: tuple[LinkAccount, ...] = ()
    router: Annotated[bool, Meta(description="a router is there")] = True
    unsent: Annotated[int, Meta(description="messages nobody got, as no router was there")] = 0
    unsure: Annotated[int, Meta(description="published in the second before a router was missed")] = 0
    removed: Annotated[int, Meta(description="recordings removed to stay within the budget")] = 0
    history_bytes: Annotated[int, Meta(description="kept for late joiners")] = 0
    now: Annotated[float, Meta(description="when it was said, by the gateway's own clock [s since 1970]")] = 0.0
    machine: Annotated[str, Meta(description="name of the machine it runs on")] = ""
    code: Annotated[str, Meta(description="hash of the sources it runs")] = ""


class Claim(msgspec.Struct, frozen=True, kw_only=True):
    """Which aircraft one worker writes for.

    Of two claims on one aircraft the higher epoch counts, then the higher writer; one over 5 minutes ahead of the
    reader's own clock is refused.
    """

    topic: ClassVar[str] = "@claim"
    version: ClassVar[int] = 1

    t: Annotated[float, Meta(description="when it was said, by the worker's clock [s since 1970]")]
    worker: Annotated[str, Meta(description="writer, 16 hex digits")]
    held: Annotated[tuple[tuple[int, int], ...], Meta(description="UAV id and epoch of each aircraft held")] = ()
    bare: Annotated[tuple[int, ...], Meta(description="of these, whose telemetry of before is not there yet")] = ()
    leaving: Annotated[bool, Meta(description="true: it hands over everything and goes")] = False
    machine: Annotated[str, Meta(description="name of the machine it runs on")] = ""
    code: Annotated[str, Meta(description="hash of the sources it runs")] = ""
    seen: Annotated[
        tuple[tuple[int, int, str], ...],
        Meta(description="to queries only: UAV id, epoch and writer of the highest claim it knows of"),
    ] = ()


class Handover(msgspec.Struct, frozen=True, kw_only=True):
    """A copy of one aircraft's twin for its new owner; who holds it writes until that does."""

    topic: ClassVar[str] = "@handover"
    version: ClassVar[int] = 1

    t: Annotated[float, Meta(description="when it was copied, by the worker's clock [s since 1970]")]
    uav: Annotated[int, Meta(description="UAV id")]
    epoch: Annotated[int, Meta(description="under which it is written for; the new owner's is higher")]
    code: Annotated[str, Meta(description="hash of the sources that wrote `load`; others must not read it")]
    load: Annotated[bytes, Meta(description="twin, messages not yet taken in, open conflicts, mismatch")] = b""


class Wanted(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Payload of a query on `parauav/@handover/{writer}`: the twins of which aircraft."""

    uavs: Annotated[tuple[int, ...], Meta(description="UAV ids")] = ()


PER_UAV: tuple[type[Message], ...] = (Sample, Status, Mission, Params, History, Model, Prediction, Mismatch, Alert)
CONTROL: tuple[type, ...] = (FleetState, Predictions, Account, Claim, Handover)
QUERIES: dict[type, type] = {Prediction: WhatIf, Handover: Wanted}  # what a query on a key may carry
TOPICS: dict[str, type] = {c.topic: c for c in (*PER_UAV, *CONTROL)}  # type: ignore[attr-defined]


def meaning(hint: Any) -> str:
    """Read the description, with its unit, off an annotation."""
    metas = [m for m in getattr(hint, "__metadata__", ()) if isinstance(m, msgspec.Meta)]
    return " ".join(m.description for m in metas if m.description)
