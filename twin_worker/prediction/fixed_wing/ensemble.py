"""Ensemble of point-mass rollouts with random air and airframe parameters; its spread is the uncertainty.

Source: Evensen 2009, chapter 2 (Monte Carlo error propagation).
"""

import numpy as np

from fleet.physics import point_mass as H
from twin_worker.confidence.tube_and_horizon import track_frame
from twin_worker.identification.fixed_wing.point_mass_model import PointMassModel
from twin_worker.prediction.closed_loop import InitialCondition
from twin_worker.prediction.fixed_wing.path_wind import drift_draws, surer_field
from twin_worker.prediction.fixed_wing.point_mass_rollout import (
    model_ground_velocity,
    start_and_air,
    unexplained_velocity,
)
from twin_worker.prediction.replay_window import PredictionContext

MEMBERS = 24
_MIN_SURVIVING = 0.5  # minimum fraction of members that stay in their envelope [-]
_POSITION_SIGMA = 0.4  # standard deviation of the position at the start [m]
_VELOCITY_SIGMA = 0.1  # of the ground velocity [m/s]
_AIRSPEED_SIGMA = 0.35  # of the airspeed [m/s]
_ALPHA_SIGMA = 0.01  # of the angle of attack [rad]
_LAG_SIGMA = 0.12  # of the lags' bandwidths, relative [-]
_TURBULENCE_FACTOR = 2.5  # factor on the turbulence: the noise of the wind filter includes sideslip [-]
_POWER_FACTOR = 1.5  # factor on the standard deviations of power, which is poorly identifiable in closed loop [-]


def draw_members(
    context: PredictionContext,
    initial: InitialCondition,
    model: PointMassModel,
    noise: np.ndarray,
    rng: np.random.Generator,
) -> tuple[np.ndarray, ...]:
    """Draw parameters, air and start of members for `noise`, (m, seconds, 4); see `simulate_ensemble`.

    The first member is the mean, without random deviations. Where the shared wind field is surer than the aircraft's
    own wind, the drift of every member is a draw from it, and its columns of `noise` are changed in place.
    """
    members = len(noise)
    state, air = start_and_air(context, initial.window)
    parameters, airs, states = (np.tile(row, (members, 1)) for row in (model.parameters, air, state))
    z = rng.standard_normal((members, 20))
    z[0] = 0.0
    mean, cov = context.wind_filter.state
    wind_state = mean + z[:, :8] @ np.linalg.cholesky(cov + 1e-10 * np.eye(8)).T
    airs[:, H.SCALE], airs[:, H.D_PSI] = (
        np.hypot(wind_state[:, 0], wind_state[:, 1]),
        np.arctan2(wind_state[:, 1], wind_state[:, 0]),
    )
    airs[:, H.W_N : H.DRIFT_E + 1] = wind_state[:, 2:6]
    shared = surer_field(context, initial, model, (state, air), float(noise.shape[1] - 1))
    if shared is not None:
        wind, mean_drift = shared
        drift = mean_drift + _correlated_draws(wind.cov, members, rng)
        airs[:, H.W_N : H.DRIFT_N], airs[:, H.DRIFT_N : H.DRIFT_E + 1] = air[H.W_N : H.DRIFT_N], drift[:, 0]
        noise[..., :2] = drift_draws(wind, drift, air, noise.shape[1])
    airs[:, H.REST] *= _TURBULENCE_FACTOR * context.wind_filter.innovation_ratio
    states[:, :3] += _POSITION_SIGMA * z[:, 8:11]
    states[:, H.V] = states[:, H.V] / air[H.SCALE] * airs[:, H.SCALE] + _AIRSPEED_SIGMA * z[:, 11]
    v = model_ground_velocity(state, air) + _VELOCITY_SIGMA * z[:, 12:14]
    airs[:, [H.REST_N, H.REST_E]] = unexplained_velocity(states, airs, v)
    parameters[:, H.C_0 : H.C_N + 1] += _POWER_FACTOR * z[:, 14:18] @ np.linalg.cholesky(model.excess_power.cov).T
    parameters[:, H.A_0] += _ALPHA_SIGMA * z[:, 18]
    parameters[:, [H.WN_PHI, H.WN_THETA]] *= np.exp(_LAG_SIGMA * z[:, 19:20])
    return parameters, airs, states


def _correlated_draws(cov: np.ndarray, members: int, rng: np.random.Generator) -> np.ndarray:
    """Return draws of two components with a covariance (k, k), zero for the first member, (members, k, 2)."""
    values, vectors = np.linalg.eigh(cov)
    z = rng.standard_normal((members, len(cov), 2))
    z[0] = 0.0
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))) @ z)


def ensemble_std(
    context: PredictionContext,
    initial: InitialCondition,
    model: PointMassModel,
    ahead: np.ndarray,
    rng: np.random.Generator,
    *,
    members: int = MEMBERS,
) -> np.ndarray | None:
    """Simulate the ensemble; return standard deviations along, cross, vertical about the first member, (k, 3) [m].

    Return None if too many members leave their envelope.

    Args:
        context, initial, model: as for `fly_point_mass`
        ahead: look-ahead times in whole steps of `fleet.physics.point_mass.COARSE`, rising, (k,) [s]
        rng: random number generator
        members: number of members
    """
    noise = rng.standard_normal((members, int(ahead[-1]) + 1, 4))
    noise[0] = 0.0
    out = np.empty((members, len(ahead), 3))
    step_index = np.rint(ahead / H.COARSE_STEP).astype(np.int64)
    H.simulate_ensemble(
        initial.synchronised, *draw_members(context, initial, model, noise, rng), noise, step_index, out
    )  # type: ignore[call-arg]
    survives = np.isfinite(out.reshape(len(out), -1).sum(axis=1))
    if not survives[0] or survives.sum() < _MIN_SURVIVING * members:
        return None
    along, deviation = track_frame(out[0]), out[1:][survives[1:]] - out[0]
    along_error, cross_error = (
        (deviation[..., :2] * along).sum(axis=-1),
        deviation[..., 1] * along[:, 0] - deviation[..., 0] * along[:, 1],
    )
    return np.sqrt(np.mean(np.stack([along_error, cross_error, deviation[..., 2]], axis=-1) ** 2, axis=0))
