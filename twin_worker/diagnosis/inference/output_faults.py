"""Find outputs that no longer answer the controller: a pulse that is constant while the control errors change.

A logged output is the answer of the autopilot to its control errors. In trusted flight a regression on these errors
predicts each output, and a logistic regression the probability that an output repeats its last pulse, from

    whether it repeated before, the change of the predicted output, and its distance from the predicted output.

A frozen output repeats always. The log likelihood ratio of a run of repeats is -sum log P(repeat | healthy), less the
logarithm of the number of possible pulses, plus once the distance from the predicted output under a Student
distribution whose scale is the law's error in trusted flight or in the seconds before the run, whichever is larger.
The other predictors are limited to the range of trusted flight: no evidence is extrapolated. An output at a limit is
saturated, which is no evidence, where its control error points there or where the law had failed before: the limit is
within the law's error of the last seconds.

The level of a throttle output is arbitrary, since it contains the integral of the energy error. Its law is the
regression of its change over `_LAG_S` on the change of energy error, climb rate, pitch demand, load and speed error; it
predicts a run from the output before the run. The error of that prediction grows as a random walk. A throttle output
at a limit is saturated where the prediction is within three such errors of the limit, or beyond it; one that the
prediction does not bring there is cut.
Source: Agresti 2013, Categorical Data Analysis, chapter 5; Lambregts 1983 (total energy control).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize

from fleet.airframes.airframe import ServoMap
from fleet.effects import SURFACES, Onset, catalogue
from twin_worker.diagnosis.data.card import FaultHypothesis, OnsetProfile
from twin_worker.diagnosis.data.outputs import ServoOutputs
from twin_worker.diagnosis.inference.report import (
    OUTPUT_CHANNEL,
    DiagnosisFinding,
    Report,
    ReportOutcome,
    with_sentence,
)

PRIOR = 1e-3  # probability that an output of a flight freezes [-]
POSTERIOR = 0.95  # least probability of a reported fault [-]
MIN_R2 = 0.5  # share of an output's variance that the control errors must explain in trusted flight [-]
_MIN_ROWS = 60
_MIN_RANGE_US = 10.0  # an output that moves less is not in use [us]
_PULSE_RANGE_US = 1000.0
_RIDGE = 0.01
_RECENT_S = 2.0  # before a run of repeats, for the law's present error [s]
_SATURATED_SIGMAS = 3.0  # a limit within so many present errors of the predicted output may be demanded [-]
_NU = 4.0  # degrees of freedom of the distance from the predicted output: heavy tails
_LAG_S = 2.0  # over which the law of the throttle predicts changes [s]
_MEDIAN_SIGMAS = 0.6745  # median of the absolute value of a standard normal variable [-]
_PRIOR_MEAN, _PRIOR_STD = np.array([-1.0, 1.0, -0.5, -1.0]), np.array([2.0, 1.0, 1.0, 1.0])
_AXIS = {"aileron": 0, "elevator": 1, "rudder": 0, "throttle": 2}
_NAMES = (*SURFACES, "throttle")


@dataclass(frozen=True)
class FrozenOutput:
    """One output that no longer answers the controller.

    Attributes:
        number: of the output, from 1
        surface: that it moves: aileron, elevator, rudder or throttle
        pulse: [us]; position: of full deflection, or of full throttle [-]
        since, until: [s]
        evidence: log likelihood ratio [-]
        error_before: rms of the output less its prediction, over that of trusted flight [-]
        excess: median of the output less its prediction [us]
    """

    number: int
    surface: str
    pulse: float
    position: float
    since: float
    until: float
    evidence: float
    error_before: float
    excess: float

    @property
    def is_runaway(self) -> bool:
        """Return whether this is a throttle output above what its law demands: no thrust is lost."""
        return self.surface == "throttle" and self.excess > 0.0


def find_frozen_outputs(outputs: ServoOutputs, trusted_until: float) -> list[FrozenOutput]:
    """Return the frozen outputs after the trusted part of a flight, earliest first.

    Args:
        outputs: of the flight
        trusted_until: end of the trusted part [s]
    """
    trusted = outputs.flying & (outputs.t < trusted_until)
    if trusted.sum() < _MIN_ROWS:
        return []
    used_map = outputs.servo_map(trusted)
    n_hypotheses = outputs.pulses.shape[1] * int((outputs.flying & ~trusted).sum())
    least = np.log(max(n_hypotheses, 1) / PRIOR) + np.log(POSTERIOR / (1.0 - POSTERIOR))
    detected = []
    used = _used_outputs(outputs, used_map, trusted)
    ailerons = [k for k, surface in used if surface == "aileron"]
    for k, surface in used:
        kind = _ModelledThrottle if surface == "throttle" else _ModelledOutput
        frozen = kind(outputs, k, surface, trusted, ailerons).longest_run(trusted_until)
        if frozen is not None and frozen.evidence > least:
            detected.append(replace(frozen, position=_position(used_map, k, frozen)))
    return sorted(detected, key=lambda one: one.since)


def _used_outputs(outputs: ServoOutputs, used_map: ServoMap, trusted: np.ndarray) -> list[tuple[int, str]]:
    """Return index and surface of every output that moves in trusted flight."""
    used = []
    for k in np.flatnonzero(np.ptp(outputs.pulses[trusted], axis=0) >= _MIN_RANGE_US):
        gain = np.abs(used_map.gain_up[k]) + np.abs(used_map.gain_down[k])
        if gain.any() and (outputs.pulses[trusted, k] > 0).mean() > 0.9:
            used.append((int(k), _NAMES[int(np.argmax(gain))]))
    return used


def _position(used_map: ServoMap, k: int, frozen: FrozenOutput) -> float:
    """Return the position that the pulse commands, as a share of full deflection or throttle."""
    offset = frozen.pulse - used_map.trim[k]
    gain = (used_map.gain_up if offset > 0 else used_map.gain_down)[k]
    column = _NAMES.index(frozen.surface)
    share = np.sum(np.abs(used_map.gain_up[:, column]) > 0)  # outputs that move this surface together
    return float(np.clip(offset * gain[column] * max(share, 1), 0.0 if frozen.surface == "throttle" else -1.0, 1.0))


class _ModelledOutput:
    """One output with its law and its probability of repetition, fitted to trusted flight."""

    def __init__(
        self, outputs: ServoOutputs, k: int, surface: str, trusted: np.ndarray, ailerons: Sequence[int] = ()
    ) -> None:
        self._outputs, self._k, self._surface = outputs, k, surface
        self._y = y = outputs.pulses[:, k]
        axis = _AXIS[surface]
        x = outputs.signals[axis]
        if surface == "rudder":  # mixed with the ailerons
            x = np.column_stack([x, *(outputs.pulses[:, n] for n in ailerons)])
        steps = np.abs(np.diff(y[trusted]))
        self._step = float(steps[steps > 0].min())
        self._low, self._high = float(y[trusted].min()), float(y[trusted].max())
        self._at_limit = (y <= self._low) | (y >= self._high)
        self._repeats = np.concatenate([[False], np.diff(y) == 0])
        self._error = outputs.errors[:, axis] * np.sign(np.corrcoef(outputs.errors[trusted, axis], y[trusted])[0, 1])
        x = (x - x[trusted].mean(axis=0)) / (x[trusted].std(axis=0) + 1e-9)
        self._predicted, self._scale, self.r2 = self._fit_law(x, trusted)
        self._surprise = self._fit_surprise(trusted)

    def _fit_law(self, x: np.ndarray, trusted: np.ndarray) -> tuple[np.ndarray, float, float]:
        """Return the predicted output, (n,) [us], the rms of its error [us] and the explained share of variance."""
        mean = self._y[trusted].mean()
        predicted = mean + x @ _ridge_regression(x[trusted], self._y[trusted] - mean)
        scale = max(float(np.sqrt(np.mean((self._y - predicted)[trusted] ** 2))), 1.0)
        return predicted, scale, 1.0 - scale**2 / float(self._y[trusted].var())

    def _fit_surprise(self, trusted: np.ndarray) -> np.ndarray:
        """Return -log P(repeat | healthy) of every row, zero where the output is saturated, (n,)."""
        y = self._y
        self._expected = expected = self._within_limits()
        change = np.log1p(np.abs(np.diff(expected, prepend=expected[0])) / self._step)
        rows = trusted & ~self._at_limit
        rows[:2] = False
        repeated_before = np.concatenate([[False], self._repeats[:-1]])
        limited = [np.minimum(x, x[trusted].max()) for x in (change, self._log_distance())]
        X = np.column_stack([np.ones(len(y)), repeated_before, *limited])
        repeats = self._repeats[rows]

        def cost(b: np.ndarray) -> tuple[float, np.ndarray]:
            z, offset = X[rows] @ b, (b - _PRIOR_MEAN) / _PRIOR_STD
            value = np.logaddexp(0.0, z).sum() - z[repeats].sum() + 0.5 * offset @ offset
            return float(value), X[rows].T @ (1.0 / (1.0 + np.exp(-z)) - repeats) + offset / _PRIOR_STD

        b = minimize(cost, _PRIOR_MEAN, jac=True).x
        return np.where(self._saturated(), 0.0, np.logaddexp(0.0, -(X @ b)))

    def _within_limits(self) -> np.ndarray:
        y = self._y
        return np.clip(self._predicted, np.minimum(self._low, y), np.maximum(self._high, y))

    def _log_distance(self) -> np.ndarray:
        return np.log1p(np.abs(self._y - self._expected) / self._scale)

    def _saturated(self) -> np.ndarray:
        """Return the rows at a limit to which the control error points, (n,) bool."""
        return self._at_limit & (np.where(self._y >= self._high, 1.0, -1.0) * self._error > 0.0)

    def longest_run(self, trusted_until: float) -> FrozenOutput | None:
        """Return the run of repeats with the most evidence; None where the law does not explain the output."""
        if self.r2 < MIN_R2:
            return None
        outputs = self._outputs
        in_run = self._repeats & outputs.flying & (outputs.t > trusted_until)
        edges = np.flatnonzero(np.diff(np.concatenate([[False], in_run, [False]]).astype(int)))
        runs = [(self._evidence(a, b), a - 1, b) for a, b in zip(edges[::2], edges[1::2], strict=True)]
        return self._frozen(*max(runs)) if runs else None

    def _recent(self, first: int) -> slice:
        """Return the rows of the seconds before a run whose first repeat is row `first`."""
        t = self._outputs.t
        return slice(int(np.searchsorted(t, t[first - 1] - _RECENT_S)), first - 1)

    def _evidence(self, first: int, end: int) -> float:
        """Return the log likelihood ratio of a run of repeats: each repeat, the pulse, and once its distance."""
        error = np.abs(self._y - self._expected)
        recent = error[self._recent(first)]
        present = float(np.sqrt(np.mean(recent**2))) if len(recent) else 0.0
        distance = float(np.median(error[first:end])) / max(self._scale, present)
        if self._at_limit[first] and present > self._scale and distance < _SATURATED_SIGMAS:
            return 0.0
        repeats = float(self._surprise[first:end].sum())
        return self._log_ratio(repeats, distance if repeats else 0.0)

    def _log_ratio(self, repeats: float, distance: float) -> float:
        level = 0.5 * (_NU + 1.0) * np.log1p(distance**2 / _NU)
        return repeats + float(level - np.log(_PULSE_RANGE_US / self._step))

    def _misfit(self, first: int, end: int) -> np.ndarray:
        """Return output less prediction in a run, (end - first,) [us]."""
        return (self._y - self._predicted)[first:end]

    def _frozen(self, evidence: float, first: int, end: int) -> FrozenOutput:
        t, y = self._outputs.t, self._y
        misfit = self._misfit(first + 1, end)
        relative = float(np.sqrt(np.mean(misfit**2))) / self._scale
        since, until, pulse = float(t[first]), float(t[min(end - 1, len(t) - 1)]), float(y[min(end - 1, len(t) - 1)])
        excess = float(np.median(misfit))
        return FrozenOutput(self._k + 1, self._surface, pulse, 0.0, since, until, evidence, relative, excess)


class _ModelledThrottle(_ModelledOutput):
    """Throttle output: its law predicts changes, since its level contains the integral of the energy error."""

    def _fit_law(self, x: np.ndarray, trusted: np.ndarray) -> tuple[np.ndarray, float, float]:
        t, y = self._outputs.t, self._y
        later = np.searchsorted(t, t + _LAG_S)
        start = np.flatnonzero(later < len(t))
        end = later[start]
        free = trusted & ~self._at_limit
        used = free[start] & free[end]
        start, end = start[used], end[used]
        dx, dy = x[end] - x[start], y[end] - y[start]
        self._x, self._covariance = x, np.eye(x.shape[1])
        if len(start) < _MIN_ROWS // 2:
            return np.full(len(t), float(y[trusted].mean())), 1.0, 0.0
        size = dx.std(axis=0) + 1e-9
        b = _ridge_regression(dx / size, dy) / size
        overlap = _LAG_S / float(np.median(np.diff(t)))  # changes that share their time are not independent
        gram = dx.T @ dx / overlap + _RIDGE * len(dx) * np.diag(size**2) / overlap
        self._covariance = np.linalg.inv(gram)
        scale = max(float(np.sqrt(np.mean((dy - dx @ b) ** 2))), 1.0)
        return x @ b, scale, 1.0 - scale**2 / max(float(np.mean(dy**2)), 1e-9)

    def _within_limits(self) -> np.ndarray:
        return self._predicted

    def _log_distance(self) -> np.ndarray:
        return np.zeros(len(self._y))

    def _saturated(self) -> np.ndarray:
        return np.zeros(len(self._y), bool)  # depends on the run

    def _misfit(self, first: int, end: int) -> np.ndarray:
        recent = self._recent(first)
        if recent.stop <= recent.start:
            return np.zeros(end - first)
        offset = float(np.median((self._y - self._predicted)[recent]))
        return (self._y - self._predicted)[first:end] - offset

    def _evidence(self, first: int, end: int) -> float:
        """Return the log likelihood ratio of a run, from its prediction by the output before it.

        The variance of the prediction is that of the regression coefficients, and that of the law's error, as large as
        in trusted flight or, by the medians of its scatter and of its change over `_LAG_S`, in the seconds before the
        run, growing as of a random walk.
        """
        recent, t = self._recent(first), self._outputs.t
        if recent.stop - recent.start < 2:
            return 0.0
        error = self._y - self._predicted
        earlier = np.searchsorted(t, t[recent] - _LAG_S)
        deviations = error[recent] - np.median(error[recent]), error[recent] - error[earlier]
        scale = max(self._scale, *(float(np.median(np.abs(x))) / _MEDIAN_SIGMAS for x in deviations))
        change = self._x[first:end] - self._x[recent].mean(axis=0)
        growth = np.maximum(t[first:end] - t[first - 1], _LAG_S) / _LAG_S
        sigmas = self._misfit(first, end) / (
            scale * np.sqrt(growth + np.einsum("ij,jk,ik->i", change, self._covariance, change))
        )
        surprise = self._surprise[first:end]
        if self._at_limit[first]:
            inside = sigmas if self._y[first] >= self._high else -sigmas  # prediction inside the limit: positive
            surprise = np.where(inside > _SATURATED_SIGMAS, surprise, 0.0)
        repeats = float(surprise.sum())
        return self._log_ratio(repeats, float(np.median(np.abs(sigmas))) if repeats else 0.0)


def _ridge_regression(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.asarray(np.linalg.solve(x.T @ x + _RIDGE * len(x) * np.eye(x.shape[1]), x.T @ y))


def with_frozen_outputs(report: Report, frozen: list[FrozenOutput]) -> Report:
    """Return the report with the frozen outputs as its first findings.

    Effects on the airframe remain where they began before: afterwards the flight leaves what was calibrated. No effect
    stands for a throttle output above its demand: alone, it makes the outcome `unknown`.
    """
    if not frozen:
        return report
    if all(one.is_runaway for one in frozen):
        where = (f"throttle output {frozen[0].number}", tuple((one.since, one.until) for one in frozen))
        return with_sentence(replace(report, outcome=ReportOutcome.UNKNOWN, where=where, terms={}))
    frozen = [one for one in frozen if not one.is_runaway]
    first = frozen[0].since
    earlier = tuple(
        f for f in report.findings if report.outcome is ReportOutcome.NAMED and f.segments[0][0] < first - 5.0
    )
    findings = tuple(map(_finding, frozen))
    misfit = float(np.sqrt(np.mean([one.error_before**2 for one in frozen])))
    return with_sentence(
        replace(
            report,
            outcome=ReportOutcome.NAMED,
            findings=(*findings, *earlier),
            where=("", ()),
            terms={},
            fit_before=misfit,
            fit_after=0.0,
        )
    )


def _finding(frozen: FrozenOutput) -> DiagnosisFinding:
    onset = OnsetProfile(Onset.STEP, frozen.since)
    if frozen.surface == "throttle":
        hypothesis = FaultHypothesis(catalogue()["thrust_loss"], "", (1.0 - frozen.position,), onset)
    else:
        hypothesis = FaultHypothesis(catalogue()["actuator_stuck"], frozen.surface, (1.0, frozen.position), onset)
    return DiagnosisFinding(
        hypothesis=hypothesis,
        gain=2.0 * frozen.evidence,
        reported={"output": float(frozen.number), "pulse_us": frozen.pulse, "position": frozen.position},
        sigma={"output": 0.0, "pulse_us": 0.0, "position": 0.0},
        parameter_sigma=(0.0,) * len(hypothesis.par),
        rivals=(),
        manoeuvres=(),
        channel=OUTPUT_CHANNEL,
        surface=frozen.surface,
        segments=((frozen.since, frozen.until),),
        held_out_share=1.0,
    )
