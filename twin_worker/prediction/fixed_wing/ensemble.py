"""Ensemble of point-mass rollouts with random air and airframe parameters; its spread is the uncertainty.

Source: Evensen 2009, chapter 2 (Monte Carlo error propagation).
"""

import numpy as np

from fleet.physics import point_mass as H
from twin_worker.confidence.tube_and_horizon import track_frame
from twin_worker.identification.fixed_wing.point_mass_model import Hybrid
from twin_worker.prediction.closed_loop import Situation, Start
from twin_worker.prediction.fixed_wing.point_mass_rollout import begin, over_ground, rest

MEMBERS = 24
_LEAST = 0.5  # minimum fraction of members that stay in their envelope [-]
_POSITION = 0.4  # standard deviation of the position at the start [m]
_VELOCITY = 0.1  # of the ground velocity [m/s]
_AIRSPEED = 0.35  # of the airspeed [m/s]
_ALPHA = 0.01  # of the angle of attack [rad]
_LAG = 0.12  # of the lags' bandwidths, relative [-]
_ROUGH = 2.5  # factor on the turbulence: the noise of the wind filter includes sideslip [-]
_POWER = 1.5  # factor on the standard deviations of power, which is poorly identifiable in closed loop [-]


def draw(
    now: Situation, start: Start, found: Hybrid, chance: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, ...]:
    """Draw parameters, air and start of members for `noise`, (m, seconds, 4); see `fleet.physics.point_mass.bundle`.

    The first member is the mean, without random deviations.
    """
    members = len(chance)
    state, air = begin(now, start.good)
    body, airs, states = (np.tile(row, (members, 1)) for row in (found.body, air, state))
    z = rng.standard_normal((members, 20))
    z[0] = 0.0
    mean, cov = now.wind.state
    x = mean + z[:, :8] @ np.linalg.cholesky(cov + 1e-10 * np.eye(8)).T
    airs[:, H.SCALE], airs[:, H.D_PSI] = np.hypot(x[:, 0], x[:, 1]), np.arctan2(x[:, 1], x[:, 0])
    airs[:, H.W_N : H.DRIFT_E + 1] = x[:, 2:6]
    airs[:, [H.DRIFT, H.REST]] *= _ROUGH * now.wind.roughness
    states[:, :3] += _POSITION * z[:, 8:11]
    states[:, H.V] = states[:, H.V] / air[H.SCALE] * airs[:, H.SCALE] + _AIRSPEED * z[:, 11]
    v = over_ground(state, air) + _VELOCITY * z[:, 12:14]
    airs[:, [H.REST_N, H.REST_E]] = rest(states, airs, v)
    body[:, H.C_0 : H.C_N + 1] += _POWER * z[:, 14:18] @ np.linalg.cholesky(found.power.cov).T
    body[:, H.A_0] += _ALPHA * z[:, 18]
    body[:, [H.WN_PHI, H.WN_THETA]] *= np.exp(_LAG * z[:, 19:20])
    return body, airs, states


def spread(
    now: Situation, start: Start, found: Hybrid, ahead: np.ndarray, rng: np.random.Generator, *, members: int = MEMBERS
) -> np.ndarray | None:
    """Simulate the ensemble; return standard deviations along, cross, vertical about the first member, (k, 3) [m].

    Return None if too many members leave their envelope.

    Args:
        context, initial, model: as for `fly_point_mass`
        ahead: look-ahead times in whole steps of `fleet.physics.point_mass.COARSE`, rising, (k,) [s]
        rng: random number generator
        members: number of members
    """
    chance = rng.standard_normal((members, int(ahead[-1]) + 1, 4))
    chance[0] = 0.0
    out = np.empty((members, len(ahead), 3))
    at = np.rint(ahead / H.COARSE).astype(np.int64)
    H.bundle(start.control, *draw(now, start, found, chance, rng), chance, at, out)  # type: ignore[call-arg]
    stays = np.isfinite(out.reshape(len(out), -1).sum(axis=1))
    if not stays[0] or stays.sum() < _LEAST * members:
        return None
    along, miss = track_frame(out[0]), out[1:][stays[1:]] - out[0]
    ahead_, across = (miss[..., :2] * along).sum(axis=-1), miss[..., 1] * along[:, 0] - miss[..., 0] * along[:, 1]
    return np.sqrt(np.mean(np.stack([ahead_, across, miss[..., 2]], axis=-1) ** 2, axis=0))
