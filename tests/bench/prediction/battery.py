"""`python -m tests.bench.prediction.battery FILE… --figure battery.png`: predicted remaining battery at landing.

Every forecast of the end of a mission is compared with the share that is reported when the aircraft disarms.
"""

import argparse
from pathlib import Path

import numpy as np

from fleet.contract import BatteryForecast, Prediction, Sample, Status
from fleet.report import ink
from fleet.telemetry.recording.recordings import replay_messages
from twin_worker.prediction.multirotor.endurance import Z90
from twin_worker.twin.step import Twin, advance


def errors(path: Path) -> np.ndarray:
    """Return time before landing [s], error, standard deviation and error of the time [s] of each forecast, (n, 4)."""
    twin: Twin | None = None
    forecasts: list[tuple[float, BatteryForecast]] = []
    reported: list[tuple[float, float]] = []
    landings, was_armed = [], False
    for message in replay_messages(path):
        if isinstance(message, Sample) and message.battery is not None:
            rows = message.battery
            reported += zip(rows.t.numpy().tolist(), rows.x.numpy()[:, 2].tolist(), strict=True)
        if isinstance(message, Status):
            landings += [message.t] if was_armed and not message.armed else []
            was_armed = message.armed
        twin = twin or Twin.of(message.uav)
        for result in advance(twin, (message,)):
            battery = result.battery if isinstance(result, Prediction) else None
            if battery is not None and battery.end is not None and not (forecasts and forecasts[-1][1] is battery):
                forecasts.append((result.t, battery))
    t, share = np.array(reported).T
    out = []
    for start, forecast in forecasts:
        landing = next((at for at in landings if at > start), None)
        if landing is not None:
            actual, left = float(np.interp(landing, t, share)), landing - start
            out.append((left, forecast.end - actual, forecast.end_sigma, forecast.end_s - left))
    return np.array(out).reshape(-1, 4)


def main() -> None:
    """Print and draw the errors of recordings."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("--figure", type=Path)
    args = parser.parse_args()
    by_flight = {path.stem: errors(path) for path in args.files}
    for name, rows in [*by_flight.items(), ("all", np.vstack(list(by_flight.values())))]:
        if len(rows):
            inside = np.mean(np.abs(rows[:, 1]) <= Z90 * rows[:, 2])
            low, high = 100 * np.quantile(np.abs(rows[:, 1]), (0.5, 0.9))
            print(f"{name}: {len(rows)} forecasts, error {low:.1f} points (90 %: {high:.1f}), in interval {inside:.0%}")
    if args.figure:
        _draw(args.figure, by_flight)


def _draw(path: Path, by_flight: dict[str, np.ndarray]) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, ax = plt.subplots(figsize=(7, 4), layout="constrained")
    for name, rows in by_flight.items():
        if len(rows):
            line = ax.plot(rows[:, 0], 100 * rows[:, 1], ".-", ms=4, lw=0.8, label=name)[0]
            band = 100 * Z90 * rows[:, 2]
            ax.fill_between(rows[:, 0], -band, band, color=line.get_color(), alpha=0.06, lw=0)
    ax.axhline(0.0, color="k", lw=0.5)
    low, high = ink.axis_limits(np.concatenate([100 * rows[:, 1] for rows in by_flight.values() if len(rows)]))
    ax.set(xlabel="before landing [s]", ylabel="predicted minus reported share at landing [points]", ylim=(low, high))
    ax.invert_xaxis()
    ax.legend(fontsize=8)
    figure.savefig(path, dpi=150)
    plt.close(figure)


if __name__ == "__main__":
    main()
