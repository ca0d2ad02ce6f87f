"""Diagnose a flight against its own past: find changes after a trusted first part, and loss of tracking."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fleet.effects import catalogue
from fleet.frames import G
from fleet.process.sanitise import format_below
from twin_worker.diagnosis.baseline.air_movement import energy_evidence
from twin_worker.diagnosis.baseline.past import CONTEXT_S, calibrate_past, part_after, part_before
from twin_worker.diagnosis.data.card import AircraftCard
from twin_worker.diagnosis.data.flight import DT, FlightData
from twin_worker.diagnosis.inference.diagnose import diagnose
from twin_worker.diagnosis.inference.output_faults import (
    POSTERIOR,
    PRIOR,
    FrozenOutput,
    find_frozen_outputs,
    with_frozen_outputs,
)
from twin_worker.diagnosis.inference.report import Report, ReportOutcome, with_sentence
from twin_worker.diagnosis.model.baseline import Baseline, exclude_equations

_AIR = "air"  # channel of the effects that are weather
ENERGY, TURN, PITCH = "energy held", "turn by bank", "pitch attitude"
_ENERGY_EFFECTS = ("thrust_loss", "drag_increase", "battery_sag", "icing", "flap_deployed")
_MEAN_S = 2.0  # running mean
_MIN_DURATION_S = 2.0  # a shorter deviation is a gust
_MIN_OUT_SHARE = 0.7  # least share of the remaining flight outside the range
_MARGIN_SHARE = 0.5  # margin above and below the past range, as a share of it
_RANGE_PERCENTILES = 5.0, 95.0  # percentiles of the past range
_MIN_MARGIN = {ENERGY: 4.0, TURN: np.radians(4.0), PITCH: np.radians(6.0)}  # least excess [m, rad/s, rad]


def find_tracking_loss(flight: FlightData, until: float) -> tuple[str, float] | None:
    """Return the first signal that permanently left its range before `until` [s, on the flight's clock], and when."""
    onsets = {name: _loss_onset(name, x, flight, until) for name, x in _signals(flight).items()}
    lost = [(name, onset) for name, onset in onsets.items() if onset is not None]
    return min(lost, key=lambda loss: loss[1], default=None)


def _signals(flight: FlightData) -> dict[str, np.ndarray]:
    """Return the tracked signals, (n,) each: energy error as height [m], turn rate less that of the bank [rad/s]."""
    r = flight.readings
    speed = np.maximum(r.get("Va", np.hypot(r["v_n"], r["v_e"])), 5.0)
    turning = np.gradient(np.unwrap(r["psi"]), DT)
    out = {TURN: turning - G / speed * np.tan(np.clip(r["phi"], -1.2, 1.2)), PITCH: r["theta"]}
    if "low" in r:
        out[ENERGY] = r["low"] + speed / G * r["slow"]
    width = round(_MEAN_S / DT)
    return {
        name: np.convolve(np.pad(x, width // 2, mode="edge"), np.ones(width) / width, "same")[width // 2 :][: len(x)]
        for name, x in out.items()
    }


def _loss_onset(name: str, x: np.ndarray, flight: FlightData, until: float) -> float | None:
    """Return when a signal, (n,), permanently left its range [s]; None if it did not."""
    t, ok = flight.t, flight.ok
    past, later = ok & (t < until), t >= until
    if not past.any():
        return None
    low, middle, high = np.percentile(x[past], [_RANGE_PERCENTILES[0], 50.0, _RANGE_PERCENTILES[1]])
    margin = max(_MARGIN_SHARE * (high - low), _MIN_MARGIN[name])
    excess = np.where(x > high, (x - high) / margin, np.where(x < low, (low - x) / margin, 0.0))
    excess[~later | ~ok] = 0.0
    min_rows = round(_MIN_DURATION_S / DT)
    beyond = np.convolve(excess > 1.0, np.ones(min_rows), "full")[: len(t)] >= min_rows
    if not beyond.any():
        return None
    first = int(np.argmax(beyond)) - min_rows + 1
    if (excess[first:][ok[first:]] > 1.0).mean() < _MIN_OUT_SHARE:
        return None
    side = np.sign(x[first] - middle)
    before = np.flatnonzero(side * (x[:first] - middle) <= 0.0)
    return float(t[before[-1]]) if len(before) else float(t[first])


MIN_AFTER_S = 10.0  # least length of valid flight to diagnose
LAW_S = 40.0  # flight from which the controller's law is learnt where no past is trusted [s]
_ONSET_MARGIN_S = 5.0  # onsets may precede the end of the trusted past by this

ReportProgress = Callable[[str], None]


@dataclass(frozen=True)
class OwnPast:
    """Reference of a diagnosis: the trusted first part of each flight itself.

    Attributes:
        until: end of the trusted past [s, on the flight's own clock]
        card: the aircraft, or `card.UNKNOWN`
    """

    until: float
    card: AircraftCard

    def diagnose(
        self, flight: FlightData, progress: ReportProgress = lambda message: None, conceal: Sequence[str] = ()
    ) -> Report:
        """Diagnose the flight after `until` with a calibration before it; calibrate coefficients with all channels.

        Raises:
            ValueError: if there is too little flight before or after; the message gives its length.
        """
        after = part_after(flight, self.until).seconds
        if after < MIN_AFTER_S:
            raise ValueError(
                f"{flight.name}: found {format_below(after, MIN_AFTER_S)} s of trusted flight after "
                f"{self.until:.0f} s, expected {MIN_AFTER_S:.0f} s at least to diagnose; trust a shorter past"
            )
        past = part_before(flight, self.until)
        visible = conceal_channels(flight, conceal, past)
        concealed = part_before(visible, self.until) if conceal else None
        base = calibrate_past(past, self.card, progress, concealed).baseline(flight)
        limitation = (
            f"calibrated on {flight.seconds - after:.0f} s of its own past: effects present from the start and a mean "
            "wind count as nominal; the barometer is not checked"
        )
        later = part_after(visible, self.until - CONTEXT_S)
        report = diagnose(replace(later, limitations=(*visible.limitations, limitation)), base, progress)
        report = _without_weather(report, visible, base)
        report = only_new_findings(report, find_tracking_loss(flight, self.until), self.until)
        return with_output_faults(report, visible, self.until)


def _without_weather(report: Report, flight: FlightData, base: Baseline) -> Report:
    """Return a named loss of energy as suspected where earlier air movement may explain it (`air_movement`)."""
    least = np.log(POSTERIOR / (1.0 - POSTERIOR)) - np.log(PRIOR)
    onsets = [f.segments[0][0] for f in report.findings if f.hypothesis.effect.name in _ENERGY_EFFECTS]
    if report.outcome is not ReportOutcome.NAMED or not onsets:
        return report
    if energy_evidence(flight, base, min(onsets)) >= least:
        return report
    return with_sentence(replace(report, outcome=ReportOutcome.SUSPECTED))


def with_output_faults(report: Report, flight: FlightData, until: float | None = None) -> Report:
    """Return the report with the outputs of `find_output_faults` as its first findings."""
    return with_frozen_outputs(report, find_output_faults(flight, until))


def find_output_faults(flight: FlightData, until: float | None = None) -> list[FrozenOutput]:
    """Return the outputs that no longer answer the controller; see `inference.output_faults`.

    Args:
        flight: with the outputs, if recorded
        until: end of the trusted flight that shows the controller's law [s]; None: the first `LAW_S` in the air
    """
    outputs = flight.outputs
    if outputs is None:
        return []
    if until is None:
        flying = outputs.t[outputs.flying]
        until = float(flying[0]) + LAW_S if len(flying) else float("inf")
    return find_frozen_outputs(outputs, until)


def only_new_findings(
    report: Report, tracking_loss: tuple[str, float] | None, until: float, settled: float | None = None
) -> Report:
    """Return the report without mismatches in the trusted past alone, and with a tracking loss after it.

    The past ends at `until`; filters that begin anew after it have settled at `settled`, by default immediately.

    An effect that starts in the trusted past contradicts the assumption: the outcome is suspected instead of named.
    Wind, gusts and turbulence vary between minutes, and the past is one sample of them: they are weather, no finding,
    and an effect not separable from them is suspected.
    """
    findings = tuple(finding for finding in report.findings if finding.hypothesis.effect.channel != _AIR)
    if len(findings) < len(report.findings):
        is_explained = not findings and report.outcome is not ReportOutcome.UNKNOWN
        report = replace(report, findings=findings, outcome=ReportOutcome.NONE if is_explained else report.outcome)
    in_past = any(finding.segments[0][0] < until - _ONSET_MARGIN_S for finding in findings)
    may_be_weather = any(catalogue()[name].channel == _AIR for finding in findings for name in finding.rivals)
    if (in_past or may_be_weather) and report.outcome is ReportOutcome.NAMED:
        report = replace(report, outcome=ReportOutcome.SUSPECTED)
    channel, segments = report.where
    segments = tuple(pair for pair in segments if pair[1] > (until if settled is None else settled))
    if report.outcome is ReportOutcome.NAMED or segments:
        return with_sentence(replace(report, where=(channel, segments)))
    if tracking_loss is not None:
        signal, since = tracking_loss
        where = (signal, ((since, float(report.series.t[-1])),))
        return with_sentence(replace(report, outcome=ReportOutcome.UNKNOWN, findings=(), terms={}, where=where))
    if report.outcome is ReportOutcome.UNKNOWN:
        return with_sentence(replace(report, outcome=ReportOutcome.NONE, findings=(), terms={}, where=("", ())))
    return with_sentence(report)


_READINGS = {
    "airspeed": ("Va",),
    "imu": ("a_x", "a_y", "a_z"),
    "pressure": ("baro",),
    "gnss": ("gnss",),
    "wind": (),  # not read: the diagnosis uses neither the estimated wind nor the battery state
    "battery": (),
}
_COMMANDS = {"aileron": 0, "elevator": 1, "rudder": 2, "throttle": 3}
NAMES = (*_READINGS, *_COMMANDS)
"""Channels that can be concealed."""

_EQUATION = {"aileron": "L", "elevator": "M", "rudder": "N", "throttle": "X"}


def check(names: Iterable[str]) -> None:
    """Reject unknown channel names.

    Raises:
        ValueError: if a name is unknown; the message lists the valid names.
    """
    if unknown := [name for name in names if name not in NAMES]:
        raise ValueError(f"--conceal: found {unknown[0]!r}, expected names of {', '.join(NAMES)}; correct it")


def conceal_channels(flight: FlightData, names: Sequence[str], typical: FlightData) -> FlightData:
    """Return a flight without some channels; a concealed command is replaced by its median in `typical`."""
    if not names:
        return flight
    removed = {reading for name in names for reading in _READINGS.get(name, ())}
    readings = {name: x for name, x in flight.readings.items() if name not in removed}
    commands = flight.commands.copy()
    for column in (_COMMANDS[name] for name in names if name in _COMMANDS):
        commands[:, column] = np.median(typical.commands[typical.ok, column])
    limitations = (f"concealed: {', '.join(names)}", *flight.limitations)
    outputs = None if set(names) & set(_COMMANDS) else flight.outputs
    return replace(flight, readings=readings, commands=commands, limitations=limitations, outputs=outputs)


def exclude_concealed(base: Baseline, names: Iterable[str]) -> Baseline:
    """Return a baseline that ignores the axes whose commands are concealed."""
    return exclude_equations(base, [_EQUATION[name] for name in names if name in _EQUATION])
