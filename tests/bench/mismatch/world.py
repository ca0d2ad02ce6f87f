"""Aircraft with a fault concealed in them, and the model a test pilot's healthy flights of the same aircraft give."""

import json
from pathlib import Path

from fleet.contract import Message
from fleet.simulator.conceal.exam import card
from fleet.simulator.conceal.paths import NOMINAL_EXCITATION, FlightJob, draw_flight
from fleet.simulator.conceal.record import fly
from fleet.simulator.faults.kinds import parse_fault
from fleet.simulator.flight.drive import to_tlog
from fleet.simulator.flight.uav import SimulatedUav
from fleet.simulator.vehicle.weather import FT, wind_at_20ft
from fleet.telemetry.recording.recordings import replay_messages
from twin_worker.diagnosis.baseline.calibrate import calibrate
from twin_worker.diagnosis.data import card as cards
from twin_worker.diagnosis.data.flight import read_flights
from twin_worker.diagnosis.model.baseline import Baseline
from twin_worker.diagnosis.output.keep import load, save

ONSET_S = 120.0
USUAL_W20_MPS = wind_at_20ft(2) * FT  # of ordinary flights, so that the model knows what is usual of them
FAULT = "airspeed_bias,bias_mps=-6"


def model(seed: int, folder: Path) -> Path:
    """Give the model of aircraft 0 of a seed, from five healthy flights of it; made where it is not in the folder."""
    path = folder / f"model_{seed}.json"
    if path.exists():
        return path
    (folder / "card.json").write_text(json.dumps(card("small")))
    known, flights = cards.read_card(folder / "card.json"), []
    for k, strength in enumerate(NOMINAL_EXCITATION):
        recording = folder / f"nominal_{seed}_{k}.tlog"
        planned = draw_flight(FlightJob(recording.stem, "small", "nominal", (), k, strength), seed, 0)
        fly(planned._replace(w20_mps=USUAL_W20_MPS), (), recording)
        flights += read_flights(recording, known)
        recording.unlink()
    save(path, calibrate(flights, known))
    return path


def baseline(seed: int, folder: Path) -> Baseline:
    """Give that model."""
    return load(model(seed, folder))[0]


def messages(fault: str, seed: int, seconds: int, folder: Path) -> list[Message]:
    """Give what a gateway says of an ordinary flight of that aircraft, with a fault from `ONSET_S` on, or none."""
    faults = (parse_fault(f"{fault},at={ONSET_S:.0f}", "small"),) if fault else ()
    path = folder / "flight.tlog"
    to_tlog(path, [SimulatedUav(0, seed, faults=faults)], seconds=seconds, loss=0.02, seed=seed)
    heard = list(replay_messages(path))
    path.unlink()
    return heard
