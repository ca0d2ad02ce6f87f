"""Wind along a predicted path: of the shared field where it is surer than the aircraft's own filter.

The displacement by wind within a minute is the integral of the wind along the path. The source whose covariance gives
that integral the smaller variance is used for the whole rollout. Both sources contain the aircraft's own telemetry, so
they are never averaged: this is covariance intersection of two isotropic estimates, whose optimum is the surer one.

Source: Julier and Uhlmann 1997 (covariance intersection).
"""

from dataclasses import replace

import numpy as np

from fleet.frames import rotation
from fleet.physics import point_mass as H
from twin_worker.estimation.wind_field import PathWind, own_wind
from twin_worker.identification.fixed_wing.point_mass_model import PointMassModel
from twin_worker.prediction.closed_loop import InitialCondition
from twin_worker.prediction.replay_window import PredictionContext

FIELD_SPAN_S = 60.0  # of the path on which both are compared [s]
_STEP_S = 5.0  # between points of the path [s]


def surer_field(
    context: PredictionContext,
    initial: InitialCondition,
    model: PointMassModel,
    start: tuple[np.ndarray, np.ndarray],
    span_s: float,
) -> tuple[PathWind, np.ndarray] | None:
    """Return the wind of the shared field along the path that is flown with the aircraft's own; None if that is surer.

    The second value is its mean less the profile from W_N, W_E: the drift of `fleet.physics.point_mass`, (k, 2) [m/s].

    Args:
        context, initial, model: as for `fly_point_mass`
        start: state at the start, (N_START,), and air, (N_AIR,)
        span_s: length of the rollout [s]
    """
    if context.shared_wind is None:
        return None
    (ctl, par, legs), (state, air) = initial.synchronised, start
    path = np.empty((int(span_s / H.COARSE_STEP) + 2, 3))
    n_rows = H.simulate_route(
        ctl.copy(), par, legs, model.parameters, air, state, np.empty((0, 4)), H.COARSE_STEP, path
    )
    stride = round(_STEP_S / H.COARSE_STEP)
    points = path[:n_rows:stride]
    ahead, t_0 = _STEP_S * np.arange(len(points)), float(initial.window.t[-1])
    if len(points) < 2:
        return None
    field = context.shared_wind.along(context.uav, t_0, ahead, points, context.origin)
    k = int(np.searchsorted(ahead, FIELD_SPAN_S, side="right"))
    if field is None or not _sigma(field, k) < _sigma(own_wind(context.wind_filter, ahead[:k]), k):
        return None
    shear = np.ones(len(points))
    if air[H.H_0] > 0.0:
        height = np.maximum(air[H.GROUND] - points[:, 2], H.MIN_SHEAR_HEIGHT)
        shear = (height / air[H.H_0]) ** H.SHEAR
    return field, field.mean - shear[:, None] * air[[H.W_N, H.W_E]]


def _sigma(wind: PathWind, k: int) -> float:
    return PathWind(wind.t[:k], wind.mean[:k], wind.cov[:k, :k]).path_sigma


def with_mean_wind(initial: InitialCondition, wind: PathWind) -> InitialCondition:
    """Return the start of `fleet.physics.simulate` in the mean wind of the first minute, with the same ground velocity.

    The reported airspeed is the same, too: its difference is a gust.
    """
    state, command, air = initial.state
    mean = wind.mean[wind.t <= FIELD_SPAN_S].mean(axis=0)
    R = rotation(*state[9:12])
    through_air = state[3:6] + R.T @ np.append(air[:2] - mean, 0.0)
    gust = air[3] + np.linalg.norm(state[3:6]) - np.linalg.norm(through_air)
    moved = np.concatenate([state[:3], through_air, state[6:]])
    return replace(initial, state=(moved, command, np.array([*mean, air[2], gust])))


def with_drift(air: np.ndarray, drift: np.ndarray) -> np.ndarray:
    """Return the air (N_AIR,) with another drift at the start, (2,) [m/s], and the same total wind."""
    out = air.copy()
    out[[H.REST_N, H.REST_E]] += air[[H.DRIFT_N, H.DRIFT_E]] - drift
    out[[H.DRIFT_N, H.DRIFT_E]] = drift
    return out


def drift_draws(wind: PathWind, drift: np.ndarray, air: np.ndarray, seconds: int) -> np.ndarray:
    """Return the draws of `fleet.physics.point_mass.simulate_route` that make the drift follow given values.

    Args:
        wind: its look-aheads
        drift: drift at them, the first as in `air`, (k, 2) or (m, k, 2) [m/s]
        air: standard deviation and time constant of the drift, (N_AIR,)
        seconds: rows, one a second
    Returns:
        (seconds, 2) or (m, seconds, 2)
    """
    t = np.minimum(np.arange(seconds, dtype=float), wind.t[-1])
    j = np.clip(np.searchsorted(wind.t, t, side="right") - 1, 0, len(wind.t) - 2)
    part = ((t - wind.t[j]) / (wind.t[j + 1] - wind.t[j]))[:, None]
    values = (1.0 - part) * drift[..., j, :] + part * drift[..., j + 1, :]
    out = np.zeros_like(values)
    out[..., 1:, :] = values[..., 1:, :] - np.exp(-1.0 / air[H.DRIFT_S]) * values[..., :-1, :]
    return np.asarray(out / (air[H.DRIFT] * np.sqrt(1.0 - np.exp(-2.0 / air[H.DRIFT_S]))))
