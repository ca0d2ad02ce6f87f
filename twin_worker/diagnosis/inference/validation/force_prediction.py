"""Predict the accelerometer from the other sensors, and free runs of the model, compared on held-out blocks.

Lift follows from velocity and attitude, or from the pitching moment; side force from sideslip over the ground, or from
the rolling or yawing moment; dynamic pressure from velocity, or from the airspeed sensor. An effect is visible where it
acts: the combination of sources is selected on the blocks of the fit and evaluated on the others.
"""

from collections.abc import Sequence
from itertools import product

import numpy as np

from fleet.effects import Stage
from twin_worker.diagnosis.data.card import FaultHypothesis
from twin_worker.diagnosis.data.flight import DECIMATION, DT
from twin_worker.diagnosis.model import equations as eq
from twin_worker.diagnosis.model.residual import EquationTerms, ModelledFlight, evaluate_equation
from twin_worker.diagnosis.model.simulate import STATE, Simulation

LIFT = ("velocity", "pitch")
SIDE = ("velocity", "roll", "yaw")
PRESSURE = ("velocity", "airspeed")
BLOCK_S = 10.0
_ITERATIONS = 4  # of the pitching moment equation, whose drag depends on lift
_ACTING = 0.95  # share of the change of the prediction in the blocks resampled
_MIN_BLOCKS, _RESAMPLES, _SEED = 3, 500, 17
_LEVELS = 2.5, 97.5  # percentiles of the interval
_MAX_SIDESLIP = 0.35  # limit of the predicted sideslip [rad]


def blocks(t: np.ndarray, odd: bool) -> np.ndarray:
    """Return which times lie in odd, or in even, blocks of 10 s, (n,) bool."""
    return (np.floor(t / BLOCK_S) % 2 == 1) == odd


