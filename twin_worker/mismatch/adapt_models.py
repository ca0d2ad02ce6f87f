"""Adapt the twin's models to diagnosed effects: restart before the onset, add the effects, identify on the newer data.

No data count twice: of the flight before the onset only the checkpoint is used, with the effects added. Models
identified on the data since then include the effects.
"""

from copy import copy, deepcopy
from dataclasses import dataclass, replace

import msgspec
import numpy as np

from fleet.contract import Outcome
from fleet.physics.wrench import NAMES, WIND, L, M, N, X, Y, Z, terms
from fleet.window import Window
from twin_worker.estimation.wind_filter import WindFilter, blow
from twin_worker.identification.fixed_wing.derivatives_model import Coupled
from twin_worker.identification.fixed_wing.point_mass_with_effects import Added
from twin_worker.identification.fixed_wing.point_mass_with_effects import extended as extended_hybrid
from twin_worker.mismatch.effect_increments import Push
from twin_worker.numerics.ridge_regression import ridge
from twin_worker.prediction.closed_loop import Flown, set_out
from twin_worker.telemetry.resample import Grid
from twin_worker.twin.state.checkpoint import Extension, Mark, before
from twin_worker.twin.state.state import Believed, Twin
from twin_worker.twin.steps.rollouts import paths

_EARLIER_S = 2.0  # a checkpoint nearer to the onset can contain the effect already [s]
_FLOWN_S = (20.0, 15.0, 10.0)  # newest flight simulated with both models, from several starts [s]
_CLEARLY = 0.95  # the adapted model is used if its error is below this share of the present error [-]
_DOUBT = 0.3  # relative uncertainty of an effect's increments: diagnosis and baseline are not exact [-]
_RIDGE = 0.02  # regularisation of an increment towards zero, as a share of its term's length
_HOLDS_S = 60.0  # assumed data span of the adapted model; its weight fades as that of earlier data does [s]
_ROWS = ((0, X, Z), (2, Z, M), (4, M, Y), (1, Y, L), (3, L, N), (5, N, WIND))  # row of the wrench, its derivatives
_COLUMNS = {0: "da", 1: "de", 2: "dr", 3: "dt"}  # derivatives of each input


@dataclass(frozen=True)
class Tried:
    """Result of an adaptation: whether the adapted model is used, and the mean position errors compared [m]."""

    used: bool
    present: float
    extended: float

    @property
    def said(self) -> str:
        """Describe the result."""
        if not np.isfinite(self.extended):
            return "not used for predictions: there is no flight to compare the models on"
        missed = f"{self.extended:.1f} m against {self.present:.1f} m over the last {_FLOWN_S[0]:.0f} s"
        return f"predictions use it ({missed})" if self.used else f"the identified model is used unchanged ({missed})"


def extend(twin: Twin, push: Push, names: str) -> Tried:
    """Add diagnosed effects to the models of a twin if this lowers the error over the newest flight.

    Args:
        twin: changed in place only if the error is lower
        outputs: of the effects
        names: of the effects
    """
    mark = before(twin.marks, push.onset - _EARLIER_S)
    if mark is None:
        return Tried(False, np.nan, np.nan)
    other = _begun_anew(twin, push, mark)
    misses = np.array([(_miss(twin, s), _miss(other, s)) for s in _FLOWN_S if twin.history.newest - s > push.onset])
    misses = misses[np.isfinite(misses).all(axis=1)] if len(misses) else np.full((1, 2), np.nan)
    if not len(misses):
        return Tried(False, np.nan, np.nan)
    present, extended = misses.mean(axis=0).tolist()
    if not extended < _CLEARLY * present:
        return Tried(False, present, extended)
    for name in ("wind", "wind_t", "plant", "last", "pool", "hybrid", "near_hybrid", "in_force", "learn_from"):
        setattr(twin, name, getattr(other, name))
    twin.near, twin.predict_t, twin.spread_t, twin.put_off, twin.told_t = None, -np.inf, -np.inf, None, -np.inf
    twin.grid.clear()
    twin.extended = Extension(names, push.onset)
    return Tried(True, present, extended)


