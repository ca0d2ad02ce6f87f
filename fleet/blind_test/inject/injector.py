"""`python -m fleet.blind_test.inject.injector`: conceal faults in recorded flights and encrypt their labels."""

import argparse
import json
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fleet.airframes import load
from fleet.blind_test.inject.faults import (
    FAULTS,
    InjectedAircraft,
    InjectedFault,
    inject,
    is_vane,
    possible_faults,
)
from fleet.blind_test.inject.recorded import FlightRecording, common_servo_map, read_recorded, write_recorded
from fleet.blind_test.inject.thrust import airspeed, fit_thrust_curves
from fleet.blind_test.seal import encrypt
from fleet.cli import run_command
from fleet.process.logs import report_progress
from fleet.telemetry.recording.options import RecordingOptions, add_recording_arguments

CONTROL_SHARE = 0.2
PAST_S = 47.0  # least flight before an onset: what the own past and the law of the outputs need, with the transient [s]
AFTER_S = 18.0  # least flight after the earliest onset [s]
_PAST_SHARE = 0.5
_MARGIN_S = 3.0
_ONSET_SHARE = 0.4  # of the later part, in which the onset lies, so that the fault acts in the rest
_SHRINK, _MAX_SHRINKS = 0.8, 12  # of a magnitude beyond the range of its output
_REPORT_EVERY = 10


class Source:
    """One healthy flight that faults are concealed in, and the end of the part that stays healthy [s]."""

    def __init__(self, path: Path, flight: FlightRecording, aircraft: InjectedAircraft) -> None:
        self.path, self.flight, self.aircraft = path, flight, aircraft
        begin, self.end = flight.airborne
        self.until = begin + max(PAST_S, _PAST_SHARE * (self.end - begin))
        self.possible = possible_faults(flight, aircraft)


def read_sources(paths: Sequence[Path], options: RecordingOptions, area_per_mass: float) -> list[Source]:
    """Read the flights of one aircraft; flights that are too short are left out with a message.

    Raises:
        ValueError: if none is long enough; the text names the least length.
    """
    flights = [read_recorded(path, options) for path in paths]
    used_map = common_servo_map(flights)
    curves = fit_thrust_curves(flights, used_map)
    sources, refused = [], []
    for path, flight, curve in zip(paths, flights, curves, strict=True):
        seconds = flight.airborne[1] - flight.airborne[0]
        if seconds < PAST_S + AFTER_S:
            least = f"{PAST_S + AFTER_S:.0f} s: {PAST_S:.0f} s healthy before an onset, {AFTER_S:.0f} s after it"
            refused.append(f"{flight.name}: found {int(seconds)} s in the air, expected {least}; name a longer flight")
            continue
        sources.append(Source(path, flight, InjectedAircraft(used_map, curve, area_per_mass)))
    if not sources:
        raise ValueError("; ".join(refused))
    for sentence in refused:
        report_progress("prove", f"left out: {sentence}")
    return sources


def draw(sources: Sequence[Source], flights: int, rng: np.random.Generator) -> list[tuple[int, str, str, float]]:
    """Draw source, fault, part and place of the magnitude in its range, 0..1; controls have no name.

    Every fault and part is drawn equally often, with magnitudes spread evenly over their range; every flight is a
    control once at most.
    """
    n_controls = min(max(round(CONTROL_SHARE * flights), 1), len(sources))  # two copies of a flight are one control
    kinds = sorted({kind for source in sources for kind in source.possible})
    drawn: list[tuple[str, str]] = []
    while len(drawn) < flights - n_controls:
        drawn += [kinds[i] for i in rng.permutation(len(kinds))]
    drawn = drawn[: flights - n_controls]
    strata = {kind: list(rng.permutation(count)) for kind, count in Counter(drawn).items()}
    number = Counter(drawn)
    out = [(int(k), "", "", 0.0) for k in rng.permutation(len(sources))[:n_controls]]
    for kind in drawn:
        able = [k for k, source in enumerate(sources) if kind in source.possible]
        place = (float(strata[kind].pop()) + rng.random()) / number[kind]
        out.append((able[int(rng.integers(len(able)))], *kind, place))
    return [out[i] for i in rng.permutation(len(out))]


def draw_fault(source: Source, name: str, part: str, place: float, rng: np.random.Generator) -> InjectedFault:
    """Draw one fault; `place` is the place of its magnitude between the limits, on a logarithmic scale."""
    fault = FAULTS[name]
    t0 = source.until + _MARGIN_S + float(rng.uniform(0.0, _ONSET_SHARE * (source.end - source.until)))
    sign = float(rng.choice([-1.0, 1.0])) if fault.signed else 1.0
    if name == "actuator_stuck":  # half of them at their last pulse
        value = sign * fault.high * place if rng.random() < 0.5 else 0.0
        return InjectedFault(name, part, {fault.key: value}, t0)
    return InjectedFault(name, part, {fault.key: sign * fault.low * (fault.high / fault.low) ** place}, t0)


