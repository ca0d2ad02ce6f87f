"""Free runs of a model over held-out data."""

from functools import cached_property

import numpy as np

from fleet.physics.simulate import TAU, lagged
from fleet.window import STATES, Window
from twin_worker.identification.fixed_wing.derivatives_model import DerivativesModel
from twin_worker.identification.fixed_wing.output_error import LINE_SAMPLES
from twin_worker.identification.fixed_wing.plant import Plant
from twin_worker.identification.linear.prediction_error_method import free_run
from twin_worker.validation.forecast_shrinkage import runs_and_measured
from twin_worker.validation.gust_observer import AlphaBetaFilter

_LINE_END_WEIGHTS = np.linalg.pinv(np.column_stack([np.ones(LINE_SAMPLES), np.arange(1 - LINE_SAMPLES, 1)]))[0]


class HeldOut:
    """One model over one window; rows from `start` on are held out, rows before initialise lags and start states.

    Attributes:
        y: states of this kind of model, u v w over the ground or through the air, from `start` on, (n, 9)
        ok: rows that were measured, (n,) bool
        dt: sample time [s]
    """

    def __init__(self, plant: Plant, window: Window, start: int) -> None:
        self._plant, self._window, self._start = plant, window, start
        self._y = window.over_ground if isinstance(plant, DerivativesModel) else window.x
        self._delta = lagged(window.u, window.dt, TAU) if isinstance(plant, DerivativesModel) else window.u
        self._unmeasured_count = np.concatenate([[0], np.cumsum(~window.ok)])
        self.y, self.ok, self.dt = self._y[start:], window.ok[start:], window.dt

    def runs(self, length: int) -> np.ndarray:
        """Simulate from a measured start every `length` rows, (n, 9); nan where a run would cross unmeasured rows."""
        n = len(self._window)
        start_rows = np.arange(self._start, n, length)
        unbroken = self._unmeasured_count[np.minimum(start_rows + length, n)] == self._unmeasured_count[start_rows]
        start_rows = start_rows[unbroken]
        if isinstance(self._plant, DerivativesModel):
            starts = self._start_states(start_rows)
            return self._plant.free_run_segments(starts, start_rows, length, self._delta, self.dt)[self._start :]
        return self._linear_runs(start_rows, length)

    def one_step(self) -> np.ndarray:
        """Predict each row from those before it, (n, 9); nan at and after unmeasured rows, and at starts."""
        if isinstance(self._plant, DerivativesModel):
            out = self._filtered[1][self._start :]
        else:
            out = self.runs(2)
            out[::2] = np.nan
        return np.where(self.ok[:, None], out, np.nan)

    def shrinkage_sample(self, seconds: float, interval: float) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Return free runs, measured states and the preceding mean of a derivatives model; None for linear axes.

        Args:
            seconds, interval: length of a run, and time between starts [s]
        """
        if not isinstance(self._plant, DerivativesModel):
            return None
        y, gust_filter = self._measured, AlphaBetaFilter(self._plant, self.dt)
        start_rows = np.arange(self._start, len(y) - round(1.0 / self.dt), round(interval / self.dt))
        earlier = self._y[: self._start][self._window.ok[: self._start]]
        filtered = self._filtered[0]
        runs, measured = runs_and_measured(gust_filter, y, self._delta, start_rows, seconds, filtered=filtered)
        return runs, measured, earlier.mean(axis=0)

    @property
    def _measured(self) -> np.ndarray:
        """Return the states, nan where not measured, (n, 9)."""
        return np.where(self._window.ok[:, None], self._y, np.nan)

    @cached_property
    def _filtered(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the filtered states and gusts, (n, 15), and each row predicted from those before it, (n, 9)."""
        assert isinstance(self._plant, DerivativesModel)
        return AlphaBetaFilter(self._plant, self.dt).filter_and_predict(self._measured, self._delta)

    def _start_states(self, start_rows: np.ndarray) -> np.ndarray:
        """Return the start states at rows from a line fit through the rows up to each; the row itself at gaps."""
        rows = start_rows[:, None] + np.arange(1 - LINE_SAMPLES, 1)
        smooth = np.einsum("l,mlk->mk", _LINE_END_WEIGHTS, self._y[np.maximum(rows, 0)])
        line_valid = (rows[:, 0] >= 0) & self._window.ok[np.maximum(rows, 0)].all(axis=1)
        return np.where(line_valid[:, None], smooth, self._y[start_rows])

    def _linear_runs(self, start_rows: np.ndarray, length: int) -> np.ndarray:
        assert not isinstance(self._plant, DerivativesModel)
        n = len(self._window)
        out = np.full((n, len(STATES)), np.nan)
        for axis in self._plant:
            columns = [STATES.index(name) for name in axis.states]
            y, u = axis.scaled(self._window)
            for k in start_rows:
                stop = min(k + length, n)
                run = np.empty((stop - k, len(columns)))
                free_run(axis.D, y[k], np.ascontiguousarray(u[k:stop]), run)
                out[k:stop, columns] = run * axis.y_scale + axis.y_mean
        return out[self._start :]
