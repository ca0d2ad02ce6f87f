"""`python -m tests.bench.prediction.decomposition FILE…`: which missing knowledge causes the error of predictions.

Every start is predicted again with parts of the later recording given to the predictor, one after the other. What still
misses the flight with all of them is an error of law, route or model; what they remove was not known at the start.

Missions, point mass in closed loop: airspeed, height, wind with heading error (mean of 10 s), and turn rate at a bank
(mean of 10 s), which an error of the attitude estimate changes. The last row has the recorded bank: kinematics alone.
GUIDED along a reported path: the later reports of the path, then height, then the distance flown along the path.
Where most starts have neither (multirotors): height and distance on the predicted path.
"""

import argparse
import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fleet.autopilots.laws import guide
from fleet.autopilots.modes import make_leg
from fleet.contract import Message, Sample
from fleet.frames import G, Origin, to_ned, wrap
from fleet.mission import WAYPOINT, Route
from fleet.physics import point_mass as H
from fleet.telemetry.recording.options import NO_OPTIONS
from fleet.telemetry.recording.recordings import Recording
from tests.bench.prediction.__main__ import ALFA, OTHERS, SIMPLE
from twin_worker.evaluation.drive import RecordingDriver
from twin_worker.evaluation.scoring.log import OURS, EvaluationCase, MethodForecast
from twin_worker.evaluation.scoring.score import LIMITS, passage_quantile, score_method, survival_at
from twin_worker.numerics.prediction_errors import AHEAD
from twin_worker.prediction import kinematic
from twin_worker.prediction.closed_loop import synchronise_controller
from twin_worker.prediction.fixed_wing.point_mass_rollout import start_and_air
from twin_worker.prediction.replay_window import Rollout
from twin_worker.service.warm_up import warm_up
from twin_worker.telemetry.history import TelemetryHistory
from twin_worker.telemetry.track import Track
from twin_worker.twin.state.reported_path import reported_path
from twin_worker.twin.state.state import Twin
from twin_worker.twin.steps.kinematic_prediction import fixed_wing_config, recent_track

SPAN_S, LOOK_AHEADS, MEAN_S = 60.0, (5, 16, 30, 60), 10.0
PARTS = {  # what is known of the later flight
    "point mass alone": (),
    "airspeed": ("airspeed",),
    "turn rate at a bank": ("turn",),
    "wind and heading error": ("wind",),
    "airspeed, height": ("airspeed", "height"),
    "airspeed, height, wind": ("airspeed", "height", "wind"),
    "airspeed, height, wind, turn rate at a bank": ("airspeed", "height", "wind", "turn"),
    "the same and the bank: kinematics": ("airspeed", "height", "wind", "turn", "bank"),
}
ON_PATH = ("height", "height, distance")
GUIDED = ("later path", "later path, height", "later path, height, distance")


@dataclass(frozen=True)
class Start:
    """State of the twin at one start: of the point mass in closed loop, or of the kinematic model on a path."""

    t: float
    control: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
    parameters: np.ndarray | None = None
    state: np.ndarray | None = None
    air: np.ndarray | None = None
    on_path: tuple[Track, kinematic.KinematicConfig, kinematic.KinematicModel] | None = None


@dataclass(frozen=True)
class Flight:
    """The whole flight every `H.STEP`: airspeed, attitude, velocity, position, turn rate at a bank, wind."""

    t: np.ndarray
    Va: np.ndarray
    euler: np.ndarray
    v: np.ndarray
    p: np.ndarray

    @classmethod
    def of(cls, history: TelemetryHistory, origin: Origin) -> "Flight":
        t_p, position = history.rows("position")
        t = np.arange(t_p[0], t_p[-1], H.STEP)

        def at(name: str) -> np.ndarray:
            rows_t, rows = history.rows(name)
            return np.column_stack([np.interp(t, rows_t, np.unwrap(x) if name == "attitude" else x) for x in rows.T])

        p = np.column_stack([np.interp(t, t_p, x) for x in to_ned(origin, *position.T).T])
        return cls(t, at("air")[:, 0], at("attitude")[:, :3], at("velocity"), p)

    def rows(self, t: float, n: int) -> np.ndarray:
        return np.clip(np.searchsorted(self.t, t) + np.arange(n), 0, len(self.t) - 1)

    def wind(self, air: np.ndarray) -> np.ndarray:
        V, course = self.Va * air[H.SCALE], self.euler[:, 2] + air[H.D_PSI]
        level = np.sqrt(np.maximum(V**2 - self.v[:, 2] ** 2, 1.0))
        return moving_mean(self.v[:, :2] - level[:, None] * np.column_stack([np.cos(course), np.sin(course)]))

    def turn_error(self, k_psi: float, scale: float) -> np.ndarray:
        V = np.maximum(self.Va * scale, 3.0)
        rate = np.gradient(self.euler[:, 2], H.STEP) - k_psi * G * np.tan(np.clip(self.euler[:, 0], -1.3, 1.3)) / V
        return moving_mean(rate[:, None])[:, 0]