def predict_forces(
    modelled: ModelledFlight, weather: tuple[FaultHypothesis, ...], fitted: tuple[FaultHypothesis, ...]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Predict forces without and with effects, from the sources with the largest error drop on even blocks.

    Returns:
        specific force measured, predicted without and with the effects, on the decimated grid, (n, 3) each [m/s2]
    """
    before, after = modelled.equation_terms(weather), modelled.equation_terms((*weather, *fitted))
    measured = before.intermediate["f"].T
    sources = list(product(LIFT, SIDE, PRESSURE if "Va" in modelled.flight.readings else ("velocity",)))
    if not fitted:
        predicted = predict_force(before, sources[0])
        return measured, predicted, predicted
    even = modelled.ok & blocks(modelled.t, odd=False)

    def error_drop(source: tuple[str, str, str]) -> float:
        errors = [((predict_force(terms, source) - measured)[even] ** 2).mean() for terms in (before, after)]
        return float(1.0 - np.sqrt(errors[1] / max(errors[0], 1e-12)))

    best = max(sources, key=error_drop)
    return measured, predict_force(before, best), predict_force(after, best)


def rms(modelled: ModelledFlight, error: np.ndarray) -> float:
    """Return the rms of an error, (n, 3), on valid held-out rows."""
    mask = modelled.ok & blocks(modelled.t, odd=True) & np.isfinite(error).all(axis=1)
    return float(np.sqrt((error[mask] ** 2).mean())) if mask.any() else float("nan")


def is_in_forces(hypothesis: FaultHypothesis) -> bool:
    """Return whether a prediction of forces shows an effect: not a sensor fault, except of the airspeed."""
    effect = hypothesis.effect
    return not effect.variance and (effect.stage is not Stage.SENSOR or effect.channel == "airspeed")


def held_out_gain(
    modelled: ModelledFlight,
    measured: np.ndarray,
    predicted: tuple[np.ndarray, np.ndarray],
) -> tuple[float, float, float]:
    """Return the gain 1 - rms(after) / rms(before) on held-out blocks and its 95 % interval, by resampling of blocks.

    Only blocks in which the effects act are resampled, those with 95 % of the squared change of the prediction.

    Args:
        modelled: the flight with its baseline
        measured, predicted: specific force, without and with the effects, (n, 3)
    Returns:
        gain and limits; nan with fewer than three such blocks, from which no interval follows
    """
    finite = np.isfinite(predicted).all(axis=(0, 2)) & np.isfinite(measured).all(axis=1)
    rows = modelled.ok & finite & blocks(modelled.t, odd=True)
    pairs = (predicted[0], measured), (predicted[1], measured), predicted
    squares = np.array([np.where(rows, np.nan_to_num(((x - y) ** 2).sum(axis=1)), 0.0) for x, y in pairs])
    labels = np.floor(modelled.t / BLOCK_S).astype(int)
    labels -= labels[0]
    by_block = np.stack([np.bincount(labels, row) for row in squares], axis=1)
    order = np.argsort(-by_block[:, 2])
    change = np.cumsum(by_block[order, 2])
    sums = by_block[order[: int(np.searchsorted(change, _ACTING * change[-1])) + 1]]
    if len(sums) < _MIN_BLOCKS or change[-1] <= 0.0:
        return np.nan, np.nan, np.nan
    drawn = np.random.default_rng(_SEED).integers(len(sums), size=(_RESAMPLES, len(sums)))
    before, after, _ = sums[drawn].sum(axis=1).T
    low, high = np.percentile(1.0 - np.sqrt(after / np.maximum(before, 1e-12)), _LEVELS)
    total = sums.sum(axis=0)
    return float(1.0 - np.sqrt(total[1] / max(total[0], 1e-12))), float(low), float(high)


def predict_force(eq_terms: EquationTerms, source: tuple[str, str, str]) -> np.ndarray:
    """Predict specific force, (n, 3) [m/s2], from `eq_terms` without its accelerometer."""
    base, flow, add = eq_terms.modelled.base, eq_terms.flow, eq_terms.add
    body = base.card.body
    q_bar = flow.q_bar
    if source[2] == "airspeed":
        q_bar = 0.5 * eq.RHO_0 * (eq_terms.measured["airspeed"] / base.airspeed) ** 2
    q_S = q_bar * body.S
    hats = flow.p * body.b / (2 * flow.Va), flow.q * body.c / (2 * flow.Va), flow.r * body.b / (2 * flow.Va)
    d_a, d_e, d_r = eq_terms.intermediate["delta"][:3]
    T = (base.coef["T"] @ eq_terms.regressors["T"]) * (1.0 + add.get("thrust", 0.0))
    A, B = base.coef["alpha"], base.coef["beta"]
    c_z = eq.solve_c_z(A, flow.alpha - A[0] - A[3] * hats[1] - A[5] * d_e)
    beta = flow.beta

    def axial(c_z: np.ndarray) -> np.ndarray:
        """Return the axial force coefficient without thrust."""
        alpha = A[0] + A[1] * c_z + A[2] * c_z**2 + A[3] * hats[1] + A[5] * d_e
        lift = add.get("lift", 0.0) * -c_z + add.get("C_L", 0.0)
        clean = base.coef["X"] @ eq.force_terms(c_z, d_e, beta)
        return clean + lift * np.sin(alpha) - add.get("C_D", 0.0) * np.cos(alpha)  # type: ignore[no-any-return]

    if source[0] == "pitch":
        M = base.coef["M"]
        rest = (eq_terms.measured["M"] - T * M[-1] - add.get("M", 0.0)) / (q_S * body.c) - add.get("C_m", 0.0)
        rest = rest - M[0] - M[2] * hats[1] - M[3] * d_e
        shift = add.get("x_cg", 0.0) / body.c
        for _ in range(_ITERATIONS):
            c_z = (rest - M[5] * c_z**2 - M[6] * (axial(c_z) + T / q_S)) / (M[1] + shift)
    if source[1] != "velocity":
        name = {"roll": "L", "yaw": "N"}[source[1]]
        terms = eq.lateral_terms(np.zeros_like(c_z), hats[0], hats[2], d_a, d_r, c_z)
        rest = (eq_terms.measured[name] - add.get(name, 0.0)) / (q_S * body.b) - add.get(f"C_{name.lower()}", 0.0)
        rest = rest - evaluate_equation(base, {}, name, terms)
        rest = rest + (add.get("y_cg", 0.0) / body.b * c_z if name == "L" else 0.0)
        beta = np.clip(rest / base.coef[name][1], -_MAX_SIDESLIP, _MAX_SIDESLIP)
    c_y = (beta - B[0] - B[2] * hats[0] - B[3] * hats[2] - B[4] * d_r) / B[1]
    lift = add.get("lift", 0.0) * -c_z + add.get("C_L", 0.0)
    force = np.stack([q_S * axial(c_z) + T, q_S * (c_y + add.get("C_Y", 0.0)), q_S * (c_z - lift)], axis=1)
    return force / np.broadcast_to(eq_terms.intermediate["mass"], c_z.shape)[:, None]


FREE_RUN_S = 5.0  # length of a free run
_MAX_ERROR = np.pi  # limit of the attitude error [rad]


def free_run_errors(modelled: ModelledFlight, hypotheses: Sequence[tuple[FaultHypothesis, ...]]) -> list[float]:
    """Return the rms attitude error of free runs from measured states, on held-out blocks [rad], all run in parallel.

    Args:
        modelled: the flight with its baseline
        hypotheses: for each error, the effects active in the simulation, and sensor faults corrected in the recording
    """
    t = modelled.flight.t
    n = int(FREE_RUN_S / DT)
    starts = np.arange(0, len(t) - n, n)
    starts = starts[
        blocks(t[starts], odd=True) & modelled.ok[starts // DECIMATION] & modelled.ok[(starts + n) // DECIMATION]
    ]
    if not len(starts):
        return [float("nan")] * len(hypotheses)
    readings = [modelled.corrected_readings(acting) for acting in hypotheses]
    measured = [np.stack([s[name] for name in STATE]) for s in readings]
    acting = [[g for g in group if g.effect.stage is not Stage.SENSOR] for group in hypotheses for _ in starts]
    sim = Simulation(modelled.base, acting, np.tile(t[starts], len(hypotheses)), modelled.flight.ground)
    rows = np.tile(starts, len(hypotheses))
    commands = modelled.flight.commands
    x = np.concatenate([m[:, starts // DECIMATION] for m in measured], axis=1)
    runs = sim.simulate(x, lambda k, _: commands[rows + k].T, n)
    steps = np.arange(0, n, DECIMATION)
    errors = []
    for simulated, m in zip(np.split(runs.states[steps, 6:9], len(hypotheses), axis=2), measured, strict=True):
        attitude = m[6:9, (starts[None, :] + steps[:, None]) // DECIMATION].transpose(1, 0, 2)
        error = np.clip(simulated - attitude, -_MAX_ERROR, _MAX_ERROR)
        errors.append(float(np.sqrt((error**2).mean())))
    return errors
