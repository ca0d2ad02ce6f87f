"""Fit the weights of the decision on flights with known labels, by multinomial logistic regression.

    python -m tests.bench.mismatch.fit_decision --cache cache --sets open exam/26011 --unseen exam/27102 --out out.json
    python -m tests.bench.mismatch.fit_decision --cache cache --unseen exam/27102 --out out.json   # weights as they are

The probability that the search misses the cause is a logistic function of the log odds of the most probable outcome,
fitted to the classes named on flights that the weights were not fitted on (`--unseen`).

Sets as in `tests.bench.mismatch.offline`. Every explanation that the search found is one outcome of its flight; right
are those with exactly the concealed effects and surfaces, of a control none, of an effect outside the catalogue every
change without an effect. The prior of each weight is normal about `START`. The printed figures are from four-fold
cross-validation over the flights.
"""

import argparse
import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
from scipy.optimize import minimize

from tests.bench.mismatch.offline import Cache, cases, source_hash
from twin_worker.diagnosis.baseline.calibrate import calibrate
from twin_worker.diagnosis.data.card import read_card
from twin_worker.diagnosis.data.flight import FlightData, read_flights
from twin_worker.diagnosis.inference.diagnose import NAMED_PROBABILITY
from twin_worker.diagnosis.inference.isolation.decision import decide, outcome_log_odds, posterior
from twin_worker.diagnosis.inference.isolation.evidence import (
    NEVER_MISSED,
    TURBULENCE,
    DecisionTable,
    EvidenceTerms,
    Explanation,
    Weights,
    load_table,
)
from twin_worker.diagnosis.inference.isolation.search import Search
from twin_worker.diagnosis.inference.isolation.whitened_residuals import WhitenedResiduals
from twin_worker.diagnosis.model.baseline import Baseline
from twin_worker.diagnosis.model.residual import ModelledFlight
from twin_worker.diagnosis.model.weather import own_weather

CHANGES = ("odd", "shift", "one", "tone", TURBULENCE)
START = {  # mean and standard deviation of the prior; rows and error as logarithms
    "rows_per_sample": (np.log(25.0), 0.7),
    "model_error": (np.log(0.005), 1.0),
    "nats_per_parameter": (1.0, 0.7),
    "nats_per_onset": (1.5, 1.0),
    "chance": (1.0, 0.7),
    "block_weight": (0.1, 0.3),
    "further": ((-3.0, -3.0, -3.0), 2.0),
    "changes": ((-5.0,) * len(CHANGES), 3.0),
    "beside": (0.0, 3.0),
}
_FLOOR = 0.02  # probability of a wrong label: bounds the loss of one flight
_FOLDS = 4


class LabelledFlight(NamedTuple):
    """One flight with its concealed effects and its explanations, of which `right` are true; the last entry is none."""

    name: str
    role: str
    concealed: frozenset[str]
    explanations: list[Explanation]
    right: np.ndarray


def explained(flight: FlightData, base: Baseline) -> list[Explanation]:
    """Search the explanations of one flight."""
    modelled = ModelledFlight(flight, base)
    search = Search(WhitenedResiduals(modelled, own_weather(modelled)))
    search.run()
    return search.explanations


def right_explanations(label: dict[str, Any], explanations: Sequence[Explanation]) -> np.ndarray:
    """Return which explanations are true, and last whether none is, (m + 1,) bool."""
    names = frozenset(effect["name"] for effect in label["effects"])
    surface = {effect["name"]: effect.get("surface", "") for effect in label["effects"]}
    out = []
    for one in explanations:
        if label["role"] == "unknown":
            out.append(one.anomaly is not None)
            continue
        if label["role"] == "control":
            out.append(one.anomaly is None and not one.names)
            continue
        targets = {member.hypothesis.effect.name: member.hypothesis.target for member in one.members}
        on_surface = all(not surface.get(name) or target == surface[name] for name, target in targets.items())
        alone = one.anomaly is None and len(one.members) + (one.change == TURBULENCE) == len(names)
        out.append(alone and one.names == names and on_surface)
    return np.array([*out, label["role"] == "control"])


def weights(x: np.ndarray) -> Weights:
    """Return the weights at a point of the search."""
    rows, error, *rest = x.tolist()
    changes = dict(zip(CHANGES, rest[7:-1], strict=True))
    further = rest[4], rest[5], rest[6]
    return Weights(float(np.exp(rows)), float(np.exp(error)), *rest[:4], further, changes, rest[-1])


def fit(flights: Sequence[LabelledFlight]) -> Weights:
    """Maximise the posterior of the weights."""
    mean = np.concatenate([np.atleast_1d(entry[0]) for entry in START.values()])
    std = np.concatenate([np.full(np.size(entry[0]), entry[1]) for entry in START.values()])
    terms = [(EvidenceTerms(flight.explanations), flight.right) for flight in flights]

    def loss(x: np.ndarray) -> float:
        at = weights(x)
        right = [posterior(evidence.log_evidence(at))[which].sum() for evidence, which in terms]
        return float(-np.log(_FLOOR + (1.0 - _FLOOR) * np.array(right)).sum() + 0.5 * (((x - mean) / std) ** 2).sum())

    return weights(minimize(loss, mean, method="L-BFGS-B", options={"maxiter": 80}).x)


class ClassStatement(NamedTuple):
    """Probability of a named class, given that the search found the cause, and whether an effect of it is concealed."""

    log_odds: float
    probability: float
    true: bool


