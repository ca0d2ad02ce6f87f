"""Calibration of the rotor model on nominal flights of one multirotor; model file."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from scipy.signal import lfilter
from scipy.stats import t as student_t

from twin_worker.diagnosis.multirotor.flight import RotorFlight
from twin_worker.diagnosis.multirotor.linearise import (
    ORDER,
    FlightFit,
    FlightSolution,
    LinearFlight,
    ResidualNoise,
    autoregression,
    solve,
)
from twin_worker.diagnosis.multirotor.model import CHANNELS, PARAMETERS, residuals

FORMAT = "parauav.rotors.2"
_PASSES = 3
_FALSE_ALARM = 0.01  # probability that a channel of a nominal flight seems too noisy in any block
_NO_LIMIT = 1e3
_ALIKE = (slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12), slice(12, 13))
"""Channels of specific force, angular acceleration, velocity, attitude, pressure height."""
NominalGains = Callable[[RotorFlight, "RotorBaseline"], tuple[dict[str, float], dict[str, float], np.ndarray]]
_START = {"k": 8.0, "expo": 0.6, "tau": 0.05, "d": 0.05, "c": 0.01, "a_p": 30.0, "a_q": 30.0, "a_r": 3.0}
_FLOOR = np.array([0.01, 0.01, 1e-3, 0.02, 2e-4, 2e-3, 5e-4, *[2e-3] * 3, *[0.2] * 3, *[0.02] * 5, 0.01, *[2e-3] * 3])
"""Least standard deviation of the parameters between flights."""


@dataclass(frozen=True)
class RotorBaseline:
    """Calibrated rotor model.

    Attributes:
        motors: number of motors
        parameters: mean, (22,); spread: covariance between flights, (22, 22)
        filters: noise of the channels, see `ResidualNoise`
        chance: by group of effects, largest gain on nominal flights that are left out over that of noise, at least 1
        sizes: by group, standard deviation of its values on them beyond the error of their estimates, with that of the
            parameters which it changes
        excess: scale of the whitened residuals over 20 s that one nominal flight in a hundred exceeds in any channel,
            (13,), from those of the nominal flights that are left out
        explained: share of the variance of f_x f_y f_z p_dot q_dot r_dot that the model explains
        flights: names
    """

    motors: int
    parameters: np.ndarray
    spread: np.ndarray
    filters: np.ndarray
    chance: dict[str, float]
    sizes: dict[str, float]
    excess: np.ndarray
    explained: dict[str, float]
    flights: tuple[str, ...]

    @property
    def temper(self) -> float:
        """Return the rows per independent sample, as the median of the chance gains shows."""
        return max(float(np.median(list(self.chance.values()))), 1.0) if self.chance else 1.0

    @property
    def noise(self) -> ResidualNoise:
        """Return the noise of the channels."""
        return ResidualNoise(self.filters)


def calibrate_rotors(flights: Sequence[RotorFlight], log: Callable[[str], None], gains: NominalGains) -> RotorBaseline:
    """Fit the rotor model to nominal flights, each with its own wind and biases.

    Args:
        flights: nominal flights of one aircraft
        log: receives progress
        gains: (flight, baseline) to gains and sizes of the effects and scales by block, `search.nominal_gains`
    Raises:
        ValueError: if there is no flight.
    """
    if not flights:
        raise ValueError("found no flight of a multirotor, expected nominal flights; name their recordings")
    parameters = np.array([_START.get(name, 0.0) for name in PARAMETERS])
    noise: ResidualNoise | None = None
    starts: list[FlightFit | None] = [None] * len(flights)
    for k in range(_PASSES):
        log(f"rotor model: pass {k + 1} of {_PASSES} over {len(flights)} flights")
        solutions = []
        for i, flight in enumerate(flights):
            linear = LinearFlight(flight, noise, None if noise else _FIRST_STD)
            start = starts[i] or linear.start(parameters)
            solutions.append((linear, solve(linear, start.parameters, None, start, iterations=8 if k == 0 else 3)))
        parameters, information = pooled(solutions)
        noise = ResidualNoise(_filters([(linear, one.base) for linear, one in solutions]))
        starts = [one.fit for _, one in solutions]
    assert noise is not None
    first = RotorBaseline(
        motors=flights[0].inputs.shape[1],
        parameters=parameters,
        spread=between_flights(parameters, information, [one for _, one in solutions]),
        filters=noise.filters,
        chance={},
        sizes={},
        excess=np.ones(len(CHANNELS)),
        explained=_explained(solutions),
        flights=tuple(flight.name for flight in flights),
    )
    return _with_chance(first, flights, solutions, gains)


def _with_chance(
    first: RotorBaseline,
    flights: Sequence[RotorFlight],
    solutions: Sequence[tuple[LinearFlight, FlightSolution]],
    gains: NominalGains,
) -> RotorBaseline:
    """Return the baseline with what nominal flights show that are left out."""
    searched, blocks = [], []
    for i, flight in enumerate(flights):
        others = [pair for j, pair in enumerate(solutions) if j != i] or solutions
        mean, information = pooled(others)
        spread = between_flights(mean, information, [one for _, one in others])
        by_effect, sizes, scales = gains(flight, replace(first, parameters=mean, spread=spread))
        searched.append((by_effect, sizes))
        blocks.append(scales)
    names = sorted({name for by_effect, _ in searched for name in by_effect})
    chance = {name: max(1.0, *(by_effect.get(name, 1.0) for by_effect, _ in searched)) for name in names}
    baseline = replace(first, chance=chance, excess=block_limits(blocks))
    means, least = {}, _least_sizes(first)
    for name in chance:
        squares = [
            sizes.get(name, 0.0) ** 2 * max(1.0 - baseline.temper / max(by_effect.get(name, 0.0), 1e-9), 0.0)
            for by_effect, sizes in searched
        ]
        means[name] = float(np.mean(squares)) ** 0.5
        means[name] = float(np.hypot(means[name], least.get(name.split(":")[0], 0.0)))
    return replace(baseline, sizes=means)


def _least_sizes(baseline: RotorBaseline) -> dict[str, float]:
    """Return the standard deviation between flights of the parameters that an effect changes, in its coordinates."""
    p = dict(zip(PARAMETERS, baseline.parameters.tolist(), strict=True))
    std = dict(zip(PARAMETERS, np.sqrt(np.diag(baseline.spread)).tolist(), strict=True))
    k, c = std["k"] / p["k"], std["c"] / max(abs(p["c"]), 1e-6)
    return {
        "motor_thrust_loss": float(np.linalg.norm([std["m_p"], std["m_q"], std["m_r"]])),
        "cg_shift": float(np.hypot(std["x_c"], std["y_c"])),
        "thrust_loss": k,
        "mass_change": k,
        "motor_lag": std["tau"],
        "drag_increase": c,
    }


def block_limits(blocks: Sequence[np.ndarray]) -> np.ndarray:
    """Return the scale of each channel that a block of another nominal flight exceeds by chance, (13,).

    Logarithms of scales are normal with one variance within each channel, and one between flights for the channels of
    one kind, as gusts act on forces and less on the others. The limit is that of the predictive distribution. A channel
    that is absent has none.

    Args:
        blocks: scales of the blocks of each nominal flight, (b, 13), nan where a block has no rows
    Source: Satterthwaite 1946 (degrees of freedom of a sum of variances)
    """
    logs = [np.log(np.maximum(x[np.isfinite(x).all(axis=1)], 1e-3)) for x in blocks]
    logs = [x for x in logs if len(x) > 1]
    channels = np.array([np.concatenate([x[:, c] for x in logs] or [np.zeros(1)]) for c in range(len(CHANNELS))])
    present = channels.std(axis=1) > 0
    if not present.any():
        return np.full(len(CHANNELS), _NO_LIMIT)
    n, flights = channels.shape[1], len(logs)
    within = np.sum([((x - x.mean(axis=0)) ** 2).sum(axis=0) for x in logs], axis=0) / (n - flights)
    of_channels = np.var([x.mean(axis=0) for x in logs], axis=0) * flights / max(flights - 1, 1)
    added, others = np.empty(len(CHANNELS)), np.empty(len(CHANNELS))
    for group in _ALIKE:
        used = present[group]
        added[group] = (of_channels[group][used].mean() if used.any() else 0.0) * (1 + 1 / flights)
        others[group] = max(flights - 1, 1) * max(int(used.sum()), 1)
    freedom = (within + added) ** 2 / np.maximum(within**2 / (n - flights) + added**2 / others, 1e-12)
    quantile = student_t.ppf(1 - _FALSE_ALARM * flights / (n * present.sum()), np.maximum(freedom, 1.0))
    limits = np.exp(channels.mean(axis=1) + quantile * np.sqrt(within + added))
    return np.where(present, np.minimum(limits, _NO_LIMIT), _NO_LIMIT)


_FIRST_STD = np.array([0.15, 0.15, 0.25, 0.5, 0.5, 0.2, 0.15, 0.15, 0.15, 0.02, 0.02, 0.02, 1.0])
"""Rough noise of the channels for the first pass."""


def pooled(solutions: Sequence[tuple[LinearFlight, FlightSolution]]) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return the mean of the parameters weighted by information, and the information of each flight."""
    n = len(PARAMETERS)
    information, total, weighted = [], 1e-8 * np.eye(n), np.zeros(n)
    for _, one in solutions:
        A = one.columns.reshape(-1, one.columns.shape[2])
        H = A.T @ A + one.precision
        info = H[:n, :n] - H[:n, n:] @ np.linalg.solve(H[n:, n:], H[n:, :n])
        information.append(info)
        total = total + info
        weighted = weighted + info @ one.fit.parameters
    return np.linalg.solve(total, weighted), information


