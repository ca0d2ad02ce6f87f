"""Grade reports against their labels: names, location, onset, parameters and standard deviations; score of all."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import zip_longest
from statistics import median
from typing import Any

import numpy as np

from fleet.blind_test.examiner import NOT_IN_FORCES, ForceCheck
from fleet.blind_test.rates import Statement, median_interval, poisson, score_probabilities, wilson

OUTPUT_CHANNEL = "autopilot output"  # of a report whose fault is in the output of the controller
MAX_CALIBRATION_ERROR = 0.05  # of stated probabilities [-]
_ACTUATOR = ("actuator", "pitch", "roll", "yaw", OUTPUT_CHANNEL)
_LOADS = ("lift", "drag", "force_x", "force_z")
CHANNELS: Mapping[str, tuple[str, ...]] = {  # effect: correct channels
    **dict.fromkeys(("wind_steady", "wind_shear", "turbulence", "gust_discrete", "updraft"), ("air",)),
    "air_density": ("air", "dynamic_pressure"),
    **dict.fromkeys(("actuator_lag", "actuator_delay", "actuator_rate_limit", "actuator_deadband"), _ACTUATOR),
    **dict.fromkeys(("actuator_saturation", "actuator_offset", "actuator_stuck"), _ACTUATOR),
    "control_effectiveness_loss": _ACTUATOR,
    **dict.fromkeys(("prop_torque", "roll_damping"), ("roll",)),
    "pitch_damping": ("pitch",),
    "yaw_damping": ("yaw",),
    "p_factor": ("yaw", "pitch"),
    "slipstream_tail": ("pitch", "yaw"),
    "thrust_loss": ("thrust", "force_x", OUTPUT_CHANNEL),
    "thrust_asymmetry": ("yaw", "thrust"),
    "drag_increase": ("drag", "force_x"),
    **dict.fromkeys(("icing", "flap_deployed", "stall", "ground_effect"), _LOADS),
    "mass_change": ("mass", "force_z", "lift"),
    "cg_shift": ("pitch", "mass", "roll"),
    **dict.fromkeys(("airspeed_scale", "airspeed_bias"), ("airspeed",)),
    "gps_latency": ("gps",),
    "imu_misalignment": ("imu",),
    "gyro_bias": ("gyro", "imu"),
    "accel_bias": ("accel", "imu"),
    "heading_bias": ("heading",),
    "baro_bias": ("baro",),
    **dict.fromkeys(("motor_thrust_loss", "motor_lag"), ("actuator", "thrust")),
}
_DIRECTION_SCALE_DEG = 45.0  # direction error that counts as an error of 100 %
_MIN_RATIO_CHANGE = {"density_ratio": 0.01, "scale": 0.01}  # smallest |ratio - 1| used as denominator


@dataclass(frozen=True)
class ScoredParameter:
    """One parameter: name, true value, reported value and its standard deviation; None where not reported."""

    name: str
    truth: float
    told: float | None
    sigma: float | None

    @property
    def error(self) -> float:
        """Return the error relative to the true value; directions relative to 45 degrees, small angles to 1 degree."""
        if self.told is None:
            return 1.0
        if self.name == "from_deg":
            return self.deviation / _DIRECTION_SCALE_DEG
        if self.name in _MIN_RATIO_CHANGE:
            return self.deviation / max(abs(self.truth - 1.0), _MIN_RATIO_CHANGE[self.name])
        floor = 1.0 if self.name.endswith("_deg") and self.name != "bias_deg" else 1e-6
        return self.deviation / max(abs(self.truth), floor)

    @property
    def deviation(self) -> float:
        """Return |reported - true|; directions modulo 360 degrees."""
        difference = (self.told or 0.0) - self.truth
        return abs((difference + 180.0) % 360.0 - 180.0 if self.name == "from_deg" else difference)

    @property
    def covered(self) -> bool | None:
        """Return whether the true value lies within two standard deviations; None where none is reported."""
        return self.deviation <= 2.0 * self.sigma if self.sigma else None


@dataclass(frozen=True)
class GradedFlight:
    """Grade of one flight.

    Attributes:
        flight, airframe, role: nominal, control, single, compound or unknown
        concealed, named: names of the true and of the reported effects, reported best first
        verdict: none, named or unknown; sentence: summary of the report
        rivals: equivalent effects of each named one
        late: reported minus true onset and its tolerance, for each effect [s]
        sizes: parameters of correctly named effects
        located, surfaces: whether channel and surface are correct, for correctly named effects
        force: force prediction of the named effects, evaluated again; None where forces do not show them
        before, after: residual on held-out blocks as the report states it, None where nothing was named
        statements: stated probability of each reported class, and whether one of its effects is concealed
        name_statements: the same of the first name of each class alone
        acts: strength of the effect in standard deviations of the sensors
        values: concealed parameters of the first effect; part: its surface or axis, or empty
    """

    flight: str
    airframe: str
    role: str
    concealed: tuple[str, ...]
    named: tuple[str, ...]
    verdict: str
    sentence: str
    rivals: tuple[tuple[str, ...], ...] = ()
    late: tuple[tuple[float, float], ...] = ()
    sizes: tuple[tuple[str, ScoredParameter], ...] = ()
    located: tuple[bool, ...] = ()
    surfaces: tuple[bool, ...] = ()
    force: ForceCheck | None = None
    before: float | None = None
    after: float | None = None
    statements: tuple[Statement, ...] = ()
    name_statements: tuple[Statement, ...] = ()
    acts: Sequence[Mapping[str, Any]] = ()
    values: Mapping[str, float] = field(default_factory=dict)
    part: str = ""

    @property
    def reported_names(self) -> tuple[str, ...]:
        """Return the reported names, else `unknown` or `nothing`."""
        return self.named or ("unknown" if self.verdict == "unknown" else "nothing",)

    @property
    def hit(self) -> bool:
        """Return whether the report is correct for the role of the flight."""
        if self.role == "control":
            return not self.named and self.verdict != "unknown"
        if self.role == "unknown":
            return self.verdict == "unknown"
        if self.role == "single":
            return self.named[:1] == self.concealed
        return set(self.named) == set(self.concealed)

    @property
    def in_class(self) -> bool:
        """Return whether a single effect is the first name or equivalent to it."""
        return self.hit or (bool(self.named) and self.concealed[0] in self.rivals[0])


def grade(
    flight: str, label: Mapping[str, Any], report: Mapping[str, Any] | None, force: ForceCheck | None = None
) -> GradedFlight:
    """Grade one report; a flight without a report was rejected.

    Args:
        flight: name
        label: what is concealed in it
        report: as `fleet diagnose --json` writes it
        force: force prediction of the named effects, evaluated against the recording
    """
    rejected: Mapping[str, Any] = {"verdict": "none", "sentence": "no report: the flight was rejected", "named": []}
    diagnosis = rejected if report is None or report["verdict"] == "refused" else report
    named = tuple(name.split(":")[0] for name in diagnosis["named"])
    onset_errors, sizes, located, surfaces = [], [], [], []
    of_classes, of_names = _statements(label, named, diagnosis)
    for effect in label["effects"]:
        if effect["name"] not in named:
            continue
        i = named.index(effect["name"])
        location = diagnosis["located"][i]
        located.append(location["channel"] in CHANNELS[effect["name"]])
        if effect.get("surface"):
            surfaces.append(location["surface"] == effect["surface"])
        if effect.get("t0") and location["segments"]:
            onset_errors.append((location["segments"][0][0] - effect["t0"], 5.0 + 0.2 * effect.get("ramp_s", 0.0)))
        values, sigma = (_by_label_name(diagnosis[key][i]) for key in ("parameters", "sigma"))
        for name, truth in effect["params"].items():
            sizes.append((effect["name"], ScoredParameter(name, truth, values.get(name), sigma.get(name))))
    return GradedFlight(
        flight=flight,
        airframe=label["airframe"],
        role=label["role"],
        concealed=tuple(effect["name"] for effect in label["effects"]),
        named=named,
        verdict=diagnosis["verdict"],
        sentence=diagnosis["sentence"],
        rivals=tuple(tuple(names) for names in diagnosis.get("equivalents", ())),
        late=tuple(onset_errors),
        sizes=tuple(sizes),
        located=tuple(located),
        surfaces=tuple(surfaces),
        force=force if _is_in_forces(named, diagnosis) else None,
        before=diagnosis.get("fit_before") if named else None,
        after=diagnosis.get("fit_after") if named else None,
        statements=of_classes,
        name_statements=of_names,
        acts=label.get("acts", ()),
        values=label["effects"][0]["params"] if label["effects"] else {},
        part=next((effect.get("surface") or effect.get("of") or "" for effect in label["effects"]), ""),
    )


def _is_in_forces(named: tuple[str, ...], diagnosis: Mapping[str, Any]) -> bool:
    """Return whether a prediction of forces shows one of the named effects; faults of outputs are in none."""
    channels = [place["channel"] for place in diagnosis.get("located", ())]
    return any(
        name not in NOT_IN_FORCES and channel != OUTPUT_CHANNEL for name, channel in zip(named, channels, strict=False)
    )


def _by_label_name(values: Mapping[str, float]) -> dict[str, float]:
    """Return reported values by the names of labels, which are relative too where no airframe is given."""
    return {name.removesuffix("_relative"): x for name, x in values.items()}


def _statements(
    label: Mapping[str, Any], named: tuple[str, ...], diagnosis: Mapping[str, Any]
) -> tuple[tuple[Statement, ...], tuple[Statement, ...]]:
    """Return the stated probabilities of named and suspected classes, and of their first names alone.

    `posterior` is the probability that an effect of the class acts, `name_posterior` that of its first name. Where the
    report states none there is no statement.
    """
    columns = (named, *(diagnosis.get(key) or () for key in ("equivalents", "posterior", "name_posterior")))
    rows = list(zip_longest(*columns)) if named else []
    rows += [
        (one["name"].split(":")[0], one.get("equivalents"), one.get("posterior"), one.get("name_posterior"))
        for one in diagnosis.get("suspects", ())
    ]
    concealed = {effect["name"] for effect in label["effects"]}
    of_classes = [(p, not concealed.isdisjoint((name, *(rivals or ())))) for name, rivals, p, _ in rows]
    of_names = [(p, name in concealed) for name, _, _, p in rows]
    return _valid(of_classes), _valid(of_names)


def _valid(pairs: Iterable[tuple[float | None, bool]]) -> tuple[Statement, ...]:
    return tuple(Statement(float(p), true) for p, true in pairs if p is not None and 0.0 <= p <= 1.0)


_NEAR_EQUIVALENT = {("thrust_asymmetry", "thrust_loss"), ("stall", "drag_increase"), ("ground_effect", "drag_increase")}
_ONSET_TOLERANCE_S = 5.0

REQUIREMENTS = {  # score: bound and meaning
    "top1_naming": (0.88, "single effects named first"),
    "in_class": (0.94, "single effects named or in the reported equivalence class"),
    "false_alarm": (-1 / 60, "controls with an alarm"),
    "compound_recall": (0.85, "effects of compound flights named"),
    "compound_extra_per_flight": (-0.2, "wrong names per compound flight"),
    "unknown_abstained": (12 / 14, "effects outside the catalogue reported as unknown"),
    "magnitude_median_err": (-0.05, "relative error of reported parameters, median"),
    "onset_within_5s": (0.9, "onsets reported within 5 s"),
    "sigma2_coverage": (0.85, "true values within two standard deviations"),
    "class_size_median": (-2.0, "size of the equivalence class, median"),
    "named_improving": (1.0, "named flights whose error of predicted forces decreases on held-out blocks"),
    "named_gain_proven": (1.0, "of them with an interval of the decrease that excludes zero"),
}
"""Bounds: a positive value is a minimum, a negative value the negative of a maximum."""

REPORTED = {  # score without a bound: meaning
    "named_predicting": "of them with forces predicted better than by a constant",
    "surface_ok": "correct names with the correct surface",
    "onset_median_err_s": "error of the onset, median [s]",
}


PROBABILITIES = {"probabilities": "probability of a class", "name_probabilities": "probability of its first name"}
"""Scores of stated probabilities: meaning."""


def score_rows(scores: Mapping[str, Any]) -> Iterator[tuple[bool | None, str, str, str]]:
    """Format every score: whether it meets its requirement, if any, meaning, requirement, value with interval."""
    for name, (required, meaning) in REQUIREMENTS.items():
        bound = f"at most {-required:.3g}" if required < 0 else f"at least {required:.3g}"
        yield meets_requirement(name, scores[name]), meaning, bound, score_text(scores, name)
    for name, meaning in REPORTED.items():
        yield None, meaning, "", score_text(scores, name)
    for key, meaning in PROBABILITIES.items():
        if (stated := scores[key]) is not None:
            error = stated["calibration_error"]
            exact = (
                f"exact probabilities: {stated['calibrated_median']:.3f}, 95 % below {stated['calibrated_limit']:.3f}"
            )
            text = f"{error:.3f} ({exact}), Brier score {stated['brier']:.3f}, {stated['n']} stated"
            bound = f"at most {MAX_CALIBRATION_ERROR:g}"
            yield error <= MAX_CALIBRATION_ERROR, f"calibration error, {meaning}", bound, text


def score_text(scores: Mapping[str, Any], name: str) -> str:
    """Format one score with its 95 % interval and its counts."""
    if scores[name] is None:
        return "no data"
    interval, counts = scores["intervals"].get(name), scores["counts"].get(name)
    text = f"{scores[name]:.3g}"
    text += f" ({interval[0]:.2g} to {interval[1]:.2g})" if interval else ""
    return text + (f", {counts[0]} of {counts[1]}" if counts else "")


def meets_requirement(name: str, value: float | None) -> bool:
    """Return whether a score meets its requirement; a score without data does."""
    required = REQUIREMENTS[name][0]
    return value is None or (value <= -required + 1e-9 if required < 0 else value >= required - 1e-9)


def score(results: Sequence[GradedFlight]) -> dict[str, Any]:
    """Compute all scores, their 95 % intervals and counts; None where no flight contributes."""
    roles = ("control", "single", "compound", "unknown")
    by_role = {role: [result for result in results if result.role == role] for role in roles}
    parameters = [parameter for one in results for _, parameter in one.sizes]
    onset_errors = [pair for one in results for pair in one.late]
    fits = [one.force for one in results if one.force is not None]
    extra = [len(set(one.named) - set(one.concealed)) for one in by_role["compound"]]
    rates = {
        "top1_naming": [one.hit for one in by_role["single"]],
        "in_class": [one.in_class for one in by_role["single"]],
        "channel_ok": [ok for one in results for ok in one.located],
        "surface_ok": [ok for one in results for ok in one.surfaces],
        "onset_ok": [abs(dt) <= tolerance for dt, tolerance in onset_errors],
        "onset_within_5s": [abs(dt) <= _ONSET_TOLERANCE_S for dt, _ in onset_errors],
        "false_alarm": [not one.hit for one in by_role["control"]],
        "compound_recall": [name in one.named for one in by_role["compound"] for name in one.concealed],
        "unknown_abstained": [one.hit for one in by_role["unknown"]],
        "sigma2_coverage": [bool(size.covered) for size in parameters if size.covered is not None],
        "named_improving": [fit.improves for fit in fits],
        "named_gain_proven": [fit.proven for fit in fits],
        "named_predicting": [fit.predicts for fit in fits],
    }
    medians = {
        "onset_median_err_s": [abs(dt) for dt, _ in onset_errors],
        "magnitude_median_err": [size.error for size in parameters],
        "heldout_improvement_median": [fit.gain for fit in fits],
        "class_size_median": [1.0 + len(rivals) for one in results if one.named for rivals in one.rivals],
    }
    intervals = {name: wilson(sum(outcomes), len(outcomes)) for name, outcomes in rates.items()}
    intervals |= {name: median_interval(values) for name, values in medians.items()}
    intervals["compound_extra_per_flight"] = poisson(sum(extra), len(extra))
    of_classes = score_probabilities([statement for one in results for statement in one.statements])
    of_names = score_probabilities([statement for one in results for statement in one.name_statements])
    errors = medians["magnitude_median_err"]
    return {
        **{name: sum(outcomes) / len(outcomes) if outcomes else None for name, outcomes in rates.items()},
        **{name: _median(values) for name, values in medians.items()},
        "spurious_extra_names": sum(
            name not in one.concealed and (one.concealed[0], name) not in _NEAR_EQUIVALENT
            for one in by_role["single"]
            for name in one.named[1:]
        ),
        "compound_extra": sum(extra),
        "compound_extra_per_flight": sum(extra) / len(extra) if extra else None,
        "magnitude_p90_err": float(np.percentile(errors, 90)) if errors else None,
        "intervals": intervals,
        "counts": {name: (sum(outcomes), len(outcomes)) for name, outcomes in rates.items() if outcomes},
        "probabilities": asdict(of_classes) if of_classes else None,
        "name_probabilities": asdict(of_names) if of_names else None,
        "n": {kind: len(flights) for kind, flights in by_role.items()}
        | {"sizes": len(parameters), "onsets": len(onset_errors)},
    }


def _median(values: Iterable[float]) -> float | None:
    items = list(values)
    return float(median(items)) if items else None