def _begun_anew(twin: Twin, push: Push, mark: Mark) -> Twin:
    """Return a copy of the twin that contains the effects, restarted from `checkpoint` at the onset."""
    other = copy(twin)
    other.contest, other.grid = copy(twin.contest), Grid()
    other.learn_from = push.onset
    other.wind, other.wind_t = wind_since(twin, push, mark)
    window = other.window(_HOLDS_S)
    assert window is not None
    since = window.part(min(int(np.searchsorted(window.t, push.onset)), len(window) - 2), len(window))
    if mark.plant is not None and twin.in_force is not None:
        other.plant = other.last = plant = extended_plant(mark.plant, push, window)
        verdict = msgspec.structs.replace(twin.in_force, outcome=Outcome.VERIFIED)
        other.in_force = verdict
        other.pool = [Believed(plant, verdict, float(window.t[-1]), np.nan)]
    if mark.hybrid is not None:
        air = np.column_stack([_at(push.t, window, c) for c in range(3)])
        faulty = (push.moved != push.command).any(axis=0)
        added = Added(
            push.wrench[:, :3], air, _at(push.t, window, 6), push.moved[:, 3], (bool(faulty[0]), bool(faulty[1]))
        )
        other.hybrid = extended_hybrid(mark.hybrid, since, twin.history, other.wind.scale, added)
        other.near_hybrid = other.hybrid
    return other


def wind_since(twin: Twin, push: Push, mark: Mark) -> tuple[WindFilter, float]:
    """Return the wind filter rerun with the effects from their onset on, and the time of its newest row."""
    wind = deepcopy(mark.wind)
    last = blow(wind, twin.history, mark.t, mark.t, push.onset)
    wind.jump(push.wind, 1.0 / push.scale, _DOUBT)
    return wind, blow(wind, twin.history, last, push.onset)


def extended_plant(plant: Coupled, push: Push, window: Window) -> Coupled:
    """Return the model with the effects: derivatives by input scaled for servo faults, increments added.

    Increments are regressed on the terms of the wrench over the recent flight: their slopes about the present trim.
    """
    par, added = _through_servos(plant.par, push), np.zeros(len(NAMES))
    flown = np.column_stack([_at(push.t, window, c) for c in range(6)])
    A = np.empty((len(flown), WIND))
    for row, x, delta in zip(A, flown, push.moved, strict=True):
        terms(x[0], x[1], x[2], x[3:6], delta, plant.at, row)
    for which, first, end in _ROWS:
        added[first:end] = ridge(A[:, first:end], push.wrench[:, which], _RIDGE)
    added[WIND:] = push.wind[:2]
    changed = par + added - plant.par
    covariance = plant.covariance + np.diag((_DOUBT * changed) ** 2)
    nothing = np.zeros_like(plant.information)
    return replace(
        plant,
        par=par + added,
        mean=par + added,
        precision=np.linalg.inv(covariance),
        information=nothing,
        t0=push.onset,
        t1=push.onset + _HOLDS_S,
    )


def _through_servos(par: np.ndarray, push: Push) -> np.ndarray:
    """Return the derivatives by commands, for faulty servos with  delta = g delta_c + o."""
    out = par.copy()
    for column, letters in _COLUMNS.items():
        u, moved = push.command[:, column], push.moved[:, column]
        if np.array_equal(u, moved):
            continue
        g, o = np.polyfit(u, moved, 1) if np.ptp(u) > 1e-3 else (1.0, float((moved - u).mean()))
        for axis in "XYZLMN":
            if (name := f"{axis}_{letters}") in NAMES:
                by = NAMES.index(name)
                out[NAMES.index(f"{axis}_0")] += o * par[by]
                out[by] = g * par[by]
    return out


def _at(t: np.ndarray, window: Window, column: int) -> np.ndarray:
    return np.interp(t, window.t, window.x[:, column])


def _miss(twin: Twin, seconds: float) -> float:
    """Return the mean position error of the active method over the newest seconds [m]; inf outside the envelope."""
    window = twin.window(62.0 + seconds)
    if window is None or twin.why_no_route() or not window.ok[-round(seconds / window.dt) :].all():
        return np.nan
    start = len(window) - 1 - round(seconds / window.dt)
    now = twin.situation(window.part(0, start + 1))
    begin = set_out(now)
    if isinstance(begin, Flown):
        return np.nan
    ahead = np.arange(0.0, seconds + 1e-9)
    found, _ = paths(twin, (now, begin), ahead, False)
    if not found:
        return np.inf
    path = found[twin.contest.best(tuple(found))]
    rows = start + np.rint(ahead / window.dt).astype(int)
    return float(np.linalg.norm(path - window.p[rows], axis=1).mean())