def between_flights(
    mean: np.ndarray, information: Sequence[np.ndarray], solutions: Sequence[FlightSolution]
) -> np.ndarray:
    """Return the covariance of the parameters of another flight: spread beyond their own uncertainty, and of the mean.

    The spread has the shape of that uncertainty; its size is that of the mean square of the deviations.
    """
    n = len(solutions)
    mean_covariance = np.linalg.inv(np.sum(information, axis=0))
    own = np.mean([np.linalg.inv(info) for info in information], axis=0)
    squares = [float(d @ info @ d) / len(d) for d, info in _deviations(mean, information, solutions)]
    excess = max(float(np.mean(squares)) * n / max(n - 1, 1) - 1.0, 0.0)
    return np.asarray(np.diag(_FLOOR**2) + excess * own + mean_covariance)


def _deviations(
    mean: np.ndarray, information: Sequence[np.ndarray], solutions: Sequence[FlightSolution]
) -> list[tuple[np.ndarray, np.ndarray]]:
    return [(one.fit.parameters - mean, info) for one, info in zip(solutions, information, strict=True)]


def _filters(residuals: Sequence[tuple[LinearFlight, np.ndarray]]) -> np.ndarray:
    rows = []
    for c in range(len(CHANNELS)):
        series = [base[linear.ok, c] - base[linear.ok, c].mean() for linear, base in residuals]
        if np.ptp(series[0]) == 0:
            rows.append(np.eye(ORDER + 1)[0])
            continue
        taps = autoregression(np.concatenate(series))
        white = np.concatenate([lfilter(taps, [1.0], x)[ORDER:] for x in series])
        rows.append(taps / max(float(np.median(np.abs(white))) / 0.6745, 0.1))
    return np.array(rows)


