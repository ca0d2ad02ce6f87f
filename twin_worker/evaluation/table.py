"""Tables and files of the evaluation results, with the same content as the JSON."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text
from scipy.special import ndtri

from fleet.frames import to_geodetic
from fleet.report.report_text import printable
from twin_worker.evaluation.scoring.compare import BEATEN, MIN_FIRST_S, WORSE
from twin_worker.evaluation.scoring.log import OURS, EvaluationCase
from twin_worker.numerics.prediction_errors import NOMINAL_COVERAGE, path_length, track_frame

_LABELS = {
    "cv": "constant velocity",
    "ct": "constant turn rate",
    "imm": "IMM",
    "route": "route at ground speed",
    "route_wind": "route + wind + leg speed",
    "paper": "method of the paper",
    "dynamics": "derivatives model + controller",
    OURS: "ours",
}
_ERRORS = ("5", "16", "30", "60")
_ERROR_COLUMNS = [f"p50 {s} s [m]" for s in _ERRORS]
_STYLES = {BEATEN: "green", WORSE: "red"}
_NO_STARTS = f"no prediction, and no mission flown after the first {MIN_FIRST_S:.0f} s"
_OTHER_KEYS = ("compare", "apart", "run")


def table(results: dict[str, Any]) -> RenderableType:
    """Format methods, tubes, phases, comparison and excluded starts."""
    ordered = dict.fromkeys((*_LABELS, *results))
    names = [name for name in ordered if name in results and name not in _OTHER_KEYS]
    parts: list[RenderableType] = []
    if names:
        parts += [_methods(results, names), Text(""), _region_table(results, names), Text("")]
        parts += [_phases(results[OURS]["phases"]), Text("")]
        if results["compare"]:
            parts += [_compare(results["compare"]), Text("")]
    return Group(*parts, *(Text(printable(line)) for line in notes(results, names)))


def _methods(results: dict[str, Any], names: list[str]) -> Table:
    first_row = results[names[0]]
    counts = f"{first_row['starts']} starts of {first_row['flights']} flights"
    columns = (
        "method",
        "t10 quartile / median [s]",
        "t5 [s]",
        "within 60 s",
        "M2 [s]",
        *_ERROR_COLUMNS,
        "p90 60 s [m]",
    )
    out = _table(f"{counts}; t10: time within 10 % of the path flown (M1)", *columns)
    for name in names:
        row = results[name]
        out.add_row(
            _LABELS.get(name, name),
            f"{_time(row, 'm1_t10_lq_s')} / {_time(row, 'm1_t10_median_s')}",
            _time(row, "m1_t5_lq_s"),
            _share(row["survive_60"]),
            _time(row, "m2_t10_lq_s"),
            *(_number(row["p50_m"].get(s)) for s in _ERRORS),
            _number(row["p90_m"].get("60")),
            style="bold" if name == OURS else "",
        )
    return out


def _region_table(results: dict[str, Any], names: list[str]) -> Table:
    with_region = [name for name in names if any(value is not None for value in results[name]["coverage"].values())]
    rows = [results[name] for name in with_region]
    title = "tube: share inside (worst flight), half-axes along / cross / vertical [m]"
    out = _table(title, "look-ahead", *(_LABELS.get(name, name) for name in with_region))
    for s in results[names[0]]["coverage"]:
        out.add_row(f"{s} s", *(_inside(row, s) for row in rows))
    out.add_row("horizon hit rate", *(_share(row["horizon_hit_rate"]) for row in rows))
    out.add_row("horizon rank correlation", *(_number(row["horizon_rank_corr"], 2) for row in rows))
    out.add_row("horizon median [s]", *(_number(row["horizon_median_s"]) for row in rows))
    return out


def _inside(row: dict[str, Any], s: str) -> str:
    axes = " / ".join(_number(value) for value in row["half_axes_m"][s])
    return f"{_share(row['coverage'][s])} ({_share(row['coverage_worst_flight'][s])})   {axes}"


def _phases(phases: dict[str, Any]) -> Table:
    columns = ("phase", "starts", "t10 quartile [s]", "within 60 s", *_ERROR_COLUMNS)
    out = _table("ours by flight phase after the start", *columns)
    for name, row in phases.items():
        errors = (_number(row["p50_m"].get(s)) for s in _ERRORS)
        out.add_row(name, str(row["starts"]), _time(row, "m1_t10_lq_s"), _share(row["survive_60"]), *errors)
    return out


def _compare(compare: dict[str, Any]) -> Table:
    out = _table("ours minus each (95 % over flights)", "method", "t10 mean [s]", "p50 16 s [m]", "60 s [m]", "skill")
    for name, row in compare.items():
        cells = [_difference(row.get(key)) for key in ("t10_s", "p50_16_m", "p50_60_m")]
        skill = " ".join(_number(row.get(f"skill_{s}"), 2) for s in (16, 60))
        out.add_row(_LABELS.get(name, name), *cells, skill)
    return out


def _difference(row: dict[str, Any] | None) -> Text:
    if row is None or row["difference"] is None:
        return Text("–")
    span = "" if row["low"] is None else f" ({row['low']:+.1f} … {row['high']:+.1f})"
    return Text(f"{row['difference']:+.1f}{span} {row['verdict']}", style=_STYLES.get(row["verdict"], ""))


def notes(results: dict[str, Any], names: list[str]) -> list[str]:
    """Return notes on fallback predictions and excluded starts."""
    lines = [] if names else [_no_start_reason(results)]
    for name in names:
        counts = results[name]["made_by"]
        if others := ", ".join(f"{n} by {source}" for source, n in counts.items() if source != name):
            lines.append(f"{_LABELS.get(name, name)}: of {results[name]['starts']} predictions {others}")
    short = "mission shorter than a full start, scored as far as it goes (censored)"
    lines += [f"{flight}: {short}" for flight in results.get("run", {}).get("short", ())]
    for reason, row in results["apart"].items():
        time = _number(row["m1_t10_lq_s"])
        lines.append(f"excluded: {row['starts']} starts, {reason}; ours within 10 % for {time} s (quartile)")
    return lines


def _no_start_reason(results: dict[str, Any]) -> str:
    """Return the reasons why there are no figures, from the keys `apart` and `run` of the JSON."""
    run, excluded = results.get("run", {}), sum(row["starts"] for row in results["apart"].values())
    reasons = [f"{excluded} are excluded, see below"] if excluded else []
    if counted := run.get("counted", 0):
        reasons.append(f"{counted} lack a prediction of some method")
    if missed := run.get("silent", 0):
        reasons.append(f"{missed} on a mission have no prediction")
    return f"no start is included: {'; '.join(reasons) or _NO_STARTS}"


def _table(title: str, *columns: str) -> Table:
    out = Table(title=Text(title), title_justify="left", box=None, pad_edge=False, padding=(0, 1), header_style="cyan")
    for number, column in enumerate(columns):  # `Text` keeps brackets of units from being parsed as markup
        out.add_column(Text(column), justify="right" if number else "left", no_wrap=number == 0)
    return out


def _number(value: float | None, digits: int = 1) -> str:
    return "–" if value is None else f"{value:.0f}" if abs(value) >= 100 else f"{value:.{digits}f}"


def _time(row: dict[str, Any], key: str) -> str:
    """Format a quantile of times; `>`: the quantile lies beyond the longest follow-up time."""
    value, end = row[key], row["followed_s"]
    return f"> {end:.0f}" if value is not None and end is not None and value >= end else _number(value)


def _share(value: float | None) -> str:
    return "–" if value is None else f"{value:.0%}"


KEYS = {
    "t0": "start, (s,) [s since 1970]",
    "t": "predicted instants, (s, k) [s since 1970]",
    "latitude": "(s, k) [deg]",
    "longitude": "(s, k) [deg]",
    "altitude": "above mean sea level, (s, k) [m]",
    "covariance": "of the normal distribution equivalent to the tube, NED, (s, k, 3, 3) [m2]",
    "horizon": "confidence horizon, (s,) [s]",
    "flight": "recording and aircraft, (s,)",
    "uav": "id, (s,)",
    "apart": "reason for exclusion of a start; empty: included, (s,)",
    "ahead": "look-ahead, (k,) [s]",
    "path": "predicted, NED from the aircraft's first position; nan beyond its end, (s, k, 3) [m]",
    "tube": "half-axes along, cross, vertical, (s, k, 3) [m]",
    "spread": "standard deviations of the ensemble along, cross, vertical; nan without one, (s, k, 3) [m]",
    "flown": "flown positions, NED; nan where unknown or after an event, (s, k, 3) [m]",
    "length": "path flown so far, at least two seconds of ground speed, (s, k) [m]",
    "predicted_length": "the same along the prediction, (s, k) [m]",
    "group": "method / law / vehicle / parameters, (s,)",
    "method": "prediction method, (s,)",
}


def write_predictions(path: Path, cases: Sequence[EvaluationCase]) -> None:
    """Write our predictions and the flown positions; keys and units: `KEYS`."""
    rows = [_row(case) for case in cases]
    arrays = {name: np.array([row[name] for row in rows]) for name in KEYS if name != "ahead"}
    np.savez_compressed(path, ahead=cases[0].start.ahead, **arrays)  # type: ignore[arg-type]


def _row(case: EvaluationCase) -> dict[str, object]:
    start, forecast = case.start, case.start.forecasts[OURS]
    geodetic, valid = np.full(forecast.path.shape, np.nan), np.isfinite(forecast.path).all(axis=1)
    geodetic[valid] = to_geodetic(start.origin, forecast.path[valid]) * np.array([1e-7, 1e-7, 1e-3])
    assert forecast.tube is not None
    return {
        "t0": start.t,
        "t": start.t + start.ahead,
        "latitude": geodetic[:, 0],
        "longitude": geodetic[:, 1],
        "altitude": geodetic[:, 2],
        "covariance": covariance(forecast.path, forecast.tube).astype(np.float32),
        "horizon": forecast.horizon_s,
        "flight": start.flight,
        "uav": start.uav,
        "apart": case.exclusion,
        "path": forecast.path,
        "tube": forecast.tube,
        "spread": start.spread,
        "flown": case.positions,
        "length": case.length,
        "predicted_length": path_length(forecast.path, start.speed),
        "group": start.group,
        "method": forecast.source,
    }


def covariance(path: np.ndarray, tube: np.ndarray) -> np.ndarray:
    """Return the NED covariance of independent normal errors with the coverage of the tube, (k, 3, 3) [m2]."""
    sigma = tube / ndtri(0.5 + 0.5 * NOMINAL_COVERAGE ** (1 / 3))
    along = track_frame(path)
    axes = np.zeros((len(path), 3, 3))
    axes[:, :2, 0] = along
    axes[:, 0, 1], axes[:, 1, 1] = -along[:, 1], along[:, 0]
    axes[:, 2, 2] = 1.0
    return np.einsum("kij,kj,klj->kil", axes, sigma**2, axes)