def in_report_units(fault: InjectedFault, aircraft: InjectedAircraft) -> InjectedFault:
    """Convert the magnitude of a draw to the units of a report: a scale from its distance to 1, drag from its share."""
    ((key, size),) = fault.values.items()
    if fault.name == "airspeed_scale":
        size = 1.0 + size
    if fault.name == "drag_increase":
        size *= aircraft.thrust.c_0 / aircraft.area_per_mass
    return fault._replace(values={key: size})


def conceal(source: Source, drawn: InjectedFault, path: Path) -> InjectedFault | None:
    """Write the recording with the fault, smaller where an output would leave its range; None where none fits."""
    ((key, size),) = drawn.values.items()
    for _ in range(_MAX_SHRINKS):
        if FAULTS[drawn.name].low > abs(size) > 0.0:
            return None
        fault = in_report_units(drawn._replace(values={key: size}), source.aircraft)
        altered = inject(source.flight, source.aircraft, fault)
        if altered is not None:
            write_recorded(source.flight, altered, path)
            return fault
        size *= _SHRINK
    return None


def describe(source: Source, fault: InjectedFault | None, seed: int) -> dict[str, Any]:
    """Return the label of one recording."""
    effects = []
    if fault is not None:
        reported = {} if fault.name == "actuator_stuck" else {key: round(x, 6) for key, x in fault.values.items()}
        effect: dict[str, Any] = {"name": fault.name, "params": reported, "t0": round(fault.t0, 3)}
        if fault.part:
            effect["surface" if fault.name.startswith(("actuator", "control")) else "of"] = fault.part
        effects.append(effect)
    role = "single" if fault else "control"
    seconds = round(source.end - source.flight.airborne[0], 1)
    return {"role": role, "airframe": source.flight.name, "seed": seed, "effects": effects, "flown_s": seconds}


def area_per_mass(card: Path | None, model: Path | None) -> float:
    """Return S / m of the card, or of the card in a model; 1 without one, as coefficients are then relative [m2/kg].

    Raises:
        ValueError: if the file is none; the text names it.
    """
    try:
        if model is not None:
            body = json.loads(model.read_text())["card"]["body"]
            return float(body["S"] / body["mass"])
        if card is None:
            return 1.0
        if card.suffix != ".json":
            value = load(str(card) if card.suffix or card.exists() else card.name).value
            return float(value["S"] / value["mass"])
        document = json.loads(card.read_text())
        return float(document["S"] / document["m"])
    except (KeyError, TypeError, json.JSONDecodeError) as error:
        raise ValueError(
            f"{(model or card or Path()).name}: found {error!r}, expected a card or a model with S and mass; correct it"
        ) from None


def write_recordings(sources: Sequence[Source], args: argparse.Namespace) -> dict[str, dict[str, Any]]:
    """Write all recordings, one folder a source, and return their labels."""
    rng = np.random.default_rng((args.seed, 30))
    for source in sources:
        folder = args.out / source.flight.name
        folder.mkdir(parents=True, exist_ok=True)
        facts = {"path": str(source.path.absolute()), "until": round(source.until, 2), "vane": is_vane(source.flight)}
        facts["Va"] = round(float(np.median(airspeed(source.flight, source.flight.t["velocity"]))), 1)
        (folder / "source.json").write_text(json.dumps(facts) + "\n")
    tasks = draw(sources, args.flights, rng)
    names = [f"rec_{int(x):08x}" for x in rng.choice(2**32, len(tasks), replace=False)]
    labels: dict[str, dict[str, Any]] = {}
    for done, (name, (k, effect, part, place)) in enumerate(zip(names, tasks, strict=True), 1):
        source, fault = sources[k], None
        path = args.out / source.flight.name / f"{name}.parauav"
        if effect:
            fault = conceal(source, draw_fault(source, effect, part, place, rng), path)
        else:
            write_recorded(source.flight, {}, path)
        if fault is not None or not effect:
            labels[name] = describe(source, fault, args.seed)
        if done % _REPORT_EVERY == 0 or done == len(tasks):
            report_progress("prove", f"{done} of {len(tasks)} recordings written")
    if left_out := len(tasks) - len(labels):
        report_progress("prove", f"{left_out} left out: beyond the range of the outputs")
    return dict(sorted(labels.items()))


def _run(args: argparse.Namespace) -> int:
    sources = read_sources(args.file, RecordingOptions.of(args), area_per_mass(args.airframe, args.model))
    labels = write_recordings(sources, args)
    encrypt(json.dumps(labels, sort_keys=True).encode(), args.sealed, args.key)
    return 0


def main(argv: list[str] | None = None) -> int:
    """Write the recordings and encrypt their labels."""
    parser = argparse.ArgumentParser(prog="python -m fleet.blind_test.inject.injector", description=__doc__)
    parser.add_argument("file", nargs="+", type=Path)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--flights", type=int, required=True)
    for name in ("out", "sealed", "key"):
        parser.add_argument(f"--{name}", type=Path, required=True)
    for name in ("airframe", "model"):
        parser.add_argument(f"--{name}", type=Path)
    add_recording_arguments(parser)
    return run_command("prove", _run, parser.parse_args(argv))


if __name__ == "__main__":
    sys.exit(main())