def _explained(solutions: Sequence[tuple[LinearFlight, FlightSolution]]) -> dict[str, float]:
    out = {}
    left, total = np.zeros(6), np.zeros(6)
    for linear, one in solutions:
        nothing = residuals(linear.flight, np.zeros(len(PARAMETERS)), np.zeros((len(linear.flight.t), 2)), {})
        rows = linear.ok
        left += one.base[rows, :6].var(axis=0) * rows.sum()
        total += nothing[rows, :6].var(axis=0) * rows.sum()
    for c in range(6):
        out[CHANNELS[c]] = float(1 - left[c] / total[c])
    return out


def save_rotors(path: Path, baseline: RotorBaseline) -> None:
    """Write the model file."""
    values = msgspec.to_builtins(baseline, enc_hook=lambda x: x.tolist())
    path.write_text(json.dumps({"format": FORMAT, **values}, indent=1) + "\n")


def load_rotors(path: Path, document: dict[str, Any]) -> RotorBaseline:
    """Read a model from the values of its file.

    Raises:
        ValueError: if it is no valid model; the message names the fault.
    """
    try:
        baseline = msgspec.convert(document, RotorBaseline, dec_hook=lambda _, x: np.array(x, float))
        n, c = len(PARAMETERS), len(CHANNELS)
        for array, shape in (
            *((baseline.parameters, (n,)), (baseline.spread, (n, n))),
            *((baseline.filters, (c, ORDER + 1)), (baseline.excess, (c,))),
        ):
            if array.shape != shape or not np.isfinite(array).all():
                raise ValueError(f"shape {array.shape} or non-finite numbers, expected finite numbers of shape {shape}")
    except (KeyError, TypeError, ValueError, msgspec.ValidationError) as error:
        raise ValueError(
            f"{path.name}: found {error!r}, expected a complete model; make it with `fleet calibrate`"
        ) from None
    return baseline
