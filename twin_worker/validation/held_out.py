"""Free runs of a model over held-out data."""

import numpy as np

from fleet.physics.actuators import TAU, lagged
from fleet.window import STATES, Window
from twin_worker.identification.fixed_wing.derivatives_model import Coupled
from twin_worker.identification.fixed_wing.output_error import LINE
from twin_worker.identification.fixed_wing.plant import Plant
from twin_worker.identification.linear.prediction_error_method import free_run
from twin_worker.validation.forecast_shrinkage import runs_and_flown
from twin_worker.validation.gust_observer import Observer

_TO_END = np.linalg.pinv(np.column_stack([np.ones(LINE), np.arange(1 - LINE, 1)]))[0]


class Unseen:
    """One model over one window; rows from `start` on are held out, rows before initialise lags and start states.

    Attributes:
        y: states of this kind of model, u v w over the ground or through the air, from `start` on, (n, 9)
        ok: rows that were measured, (n,) bool
        dt: sample time [s]
    """

    def __init__(self, plant: Plant, window: Window, start: int) -> None:
        self._plant, self._window, self._start = plant, window, start
        self._y = window.over_ground if isinstance(plant, Coupled) else window.x
        self._delta = lagged(window.u, window.dt, TAU) if isinstance(plant, Coupled) else window.u
        self._broken = np.concatenate([[0], np.cumsum(~window.ok)])
        self.y, self.ok, self.dt = self._y[start:], window.ok[start:], window.dt

    def runs(self, length: int) -> np.ndarray:
        """Simulate from a measured start every `length` rows, (n, 9); nan where a run would cross unmeasured rows."""
        n = len(self._window)
        begins = np.arange(self._start, n, length)
        whole = self._broken[np.minimum(begins + length, n)] == self._broken[begins]
        begins = begins[whole]
        if isinstance(self._plant, Coupled):
            starts = self._fresh(begins)
            return self._plant.fly_each(starts, begins, length, self._delta, self.dt)[self._start :]
        return self._linear_runs(begins, length)

    def one_step(self) -> np.ndarray:
        """Predict each row from those before it, (n, 9); nan at and after unmeasured rows, and at starts."""
        if isinstance(self._plant, Coupled):
            y = np.where(self._window.ok[:, None], self._y, np.nan)  # the filter restarts at nan
            out = Observer(self._plant, self.dt).foretell(y, self._delta)[self._start :]
        else:
            out = self.runs(2)
            out[::2] = np.nan
        return np.where(self.ok[:, None], out, np.nan)

    def lesson(self, seconds: float, every: float) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Return free runs, measured states and the preceding mean of a derivatives model; None for linear axes.

        Args:
            seconds, interval: length of a run, and time between starts [s]
        """
        if not isinstance(self._plant, Coupled):
            return None
        y = np.where(self._window.ok[:, None], self._y, np.nan)
        begins = np.arange(self._start, len(y) - round(1.0 / self.dt), round(every / self.dt))
        before = self._y[: self._start][self._window.ok[: self._start]]
        runs, flown = runs_and_flown(Observer(self._plant, self.dt), y, self._delta, begins, seconds)
        return runs, flown, before.mean(axis=0)

    def _fresh(self, begins: np.ndarray) -> np.ndarray:
        """Return the start states at rows from a line fit through the rows up to each; the row itself at gaps."""
        rows = begins[:, None] + np.arange(1 - LINE, 1)
        smooth = np.einsum("l,mlk->mk", _TO_END, self._y[np.maximum(rows, 0)])
        straight = (rows[:, 0] >= 0) & self._window.ok[np.maximum(rows, 0)].all(axis=1)
        return np.where(straight[:, None], smooth, self._y[begins])

    def _linear_runs(self, begins: np.ndarray, length: int) -> np.ndarray:
        assert not isinstance(self._plant, Coupled)
        n = len(self._window)
        out = np.full((n, len(STATES)), np.nan)
        for axis in self._plant:
            columns = [STATES.index(name) for name in axis.states]
            y, u = axis.scaled(self._window)
            for k in begins:
                stop = min(k + length, n)
                run = np.empty((stop - k, len(columns)))
                free_run(axis.D, y[k], np.ascontiguousarray(u[k:stop]), run)
                out[k:stop, columns] = run * axis.y_scale + axis.y_mean
        return out[self._start :]
