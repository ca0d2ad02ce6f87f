"""`python -m fleet.blind_test.limits RESULT…`: build the table of limits of detection from results of `fleet prove`.

    python -m fleet.blind_test.limits alfa_1.json alfa_2.json --aircraft "ALFA Carbon Z T-28"

The results of one call are of one aircraft and one reference; its source in the table is replaced, the others stay.
A result of simulated flights gives one source for each airframe. Limit of one effect and part:

    P(named first) = 1 / (1 + exp(-(a + b log size))),   limit: P = 0.9

a and b maximise the posterior with a log-normal prior of b, from which P = 0.1 to 0.9 takes a factor of 1.5 to 7 in
size: a few flights do not determine the slope. A limit beyond the largest size tried is none.
Source: Kuss, Jaekel & Wichmann 2005 (Bayesian inference for psychometric functions).
"""

import argparse
import json
import sys
from collections import defaultdict
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from scipy.optimize import minimize

from fleet.cli import run_command
from fleet.report.detection_limits import (
    MIN_FLIGHTS,
    PROBABILITY,
    TABLE,
    DetectionLimit,
    LimitSource,
    LimitTable,
    load_table,
)

_LOG_SLOPE, _LOG_SLOPE_STD = float(np.log(4.5)), 0.7  # prior of log b
_INTERCEPT_STD = 20.0
_MIN_FLIGHTS_OF_PART = 8  # fewer: all parts of the effect together
_SIMULATED = {"c172p": ("JSBSim Cessna 172P", 48.0), "small": ("JSBSim small fixed wing", 23.0)}  # name, cruise [m/s]
Trial = tuple[float, bool]  # magnitude, named


def magnitude(values: dict[str, float]) -> tuple[str, float] | None:
    """Return name and magnitude of the first parameter; of a ratio its distance from 1, of a rate none."""
    for name, value in values.items():
        if name in ("scale", "density_ratio"):
            return name, abs(value - 1.0)
        if name != "rate_per_s" and value:
            return name, abs(value)
    return None


def detection_limit(trials: Sequence[Trial]) -> float | None:
    """Return the magnitude named with 90 % probability; None where it is beyond the magnitudes tried."""
    if len(trials) < MIN_FLIGHTS:
        return None
    x, y = np.log([size for size, _ in trials]), np.array([named for _, named in trials])
    centre = float(x.mean())

    def cost(theta: np.ndarray) -> float:
        z = theta[0] + np.exp(theta[1]) * (x - centre)
        prior = (theta[0] / _INTERCEPT_STD) ** 2 + ((theta[1] - _LOG_SLOPE) / _LOG_SLOPE_STD) ** 2
        return float(np.logaddexp(0.0, np.where(y, -z, z)).sum() + 0.5 * prior)

    a, log_b = minimize(cost, np.array([0.0, _LOG_SLOPE])).x
    limit = centre + (np.log(PROBABILITY / (1.0 - PROBABILITY)) - a) / np.exp(log_b)
    return float(np.exp(max(limit, x.min()))) if limit <= x.max() else None


def limits_of(marks: Iterable[dict[str, Any]]) -> tuple[DetectionLimit, ...]:
    """Return the limits of every effect in the marks of `fleet prove --json`, by part where each part has enough."""
    trials: dict[tuple[str, str, str], list[Trial]] = defaultdict(list)
    for mark in marks:
        size = magnitude(mark["values"]) if mark["role"] == "single" else None
        if size is not None:
            trials[mark["concealed"][0], mark["part"], size[0]].append((size[1], mark["hit"]))
    for effect, _, parameter in [key for key, tried in trials.items() if len(tried) < _MIN_FLIGHTS_OF_PART]:
        for key in [key for key in trials if key[0] == effect and key[2] == parameter and key[1]]:
            trials[effect, "", parameter] += trials.pop(key)
    return tuple(
        DetectionLimit(
            effect=effect,
            part=part,
            parameter=parameter,
            limit=_rounded(detection_limit(tried)),
            largest=_rounded(max(size for size, _ in tried)) or 0.0,
            named=sum(named for _, named in tried),
            flights=len(tried),
        )
        for (effect, part, parameter), tried in sorted(trials.items())
    )


def _rounded(x: float | None) -> float | None:
    return None if x is None else float(f"{x:.3g}")


def sources_of(results: Sequence[dict[str, Any]], aircraft: str) -> list[LimitSource]:
    """Return the source of injected results, or one for each airframe of simulated ones.

    Raises:
        ValueError: if the results are of different references or lack a name; the text names the remedy.
    """
    references = {result["injected"]["reference"] if result["injected"] else "simulated" for result in results}
    if len(references) != 1:
        raise ValueError(f"found results of {', '.join(sorted(references))}, expected one reference; name them apart")
    made, seeds = f"{datetime.now(UTC):%Y-%m-%d}", tuple(sorted({int(result["seed"]) for result in results}))
    marks = [mark for result in results for mark in result["marks"]]
    single = [mark for mark in marks if mark["role"] == "single"]
    if references == {"simulated"}:
        parts = [(*_SIMULATED[name], [m for m in single if m["airframe"] == name]) for name in _SIMULATED]
        return [
            LimitSource(name, "other flights", True, speed, len(of), len(of), seeds, made, limits_of(of))
            for name, speed, of in parts
            if of
        ]
    if not aircraft:
        raise ValueError("--aircraft: found none, expected a name; the results are of recordings")
    recordings = {name: facts for result in results for name, facts in result["injected"]["sources"].items()}
    speed = float(np.median([facts["Va"] for facts in recordings.values()]))
    vane = all(facts["vane"] for facts in recordings.values())
    (reference,) = references
    counts = len(single), len(recordings)
    return [LimitSource(aircraft, reference, vane, speed, *counts, seeds, made, limits_of(single))]


def _run(args: argparse.Namespace) -> int:
    try:
        results = [json.loads(path.read_text()) for path in args.file]
        new = sources_of(results, args.aircraft)
    except (KeyError, TypeError, json.JSONDecodeError) as error:
        raise ValueError(f"found {error!r}, expected results of `fleet prove --json`; name those") from None
    replaced = {(source.aircraft, source.reference) for source in new}
    rest = [s for s in load_table(args.out).sources if (s.aircraft, s.reference) not in replaced]
    sources = sorted([*rest, *new], key=lambda source: (source.aircraft, source.reference))
    encoded = msgspec.json.encode(LimitTable(sources=tuple(sources)))
    args.out.write_bytes(msgspec.json.format(encoded, indent=1) + b"\n")
    reached = sum(one.limit is not None for source in new for one in source.limits)
    print(f"{args.out.name}: {reached} limits of {sum(len(source.limits) for source in new)} effects and parts reached")
    return 0


def main(argv: list[str] | None = None) -> int:
    """Build the table, or replace sources in it."""
    parser = argparse.ArgumentParser(prog="python -m fleet.blind_test.limits", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("file", nargs="+", type=Path, metavar="RESULT")
    parser.add_argument("--aircraft", default="", help="name of the aircraft of injected flights")
    parser.add_argument("--out", type=Path, default=TABLE, help="table to change")
    return run_command("limits", _run, parser.parse_args(argv))


if __name__ == "__main__":
    sys.exit(main())
