"""How far a prediction may be trusted: a tube and a horizon from this aircraft's own past predictions.

Scores of past predictions, |error| over an expected spread, give by their conformal quantile the factor that
would have held the wanted share. The horizon is the time the same share of past predictions stayed within 10 %.
Before there are any, a wide prior stands in for them.

Source: Angelopoulos & Bates 2023, "Conformal prediction: a gentle introduction", section 2 (split conformal,
locally scaled scores). M1, the relative error: |p_hat - p| / max(path flown, 2 s of ground speed).
"""

from collections import deque
from dataclasses import dataclass, field

import numpy as np

AHEAD = np.arange(0.0, 61.0)  # look-ahead grid of every prediction [s]
LIMIT = 0.10  # relative error at which trust ends [-]
QUANTILE = 0.9
_FLOOR_S = 2.0  # least path length, as seconds of ground speed [s]
_PRIOR = {  # expected spread of along, cross, vertical: base [m], growth [m/s^power], power
    **{m: (np.array([1.0, 0.8, 0.6]), np.array([0.4, 0.15, 0.15]), 1.2) for m in ("dynamics", "hybrid", "both")},
    "paper": (np.array([1.0, 0.8, 0.6]), np.array([0.5, 0.2, 0.2]), 1.3),
    "copter": (np.array([1.0, 0.8, 0.6]), np.array([0.3, 0.1, 0.1]), 1.1),
    "greybox": (np.array([1.5, 1.0, 1.0]), np.array([0.5, 0.3, 0.2]), 1.3),
    "imm": (np.array([2.0, 2.0, 1.0]), np.array([1.6, 1.6, 0.5]), 1.4),
}
_PRIOR_PASSAGES = {  # stand in for past times to 10 %; drawn from 541 (copter 190, greybox 260) predictions [s]
    **dict.fromkeys(("dynamics", "hybrid", "both"), (8.0, 30.0, 60.0)),
    "paper": (8.0, 30.0, 60.0),
    "copter": (1.0, 30.0, 60.0),
    "greybox": (8.0, 60.0, 60.0),
    "imm": (1.0, 2.0, 5.0),
}
_PRIOR_WEIGHT = 6.0  # past predictions the prior counts as [-]
_PRIOR_SCORE, _PRIOR_SCORES = 2.5, 3  # its 90 % factor, and how many past predictions say so [-]
_KEEP = 60  # past predictions remembered per method [-]
EVERY_S = 5.0  # a prediction is kept for scoring this often [s]


@dataclass
class Made:
    """A prediction waiting for the flight to answer it."""

    t: float
    method: str
    path: np.ndarray  # NED, (61, 3) [m]
    tube: np.ndarray  # half-axes, (61, 3) [m]
    speed: float  # over ground at t, climb included [m/s]


def track_frame(path: np.ndarray) -> np.ndarray:
    """Give the horizontal unit vector along the path at each point, (n, 2); north where it stands still."""
    step = np.gradient(path[:, :2], axis=0)
    length = np.linalg.norm(step, axis=1, keepdims=True)
    return np.divide(step, length, out=np.tile([1.0, 0.0], (len(path), 1)), where=length > 1e-6)


def axes_error(path: np.ndarray, flown: np.ndarray) -> np.ndarray:
    """Split errors into along, cross, vertical and distance, (n, 4) [m]."""
    e = flown - path
    along = track_frame(path)
    cross = np.column_stack([-along[:, 1], along[:, 0]])
    parts = [np.sum(e[:, :2] * along, axis=1), np.sum(e[:, :2] * cross, axis=1), e[:, 2], np.linalg.norm(e, axis=1)]
    return np.abs(np.column_stack(parts))


def path_length(path: np.ndarray, speed: float) -> np.ndarray:
    """Give the path length so far, at least two seconds of ground speed, (n,) [m]."""
    flown = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    return np.maximum(flown, max(_FLOOR_S * speed, 1.0))


def first_passage(relative: np.ndarray, ahead: np.ndarray = AHEAD) -> tuple[float, bool]:
    """Give the time the relative error first passes 10 % [s], and whether it never did (censored at the end)."""
    over = np.flatnonzero(relative > LIMIT)
    if not len(over):
        return float(ahead[-1]), True
    k = int(over[0])
    if k == 0:
        return 0.0, False
    share = (LIMIT - relative[k - 1]) / (relative[k] - relative[k - 1])
    return float(ahead[k - 1] + share * (ahead[k] - ahead[k - 1])), False


