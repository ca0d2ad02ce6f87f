"""Made-up diagnoses: flights of four legs with something wrong from 83 s on."""

import numpy as np

from fleet.effects import Onset, catalogue
from twin_worker.diagnosis.data.card import FaultHypothesis, OnsetProfile
from twin_worker.diagnosis.inference.report import (
    DiagnosisFinding,
    FigureSeries,
    RankedCandidate,
    Report,
    ReportOutcome,
)
from twin_worker.diagnosis.model.baseline import CHANNELS

ONSET = 83.0
LENGTH = 200.0
NAN = float("nan")


def made(
    flight: str = "s07-lag", outcome: ReportOutcome = ReportOutcome.NAMED, seed: int = 6, effects: int = 1
) -> Report:
    """A flight of four legs whose pitch and lift go wrong at 83 s."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, LENGTH, 0.2)
    ok = (t > 4.0) & ~((t > 120.0) & (t < 126.0))
    held = np.floor(t / 10.0) % 2 == 1
    wrong = (t >= ONSET) * (np.sin(0.9 * t) + 0.5 * np.sin(2.3 * t))
    noise = _coloured(rng, len(t), len(CHANNELS))
    share = np.zeros(len(CHANNELS))
    if outcome is not ReportOutcome.NONE:
        share[[CHANNELS.index(name) for name in ("pitch", "lift", "gps_z", "force_x", "airspeed")]] = 6, 4, 1.5, 1, 0.8
    before, after = noise + np.outer(wrong, share), noise + 0.08 * np.outer(wrong, share)
    ratio = [
        dict(zip(CHANNELS, (x[ok] ** 2).mean(axis=0) / (noise[ok] ** 2).mean(axis=0), strict=True))
        for x in (before, after)
    ]
    base, model = _forces(rng, t, wrong, 0.0), _forces(rng, t, wrong, 0.9 if outcome is not ReportOutcome.NONE else 0.0)
    measured = _forces(rng, t, wrong, 1.0 if outcome is not ReportOutcome.NONE else 0.0) + 0.12 * rng.normal(
        size=(len(t), 3)
    )
    found = _findings()[:effects] if outcome in (ReportOutcome.NAMED, ReportOutcome.SUSPECTED) else ()
    errors = [float(np.sqrt(((measured - x)[held & ok] ** 2).mean())) for x in (base, model)]
    return Report(
        flight=flight,
        outcome=outcome,
        sentence=_sentence(outcome),
        findings=found,
        ratio_before=ratio[0],
        ratio_after=ratio[1],
        fit_before=1.94 if found else NAN,
        fit_after=1.07 if found else NAN,
        force_before=errors[0],
        force_after=errors[1] if found else NAN,
        free_run_error_before=6.1,
        free_run_error_after=2.2,
        where=("pitch", ((ONSET, 118.0), (130.0, LENGTH))) if outcome is ReportOutcome.UNKNOWN else ("", ()),
        terms={"q·V": -0.42, "sin(0.9 t)": 1.3e-5} if outcome is ReportOutcome.UNKNOWN else {},
        ranking=() if outcome is ReportOutcome.NONE else _tried(),
        limitations=("the accelerometer comes at 5 Hz: gusts and small changes of lift are seen less well",),
        series=FigureSeries(t, ok, _path(t), before, after, measured, base, model, held),
        seconds=3.2,
    )


def _coloured(rng: np.random.Generator, n: int, columns: int) -> np.ndarray:
    noise = rng.normal(size=(n, columns))
    for k in range(1, n):
        noise[k] += 0.7 * noise[k - 1]
    return noise / noise.std(axis=0)


def _forces(rng: np.random.Generator, t: np.ndarray, wrong: np.ndarray, share: float) -> np.ndarray:
    turning = np.clip(8 * np.sin(2 * np.pi * t / 50.0) - 7, 0, 1)
    forces = np.stack([0.4 + 0.5 * turning, 0.2 * np.sin(0.5 * t) * turning, -9.81 - 2.5 * turning], axis=1)
    return forces + share * np.outer(wrong, (0.15, 0.05, 0.8)) + 0.01 * rng.normal(size=forces.shape)


def _path(t: np.ndarray) -> np.ndarray:
    course = np.cumsum(np.clip(8 * np.sin(2 * np.pi * t / 50.0) - 7, 0, 1)) * 0.2 * 0.31
    north, east = np.cumsum(np.cos(course)) * 3.6, np.cumsum(np.sin(course)) * 3.6
    return np.stack([north, east, 100 - 40 * np.exp(-t / 12) + 6 * np.sin(0.11 * t)], axis=1)


def _findings() -> tuple[DiagnosisFinding, ...]:
    known = catalogue()
    since = OnsetProfile(Onset.STEP, ONSET)
    return (
        DiagnosisFinding(
            hypothesis=FaultHypothesis(known["actuator_lag"], "elevator", (0.15,), since),
            gain=4213.0,
            reported={"tau_s": 0.253},
            sigma={"tau_s": 0.0061},
            parameter_sigma=(0.0061,),
            rivals=("actuator_delay", "actuator_rate_limit"),
            manoeuvres=("elevator doublets: 2.0 times as telling as this flight was; 20 s of it should do",) * 2,
            channel="actuator",
            surface="elevator",
            segments=((ONSET, LENGTH),),
            held_out_share=0.62,
        ),
        DiagnosisFinding(
            hypothesis=FaultHypothesis(known["drag_increase"], "", (0.02, 0.0)),
            gain=688.0,
            reported={"dCD": 0.0214, "dCm": 0.0},
            sigma={"dCD": 0.0012},
            parameter_sigma=(0.0012, 0.0),
            rivals=(),
            manoeuvres=(),
            channel="drag",
            surface="",
            segments=((0.0, LENGTH),),
            held_out_share=0.21,
        ),
        DiagnosisFinding(
            hypothesis=FaultHypothesis(known["gust_discrete"], "", (3.0, 2.0), OnsetProfile(Onset.BUMP, 140.0, 8.0)),
            gain=455.0,
            reported={"speed_mps": 3.61, "from_deg": 213.7},
            sigma={"speed_mps": 0.21, "from_deg": 4.4},
            parameter_sigma=(0.2, 0.2),
            rivals=("updraft",),
            manoeuvres=("nothing flown here tells them apart",),
            channel="air",
            surface="",
            segments=((140.0, 148.0),),
        ),
    )


def _tried() -> tuple[RankedCandidate, ...]:
    gains = {
        ("actuator_lag:elevator", "since 83 s"): 4213.0,
        ("actuator_delay:elevator", "since 83 s"): 4180.0,
        ("actuator_lag:elevator", "always"): 3011.0,
        ("actuator_rate_limit:elevator", "since 82 s"): 3950.0,
        ("actuator_lag:all surfaces", "since 84 s"): 2730.0,
        ("control_effectiveness_loss:elevator", "since 83 s"): 1411.0,
        ("drag_increase", "always"): 702.0,
        ("icing", "growing since 70 s over 60 s"): 690.0,
        ("cg_shift", "since 83 s"): 320.0,
        ("gust_discrete", "at 140 s for 8 s"): 455.0,
        ("mass_change", "always"): 120.0,
        ("slipstream_tail", "since 83 s"): 77.0,
        ("thrust_loss", "always"): 41.0,
    }
    return tuple(RankedCandidate(label, since, gain) for (label, since), gain in gains.items())


def _sentence(outcome: ReportOutcome) -> str:
    return {
        ReportOutcome.NONE: "No mismatch: the simulation explains this flight as well as it does nominal ones.",
        ReportOutcome.NAMED: "From 83 s on the elevator follows with a lag of 0.253 ± 0.006 s instead of 0.10 s; "
        "a delay of the same length cannot be told from it.",
        ReportOutcome.SUSPECTED: "An elevator lag is suspected from 83 s on, but nothing is gained on data held out.",
        ReportOutcome.UNKNOWN: "Something in pitch from 83 s on that no effect of the catalogue explains.",
    }[outcome]
