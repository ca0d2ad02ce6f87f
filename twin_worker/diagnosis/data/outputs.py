"""Servo outputs as the autopilot sent them, at their own times, with the control errors that they answer."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fleet.airframes.airframe import ASSUMED, ServoMap, servo_map
from fleet.airframes.servo_learning import learn_servo_map
from fleet.frames import G
from twin_worker.numerics.interpolation import zero_order_hold
from twin_worker.telemetry.history import TelemetryHistory
from twin_worker.telemetry.track import hovering_mask

_KINDS = ("servo", "attitude", "velocity", "command", "air")
_MIN_ROWS = 50
_SPACING_S = 0.25
_MIN_SPEED, _MIN_HEIGHT_M = 8.0, 15.0  # slower or lower rows are on or near the ground
_STICK_MODES = ("MANUAL", "STABILIZE", "STABILIZED", "TRAINING", "ACRO", "RATTITUDE", "FBWA", "AUTOTUNE")


@dataclass(frozen=True)
class ServoOutputs:
    """Outputs of one flight.

    Attributes:
        t: time since the first attitude, (n,) [s]
        pulses: (n, 8) or (n, 16) [us]
        errors: commanded minus actual roll and pitch [rad], energy as height [m], (n, 3)
        signals: by axis (roll, pitch, energy), what a stabilising law answers, (n, k) each
        throttle: as reported, (n,) [-]
        flying: rows in the air, flown on the wings by the autopilot, (n,) bool
        params: autopilot parameters
    """

    t: np.ndarray
    pulses: np.ndarray
    errors: np.ndarray
    signals: tuple[np.ndarray, np.ndarray, np.ndarray]
    throttle: np.ndarray
    flying: np.ndarray
    params: dict[str, float]

    def servo_map(self, rows: np.ndarray) -> ServoMap:
        """Return the map that the parameters describe, else the one that these rows show, bool (n,)."""
        described = servo_map(self.params)
        if not described.sentence.startswith(ASSUMED):
            return described
        rates = np.column_stack([self.signals[0][:, 1], self.signals[1][:, 1]])
        learned = learn_servo_map(self.pulses[rows], self.errors[rows, :2], rates[rows], self.throttle[rows])
        return learned or described


def read_outputs(
    history: TelemetryHistory, params: dict[str, float], t_start: float, modes: Sequence[tuple[float, str]] = ()
) -> ServoOutputs | None:
    """Return the outputs of one aircraft; None without control errors or other required telemetry.

    Signals are taken at the time of each output, the newest value before it.

    Args:
        history: telemetry as received
        params: autopilot parameters
        t_start: time zero of the flight [s since 1970]
        modes: mode changes, (time [s since 1970], name), in order; in modes flown by hand outputs answer the pilot
    """
    series = {kind: history.rows(kind) for kind in _KINDS}
    if any(len(series[kind][0]) < _MIN_ROWS for kind in ("servo", "attitude", "velocity", "command")):
        return None
    t, pulses = _thinned(*series["servo"])
    begun = t >= max(series[kind][0][0] for kind in ("attitude", "velocity", "command"))
    t, pulses = t[begun], pulses[begun]
    attitude, velocity, command = (
        zero_order_hold(*series[kind], t, np.inf) for kind in ("attitude", "velocity", "command")
    )
    phi, theta, p, q, r = attitude[:, [0, 1, 3, 4, 5]].T
    phi_c, theta_c, low, slow = command[:, [0, 1, 3, 4]].T
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    slow = np.nan_to_num(slow)
    load = np.abs(np.tan(np.clip(phi, -1.0, 1.0)))
    energy = np.nan_to_num(low) + speed / G * slow
    air = series["air"]
    is_high = _height(history, t) > _MIN_HEIGHT_M
    changes = np.array([since for since, _ in modes])
    is_stick_mode = np.array([False, *(mode in _STICK_MODES for _, mode in modes)])
    piloted = is_stick_mode[np.searchsorted(changes, t, side="right")]
    return ServoOutputs(
        t=t - t_start,
        pulses=pulses,
        errors=np.column_stack([phi_c - phi, theta_c - theta, energy]),
        signals=(
            np.column_stack([phi_c - phi, p, r, phi, phi_c]),
            np.column_stack([theta_c - theta, q, load, theta_c, speed]),
            np.column_stack([energy, velocity[:, 2], theta_c, load, slow]),
        ),
        throttle=zero_order_hold(*air, t, np.inf)[:, 1] if len(air[0]) >= _MIN_ROWS else np.full(len(t), np.nan),
        flying=(speed > _MIN_SPEED) & is_high & ~piloted & ~hovering_mask(t, history, params, modes),
        params=params,
    )


def _height(history: TelemetryHistory, t: np.ndarray) -> np.ndarray:
    """Return the height above home, or above the lowest position where that is not reported, (n,) [m]."""
    above, position = history.rows("height"), history.rows("position")
    if len(above[0]) >= _MIN_ROWS:
        return zero_order_hold(*above, t, np.inf)[:, 0]
    if len(position[0]) < _MIN_ROWS:
        return np.full(len(t), np.inf)
    return (zero_order_hold(*position, t, np.inf)[:, 2] - position[1][:, 2].min()) * 1e-3


def _thinned(t: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rows at least `_SPACING_S` apart: closer rows are not independent answers."""
    chosen, last = [], -np.inf
    for k, time in enumerate(t.tolist()):
        if time - last >= _SPACING_S:
            chosen.append(k)
            last = time
    return t[chosen], x[chosen]