@dataclass
class Record:
    """Past predictions of one aircraft and what came of them."""

    waiting: list[Made] = field(default_factory=list)
    errors: dict[str, deque[np.ndarray]] = field(default_factory=dict)  # along, cross, vertical, (61, 3) [m]
    passages: dict[str, deque[tuple[float, bool]]] = field(default_factory=dict)  # time to 10 % [s], censored
    scored: dict[str, int] = field(default_factory=dict)  # predictions answered so far, by method
    inside: deque[float] = field(default_factory=lambda: deque(maxlen=_KEEP))

    def keep(self, made: Made) -> None:
        """Remember a prediction for scoring, at most one every few seconds."""
        if not self.waiting or made.t - self.waiting[-1].t >= EVERY_S:
            self.waiting.append(made)

    def forget(self) -> None:
        """Drop predictions that an event (mode, mission, clock) has made meaningless."""
        self.waiting.clear()

    def answer(self, t: np.ndarray, flown: np.ndarray) -> int:
        """Score every waiting prediction whose 60 s have been flown.

        Args:
            t: times of the flown path, rising, (n,) [s since 1970]
            flown: positions in the twin's NED frame, (n, 3) [m]
        Returns:
            how many were scored
        """
        ready = [made for made in self.waiting if len(t) and made.t + AHEAD[-1] <= t[-1]]
        self.waiting = [made for made in self.waiting if made not in ready]
        scored = 0
        for made in ready:
            at = made.t + AHEAD
            near = np.abs(t[np.clip(np.searchsorted(t, at), 0, len(t) - 1)] - at)
            if made.t < t[0] or near.max() > 2.0:
                continue  # the flight has a hole there: no answer rather than an invented one
            self._score(made, np.column_stack([np.interp(at, t, column) for column in flown.T]))
            scored += 1
        return scored

    def _score(self, made: Made, flown: np.ndarray) -> None:
        error = axes_error(made.path, flown)
        self.inside.append(float((error[1:, :3] <= made.tube[1:]).all(axis=1).mean()))
        passage = first_passage(error[:, 3] / path_length(flown, made.speed))
        self.scored[made.method] = self.scored.get(made.method, 0) + 1
        self.passages.setdefault(made.method, deque(maxlen=_KEEP)).append(passage)
        self.errors.setdefault(made.method, deque(maxlen=_KEEP)).append(error[:, :3])

    def spread(self, method: str, ahead: np.ndarray = AHEAD) -> np.ndarray:
        """Give the expected error by look-ahead: the prior, outweighed by what was measured, (n, 3) [m]."""
        base, growth, power = _PRIOR[method]
        prior = np.hypot(base, growth * ahead[:, None] ** power)
        found = self.errors.get(method)
        if not found:
            return prior
        measured = np.mean(np.square(found), axis=0)
        total = (_PRIOR_WEIGHT * prior[: len(measured)] ** 2 + len(found) * measured) / (_PRIOR_WEIGHT + len(found))
        spread = np.sqrt(total)
        if len(ahead) > len(spread):  # beyond what was ever scored: go on growing as the prior does
            spread = np.vstack([spread, prior[len(spread) :] * spread[-1] / prior[len(measured) - 1]])
        return spread

    def factor(self, method: str) -> float:
        """Give the factor on the spread that holds 90 % jointly on the three axes [-]."""
        spread = self.spread(method)[1:]
        scores = [float(np.quantile((e[1:] / spread).max(axis=1), QUANTILE)) for e in self.errors.get(method, ())]
        ranked = sorted(scores + [_PRIOR_SCORE] * _PRIOR_SCORES)
        return ranked[min(int(np.ceil((len(ranked) + 1) * QUANTILE)), len(ranked)) - 1]

    def tube(self, method: str, ahead: np.ndarray = AHEAD) -> np.ndarray:
        """Give the half-axes along, cross, vertical by look-ahead, never shrinking, (n, 3) [m]."""
        return np.maximum.accumulate(self.factor(method) * self.spread(method, ahead))

    def horizon(self, method: str) -> tuple[float, bool]:
        """Give the time 90 % of past predictions stayed within 10 % [s], and whether that is the end of the look-ahead.

        The lower conformal quantile of first passages, rank floor((n + 1) 0.1), at least the smallest.
        """
        ranked = sorted([passage[0] for passage in self.passages.get(method, ())] + [*_PRIOR_PASSAGES[method]])
        time = ranked[max(int((len(ranked) + 1) * (1 - QUANTILE) + 1e-9), 1) - 1]
        return float(time), bool(time >= AHEAD[-1])

    @property
    def held(self) -> tuple[float, int]:
        """Give the measured share inside the tube so far (nan before any) and the predictions behind it."""
        inside = tuple(self.inside)  # at once: another thread may read while this one scores
        return (float(np.mean(inside)) if inside else float("nan")), len(inside)

    def t10(self, method: str) -> tuple[float | None, float | None, int]:
        """Give the median first passage of 10 % [s], the share censored, and how many predictions that is."""
        found = tuple(self.passages.get(method, ()))
        if not found:
            return None, None, 0
        times, censored = zip(*found, strict=True)
        return float(np.median(times)), float(np.mean(censored)), len(times)
