"""Lost links in simulated flight, for every failsafe: the share of predictions that are kept for a minute."""

from collections.abc import Iterable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from fleet.contract import Prediction
from tests.bench.mode_changes.flown import Flight, epoch, fly, fly_lost, make, predict
from twin_worker.numerics.prediction_errors import along_cross_down, min_path_length, track_frame
from twin_worker.twin.step import Twin, advance

FIRST_S, LAST_S = 150.0, 200.0  # range of the times of the loss [s]
SILENT_S, HELD_S, AFTER_S = 20.0, 60.0, 85.0  # silent steps of the twin, look-ahead that counts, flight after the loss
LIMIT = 0.10
_RADIO = {"THR_FAILSAFE": 1.0, "RC_FS_TIMEOUT": 1.0, "FS_LONG_TIMEOUT": 5.0, "FS_GCS_ENABL": 0.0, "RTL_ALTITUDE": 110.0}
_LINK = {"COM_DL_LOSS_T": 10.0, "COM_FAIL_ACT_T": 5.0, "COM_RC_LOSS_T": 0.5, "NAV_DLL_ACT": 0.0, "COM_RC_IN_MODE": 0.0}
SETTINGS: Mapping[str, Mapping[str, Mapping[str, float]]] = {
    "ardupilot": {
        f"short {short:.0f}, long {long:.0f}": _RADIO | {"FS_SHORT_ACTN": short, "FS_LONG_ACTN": long}
        for short, long in ((0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (1.0, 4.0), (2.0, 2.0), (3.0, 1.0), (4.0, 1.0))
    }
    | {
        f"ground station {gcs:.0f}, long 1": _RADIO
        | {"THR_FAILSAFE": 0.0, "FS_GCS_ENABL": gcs, "FS_SHORT_ACTN": 0.0, "FS_LONG_ACTN": 1.0}
        for gcs in (0.0, 1.0, 3.0)
    },
    "px4": {f"data link {action:.0f}": _LINK | {"NAV_DLL_ACT": action} for action in (0.0, 1.0, 2.0)}
    | {f"radio {action:.0f}": _LINK | {"NAV_RCL_ACT": action, "COM_RC_IN_MODE": 1.0} for action in (1.0, 2.0)},
}


@dataclass(frozen=True)
class Loss:
    """Predictions after one lost link.

    Attributes:
        setting: failsafe
        held: share of predictions within 10 % of the path flown since the loss, for 60 s or until the ground [-]
        inside: share of look-aheads 16, 30 and 60 s in the prediction region [-]
        error_m: of the first prediction 60 s ahead; nan where the flight ended before [m]
        horizon_s: confidence horizon of the first prediction [s]
        axis_m: its half-axis along the path at 60 s [m]
    """

    seed: int
    autopilot: str
    t: float
    setting: str
    held: float
    inside: float
    error_m: float
    horizon_s: float
    axis_m: float


def measure(seed: int, autopilot: str, folder: Path) -> list[Loss]:
    """Fly a seed to the loss of its link, and on with every failsafe; return what is predicted of it."""
    lost_t = round(float(np.random.default_rng((seed, 14)).uniform(FIRST_S, LAST_S)), 1)
    flight = fly(make(seed, autopilot), seed, lost_t, folder)
    twins: dict[int, Twin] = {}
    for _ in predict(flight.messages, twins):
        pass
    (twin,) = twins.values()
    return [_loss((seed, autopilot, lost_t), twin, *setting) for setting in SETTINGS[autopilot].items()]


def _loss(flown: tuple[int, str, float], twin: Twin, name: str, params: Mapping[str, float]) -> Loss:
    seed, autopilot, lost_t = flown
    copy = deepcopy(twin)
    assert copy.onboard.params is not None
    copy.onboard.set_params(msgspec.structs.replace(copy.onboard.params, values=copy.received_params | dict(params)))
    flight = fly_lost(make(seed, autopilot, params), lost_t, lost_t + AFTER_S)
    made: list[Prediction] = []
    for k in range(1, int(SILENT_S) + 1):
        results = advance(copy, (), epoch(lost_t) + k)
        made += [r for r in results if isinstance(r, Prediction) and r.coast_s > 0]
    first = made[0]
    k60 = int(np.searchsorted(first.ahead.numpy(), HELD_S))
    return Loss(
        *flown,
        name,
        float(np.mean([is_held(flight, p, lost_t) for p in made])),
        float(np.nanmean([_inside(flight, first, s) for s in (16.0, 30.0, 60.0)])),
        float(_errors(flight, first)[k60]),
        first.horizon_s,
        float(first.prediction_region_half_axes.numpy()[k60, 0]),
    )


def _errors(flight: Flight, p: Prediction) -> np.ndarray:
    path = p.path.numpy().astype(float)
    return np.linalg.norm(flight.positions(p.ned_origin(), p.t + p.ahead.numpy().astype(float)) - path, axis=1)


def is_held(flight: Flight, p: Prediction, lost_t: float) -> bool:
    """Return whether the error stays within 10 % of the path flown since the loss, until the flight ends."""
    ahead = p.ahead.numpy().astype(float)
    steps = np.linalg.norm(np.diff(flight.flown, axis=0), axis=1)
    speed = float(steps[:5].sum() / (flight.flown_t[5] - flight.flown_t[0]))
    length = np.interp(p.t + ahead, flight.flown_t[1:], np.cumsum(steps))
    within = _errors(flight, p) <= LIMIT * np.maximum(length, min_path_length(speed))
    counts = (ahead <= HELD_S) & (p.t + ahead <= flight.flown_t[-1])
    return bool(within[counts].all())


def _inside(flight: Flight, p: Prediction, seconds: float) -> float:
    ahead, path = p.ahead.numpy().astype(float), p.path.numpy().astype(float)
    error = along_cross_down(track_frame(path, ahead), flight.positions(p.ned_origin(), p.t + ahead) - path)
    k = int(np.searchsorted(ahead, seconds))
    half_axes = p.prediction_region_half_axes.numpy()[k]
    return float((np.abs(error[k]) <= half_axes).all()) if np.isfinite(error[k]).all() else float("nan")


def report(losses: Sequence[Loss]) -> Iterable[str]:
    """Yield a table by autopilot and failsafe, over the flights."""
    yield "| autopilot, failsafe | losses | 60 s held | in region | error at 60 s [m] | horizon [s] | half-axis [m] |"
    yield "|---|---|---|---|---|---|---|"
    names = {(loss.autopilot, loss.setting): None for loss in losses}
    for autopilot, setting in [*names, ("all", "")]:
        rows = [x for x in losses if autopilot == "all" or (x.autopilot, x.setting) == (autopilot, setting)]
        error, horizon, axis = (_median([getattr(x, n) for x in rows]) for n in ("error_m", "horizon_s", "axis_m"))
        yield (
            f"| {autopilot}{', ' if setting else ''}{setting} | {len(rows)} | {np.mean([x.held for x in rows]):.0%} "
            f"| {np.nanmean([x.inside for x in rows]):.0%} | {error:.0f} | {horizon:.0f} | {axis:.0f} |"
        )


def _median(values: Sequence[float]) -> float:
    finite = [x for x in values if np.isfinite(x)]
    return float(np.median(finite)) if finite else float("nan")
