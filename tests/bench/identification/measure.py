"""Run methods over the windows of a scenario: scores, time, failures, and what they mean together."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .flight import Case, Method, Model, Oracle
from .score import KEYS, ceiling, scores
from .windows import Span

Rows = list[dict[str, float]]
_FAILED = dict.fromkeys(KEYS, -100.0)


@dataclass
class Result:
    """What one method did on one scenario.

    Attributes:
        rows: scores of every window, the keys of `score.KEYS` [%]
        cold, warm: time of one identification of both axes, first in its flight or later [ms]
        trouble: why windows failed, each reason once
        failed: windows in which nothing, or only one axis, came of it
    """

    rows: Rows = field(default_factory=list)
    cold: list[float] = field(default_factory=list)
    warm: list[float] = field(default_factory=list)
    trouble: list[str] = field(default_factory=list)
    failed: int = 0


def run(make: Callable[[], Method], cases: list[Case], laid: list[list[Span]]) -> Result:
    """Identify and score on every window; whatever a method throws, even SystemExit, is a failed window."""
    result = Result()
    for case, spans in zip(cases, laid, strict=True):
        method = make()
        for k, span in enumerate(spans):
            try:
                model, ms = _timed(method, case, span)
                row = scores(model, case.flight, span.at, span.stop)
            except (Exception, SystemExit) as error:
                _note(result, [f"{type(error).__name__}: {error}"])
                result.rows.append(dict(_FAILED))
                continue
            (result.warm if k else result.cold).append(ms)
            _note(result, getattr(model, "trouble", []))
            result.rows.append(row)
    return result


def _timed(method: Method, case: Case, span: Span) -> tuple[Model, float]:
    """Identify; give the model and the processor time [ms]: its own account, where it keeps one."""
    known = case.flight.part(0, span.at)
    began = time.process_time()
    model = method.identify(known, span.start)
    ms = 1e3 * (time.process_time() - began)
    return model, getattr(model, "ms", ms)


def _note(result: Result, trouble: list[str]) -> None:
    result.failed += bool(trouble)
    result.trouble += [said[:200] for said in trouble if said[:200] not in result.trouble]


def foretold(cases: list[Case], laid: list[list[Span]]) -> Result | None:
    """Score the oracles; None where a case has none."""
    result = Result()
    for case, spans in zip(cases, laid, strict=True):
        if case.oracle is None:
            return None
        oracle: Oracle = case.oracle
        result.rows += [ceiling(oracle, case.flight, span.at, span.stop) for span in spans]
    return result


def summary(result: Result) -> dict[str, Any]:
    """Give medians, quartiles, times and failures under the keys of the file."""
    columns = {key: np.array([row[key] for row in result.rows]) for key in KEYS}
    out: dict[str, Any] = {key: _number(np.nanmedian(values)) for key, values in columns.items()}
    warm = result.warm or result.cold
    out |= {"ms_cold": _median(result.cold), "ms_warm": _median(warm), "n": len(result.rows)}
    out |= {f"{key}_quartiles": [_number(q) for q in np.nanpercentile(v, [25, 75])] for key, v in columns.items()}
    return out | {"failed": result.failed, "trouble": result.trouble}


def over(result: Result, rival: Result, key: str) -> dict[str, Any]:
    """Give the paired difference to a rival, window by window: median, quartiles, share of windows won."""
    mine, theirs = (np.array([row[key] for row in r.rows]) for r in (result, rival))
    low, middle, high = np.nanpercentile(mine - theirs, [25, 50, 75])
    won = float(np.mean(mine > theirs))
    return {"median": _number(middle), "quartiles": [_number(low), _number(high)], "won": round(won, 3)}


def _median(values: list[float]) -> float | None:
    return round(float(np.median(values)), 3) if values else None


def _number(value: float) -> float | None:
    return round(float(value), 2) if np.isfinite(value) else None