def class_statements(flight: LabelledFlight, at: Weights) -> list[ClassStatement]:
    """Return the named classes of one flight, without validation on held-out data."""
    at = msgspec.structs.replace(at, missed=NEVER_MISSED)
    decision = decide(flight.explanations, at)
    if decision.best is None or decision.effects <= NAMED_PROBABILITY:
        return []
    log_odds = outcome_log_odds(flight.explanations, posterior(EvidenceTerms(flight.explanations).log_evidence(at)))
    out = []
    for member in decision.best.members:
        names = {one.hypothesis.effect.name for one in (member, *member.rivals)}
        out.append(ClassStatement(log_odds, decision.probability(names), not flight.concealed.isdisjoint(names)))
    return out


def fit_missed(statements: Sequence[ClassStatement]) -> tuple[float, float, float]:
    """Fit `Weights.missed` by maximum likelihood; its largest log odds are those of the statements."""
    log_odds, p, true = np.array(statements, float).T

    def loss(x: np.ndarray) -> float:
        stated = np.clip(p / (1.0 + np.exp(-x[0] - x[1] * log_odds)), 1e-6, 1.0 - 1e-6)
        return -float(np.where(true > 0.5, np.log(stated), np.log1p(-stated)).sum())

    intercept, slope = minimize(loss, [1.0, 0.3], method="Nelder-Mead").x.tolist()
    return intercept, slope, float(log_odds.max())


def cross_validated(flights: Sequence[LabelledFlight]) -> None:
    """Print the decisions of four-fold cross-validation."""
    fold = np.random.default_rng(1).integers(_FOLDS, size=len(flights))
    counts: dict[str, list[int]] = {}
    named: list[ClassStatement] = []
    for k in range(_FOLDS):
        at = fit([flight for flight, other in zip(flights, fold, strict=True) if other != k])
        for flight in (one for one, own in zip(flights, fold, strict=True) if own == k):
            decision = decide(flight.explanations, at)
            probability = posterior(EvidenceTerms(flight.explanations).log_evidence(at))
            rows = {" + ".join(sorted(names)) or "none": p for names, p in decision.sets.items()}
            rows["unknown"] = decision.unmodelled
            ranked = sorted(rows, key=lambda name: -rows[name])[:3]
            true = probability[flight.right].sum()
            text = ", ".join(f"{name} {rows[name]:.2f}" for name in ranked)
            print(f"{flight.role:8} {flight.name:14} truth {true:.2f}: {text}")
            row = counts.setdefault(flight.role, [0, 0])
            row[0] += true >= max(rows.values()) - 1e-6
            row[1] += 1
            named += class_statements(flight, at)
    stated, true = (sum(values) for values in ([one[k] for one in named] for k in (1, 2)))
    print(counts, f"named classes: {len(named)}, stated {stated:.1f}, true {true:.0f}")


def main() -> int:
    """Fit, cross-validate and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", nargs="+", default=[], help="fit the weights on these; without it they stay")
    parser.add_argument("--unseen", nargs="+", required=True, help="other sets, for the probability of a missed cause")
    parser.add_argument("--recordings", type=Path, default=os.environ.get("PARAUAV_RECORDINGS", "recordings"))
    parser.add_argument("--cache", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    cache = Cache(args.cache)
    table = load_table()
    if args.sets:
        flights = labelled_flights(args.sets, args.recordings, cache)
        cross_validated(flights)
        roles = [
            sum(flight.role == role for flight in flights) for role in ("control", "single", "compound", "unknown")
        ]
        provenance = {
            "fitted_on": ", ".join(Path(name).name for name in args.sets),
            "flights": "{} controls, {} single, {} compound, {} unknown".format(*roles),
            "command": "python -m tests.bench.mismatch.fit_decision",
        }
        fitted = msgspec.structs.replace(fit(flights), fault_odds=sum(roles[1:]) / roles[0])
        table = DecisionTable(provenance, fitted)
    unseen = labelled_flights(args.unseen, args.recordings, cache)
    named = [statement for flight in unseen for statement in class_statements(flight, table.weights)]
    missed = fit_missed(named)
    print(f"{len(named)} classes named on {len(unseen)} unseen flights: missed {missed}")
    table.provenance["missed_fitted_on"] = f"{', '.join(Path(name).name for name in args.unseen)}: {len(named)} classes"
    table = DecisionTable(table.provenance, msgspec.structs.replace(table.weights, missed=missed))
    args.out.write_bytes(msgspec.json.format(msgspec.json.encode(table), indent=1) + b"\n")
    return 0


def labelled_flights(sets: Sequence[str], recordings: Path, cache: Cache) -> list[LabelledFlight]:
    """Search the explanations of all flights of some sets, or take them from the cache."""
    flights = []
    version = source_hash("baseline", "model", "data", "inference/isolation")
    for name in sets:
        found, nominal = cases(name, recordings, held_out=False)
        for case in found:
            files, card_path = nominal[case.base]
            card = read_card(card_path)
            read = partial(cached_flights, cache, case.base, card_path)
            nominal_flights = [flight for path in files for flight in read(path)]
            base = cache.get(f"base-{case.base}-{version}", partial(calibrate, nominal_flights, card))
            for flight in read(case.path):
                key = f"explained-{case.base}-{flight.name}-{version}"
                explanations = cache.get(key, partial(explained, flight, base))
                right = right_explanations(case.label, explanations)
                concealed = frozenset(effect["name"] for effect in case.label["effects"])
                flights.append(LabelledFlight(flight.name, case.label["role"], concealed, explanations, right))
    return flights


def cached_flights(cache: Cache, base: str, card_path: Path, path: Path) -> list[FlightData]:
    """Read a recording, or its cached flights."""
    return cache.get(f"{base}-read-{path.name.split('.')[0]}", partial(read_flights, path, read_card(card_path)))


if __name__ == "__main__":
    raise SystemExit(main())