def moving_mean(x: np.ndarray) -> np.ndarray:
    """Return the centred mean of `MEAN_S` of each column, (n, k)."""
    n = int(MEAN_S / H.STEP) | 1
    padded = np.pad(x, ((n // 2, n // 2), (0, 0)), mode="edge")
    sums = np.vstack([np.zeros(x.shape[1]), np.cumsum(padded, axis=0)])
    return (sums[n:] - sums[:-n]) / n


def fly(start: Start, flight: Flight, known: tuple[str, ...]) -> np.ndarray:
    """Fly as `fleet.physics.point_mass.simulate_route` does, with parts of the later flight, every step, (n, 3) [m]."""
    assert start.control is not None and start.parameters is not None
    assert start.state is not None and start.air is not None
    (ctl, par, legs), w, air, dt = (x.copy() for x in start.control), start.parameters, start.air, H.STEP
    n = int((SPAN_S + 2.0) / dt)
    rows, p = flight.rows(start.t, n), start.state[:3].copy()
    V_known, p_known, v_known = flight.Va[rows] * air[H.SCALE], flight.p[rows], flight.v[rows]
    wind_known, turn_known = flight.wind(air)[rows], flight.turn_error(w[H.K_PSI], air[H.SCALE])[rows]
    speed, psi, phi, p_rate = (start.state[i] for i in (H.V, H.PSI, H.PHI, H.P_RATE))
    theta, q_rate, gamma, thr = (start.state[i] for i in (H.THETA, H.Q_RATE, H.GAMMA, H.THROTTLE))
    Va, rate, out = speed / air[H.SCALE], 0.0, np.full((n, 3), np.nan)
    for k in range(n):
        out[k] = p
        if not (3.0 < speed < 3.0 * w[H.V_0] and abs(phi) < 1.3):
            return out
        speed = V_known[k] if "airspeed" in known else speed
        phi = flight.euler[rows[k], 0] if "bank" in known else phi
        gusts = air[H.DRIFT_N : H.DRIFT_E + 1] * np.exp(-k * dt / air[H.DRIFT_S])
        gusts = gusts + air[H.REST_N : H.REST_E + 1] * np.exp(-k * dt / air[H.REST_S])
        wind = wind_known[k] if "wind" in known else air[H.W_N : H.W_E + 1] + gusts
        direction = np.array([np.cos(psi + air[H.D_PSI]), np.sin(psi + air[H.D_PSI])])
        v = np.array([*(speed * np.cos(gamma) * direction + wind), -speed * np.sin(gamma)])
        if "height" in known:
            p[2], v[2] = p_known[k, 2], v_known[k, 2]
        rate += min(5.0 * dt, 1.0) * ((speed / air[H.SCALE] - Va) / dt - rate) if k else 0.0
        Va = speed / air[H.SCALE]
        phi_c, theta_c, delta_t = guide(ctl, par, legs, p, v, np.array([phi, theta, psi]), Va, rate, dt)
        thr += np.clip(delta_t - thr, -dt / 0.3, dt / 0.3)
        load = 1.0 / np.cos(phi)
        theta, q_rate = lag(theta, q_rate, theta_c, w[H.WN_THETA : H.B_THETA + 1])
        phi, p_rate = lag(phi, p_rate, phi_c, w[H.WN_PHI : H.B_PHI + 1])
        alpha = w[H.A_0] + w[H.A_N] * (load * (w[H.V_0] / speed) ** 2 - 1.0)
        gamma += (1.0 - np.exp(-dt / H.GAMMA_S)) * (theta - alpha - gamma)
        accel = w[H.C_0] + w[H.C_T] * (thr - w[H.T_0]) + w[H.C_V] * (speed - w[H.V_0]) + w[H.C_N] * (load**2 - 1.0)
        turn = turn_known[k] if "turn" in known else w[H.B_PSI]
        psi = wrap(psi + dt * (w[H.K_PSI] * G * np.tan(phi) / speed + turn))
        speed += dt * (accel + G * v[2] / speed)
        p += dt * v
    return out


def lag(angle: float, rate: float, command: float, parameters: np.ndarray) -> tuple[float, float]:
    """Advance a second-order lag [wn, zeta, bias] by one step."""
    wn, zeta, bias = parameters
    for _ in range(4):
        rate += H.STEP / 4 * (wn**2 * (command + bias - angle) - 2.0 * zeta * wn * rate)
        angle += H.STEP / 4 * rate
    return angle, rate


def later_path(history: TelemetryHistory, origin: Origin, t: float) -> Route | None:
    """Return the path that was reported from `t` on as a route, points every half second; None without reports."""
    t_b, bearing = history.rows("bearing", t)
    t_c, command = history.rows("command", t)
    t_p, position = history.rows("position", t - 1.0)
    times = np.arange(t, min(t + SPAN_S + 5.0, t_b[-1] if len(t_b) else t), 0.5)
    if len(times) < 3 or len(t_c) < 2:
        return None
    course = np.interp(times, t_b, np.unwrap(bearing[:, 0]))
    crosstrack = np.interp(times, t_c, np.nan_to_num(command[:, 2]))
    p = np.column_stack([np.interp(times, t_p, x) for x in to_ned(origin, *position.T).T])
    points = p + crosstrack[:, None] * np.column_stack([-np.sin(course), np.cos(course), 0 * course])
    return Route(origin, np.array([make_leg(WAYPOINT, point) for point in points[1:]]), points[0], ())


def guided_paths(start: Start, history: TelemetryHistory, case: EvaluationCase) -> dict[str, np.ndarray]:
    """Return the path of each variant of `GUIDED`, (k, 3) [m]."""
    assert start.on_path is not None
    track, config, model = start.on_path
    route = later_path(history, case.start.origin, float(track.t[-1]))
    if route is None:
        return {}
    ahead = AHEAD + (case.start.t - track.t[-1])
    config = replace(config, mode_route=route)
    path = kinematic.fly(track, np.zeros(len(track)), config, model, np.maximum(ahead, 0.0)).path
    if path is None:
        return {}
    return dict(zip(GUIDED, (path, *with_later_motion(path, case.positions)), strict=True))


def with_later_motion(path: np.ndarray, flown: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a path at the heights flown later, and also at the distances flown along it, (k, 3) [m]."""
    high = np.column_stack([path[:, :2], np.where(np.isfinite(flown[:, 2]), flown[:, 2], path[:, 2])])
    return high, along(high, flown)


def along(path: np.ndarray, flown: np.ndarray) -> np.ndarray:
    """Return the points of a path at the distances that were flown, (k, 3) [m]."""
    lengths = [np.linalg.norm(np.diff(x[:, :2], axis=0), axis=1) for x in (path, flown)]
    s, wanted = (np.concatenate([[0.0], np.cumsum(x)]) for x in lengths)
    return np.column_stack([*(np.interp(wanted, s, x) for x in path[:, :2].T), path[:, 2]])


def capture(twin: Twin, t: float) -> Start:
    """Return the inputs of the present prediction."""
    if reported_path(twin) is not None:
        track = recent_track(twin, 62.0)
        assert track is not None
        return Start(t, on_path=(track.unbroken_tail(), fixed_wing_config(twin), twin.models.kinematic))
    window = twin.window(62.0)
    if twin.no_route_reason() or twin.models.point_mass is None or window is None or not window.ok[-1]:
        return Start(t)
    context = twin.situation(window)
    initial = synchronise_controller(context)
    if isinstance(initial, Rollout):
        return Start(t)
    state, air = start_and_air(context, initial.window)
    return Start(float(window.t[-1]), initial.synchronised, twin.models.point_mass.parameters.copy(), state, air)


def evaluate(path: Path) -> dict[str, Any]:
    """Return the figures of every variant on one recording, each over the same starts."""
    driver = RecordingDriver(path.name, ALFA if path.name.startswith("alfa_") else OTHERS)
    histories: dict[int, TelemetryHistory] = {}
    starts: dict[float, Start] = {}

    def messages() -> Iterator[Message]:
        for _, batch in Recording(path, 0, NO_OPTIONS).steps():
            for message in batch:
                if isinstance(message, Sample):
                    histories.setdefault(message.uav, TelemetryHistory(keep_s=1e9)).add(message)
                yield message
                evaluated = driver.uavs.get(message.uav)
                if evaluated is not None and evaluated.starts and evaluated.starts[-1].t not in starts:
                    starts[evaluated.starts[-1].t] = capture(evaluated.twin, evaluated.starts[-1].t)

    cases = [case for case in driver.run(messages()) if not case.exclusion and OURS in case.start.forecasts]
    by_variants: dict[tuple[str, ...], list[EvaluationCase]] = {}
    flights: dict[str, Flight] = {}
    for case in cases:
        start, history = starts[case.start.t], histories[case.start.uav]
        paths: dict[str, np.ndarray] = {}
        if start.on_path is not None:
            paths = guided_paths(start, history, case)
        elif start.control is not None:
            key = case.start.flight
            flights.setdefault(key, Flight.of(history, case.start.origin))
            times = H.STEP * np.arange(int((SPAN_S + 2.0) / H.STEP)) + start.t - case.start.t
            for name, known in PARTS.items():
                flown = fly(start, flights[key], known)
                paths[name] = np.column_stack([np.interp(AHEAD, times, x, right=np.nan) for x in flown.T])
        else:
            paths = dict(zip(ON_PATH, with_later_motion(case.start.forecasts[OURS].path, case.positions), strict=True))
        if paths:
            by_variants.setdefault(tuple(paths), []).append(with_paths(case, paths))
    kept = max(by_variants.values(), key=len, default=[])
    variants = (OURS, *SIMPLE, *ON_PATH, *GUIDED, *PARTS)
    ordered = [name for name in variants if kept and all(name in case.start.forecasts for case in kept)]
    return {"recording": path.name, "starts": len(cases), "compared": len(kept), "variants": scores(kept, ordered)}


def with_paths(case: EvaluationCase, paths: dict[str, np.ndarray]) -> EvaluationCase:
    """Return the case with the variants as forecasts, known up to `SPAN_S`."""
    forecasts = case.start.forecasts | {name: MethodForecast(x, name) for name, x in paths.items()}
    positions = np.where((AHEAD <= SPAN_S)[:, None], case.positions, np.nan)
    return replace(case, positions=positions, start=replace(case.start, forecasts=forecasts))


def scores(cases: list[EvaluationCase], names: list[str]) -> dict[str, Any]:
    """Return t10 quartile and median [s], share held for 60 s and median errors [m] of each variant."""
    out: dict[str, Any] = {}
    for name in names:
        one = score_method(cases, name)
        passages = one.passages[LIMITS[0]]
        columns = [int(np.searchsorted(AHEAD, s)) for s in LOOK_AHEADS]
        errors = {
            str(s): round(float(np.nanmedian(one.distance[:, k])), 1) for s, k in zip(LOOK_AHEADS, columns, strict=True)
        }
        out[name] = {
            "t10_lq_s": round(passage_quantile(passages, 0.25), 1),
            "t10_median_s": round(passage_quantile(passages, 0.5), 1),
            "held_60": round(survival_at(passages, 60.0), 2),
            "p50_m": errors,
            "passages": np.round(passages, 2).tolist(),
        }
    return out


def table(results: list[dict[str, Any]]) -> str:
    """Return the Markdown table of all variants."""
    rows = [
        "| Recording (starts) | known of the later flight | t10 quartile, median [s] | 60 s held "
        "| median error at 5 / 16 / 30 / 60 s [m] |",
        "|---|---|---|---|---|",
    ]
    for one in results:
        for name, row in one["variants"].items():
            errors = " / ".join(f"{row['p50_m'][str(s)]:.1f}" for s in LOOK_AHEADS)
            label = "nothing: the prediction made" if name == OURS else name
            rows.append(
                f"| {one['recording'].split('.')[0]} ({one['compared']}) | {label} "
                f"| {row['t10_lq_s']}, {row['t10_median_s']} | {row['held_60']:.0%} | {errors} |"
            )
    return "\n".join(rows)


def main() -> None:
    """Decompose the errors of some recordings, one at a time."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="+", type=Path, help="recordings")
    parser.add_argument("--json", type=Path, help="write all figures")
    args = parser.parse_args()
    warm_up()
    results = []
    for path in args.files:
        results.append(evaluate(path))
        print(path.name, results[-1]["compared"], "of", results[-1]["starts"], "starts", flush=True)
    print(table(results))
    if args.json:
        args.json.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
