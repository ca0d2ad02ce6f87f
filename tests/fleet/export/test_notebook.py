"""The notebook of the documentation reads what a fleet and a recording hold; its cells are run without Jupyter."""

import json
from pathlib import Path

import pandas as pd
import pytest
from conftest import ROOT

from fleet.bus.session import connect
from fleet.commands.live.record import BusRecorder
from fleet.contract import Prediction
from tests.support.memory_bus import MemoryBus
from tests.support.pretend_feed import PretendFleet, T

UAVS, SECONDS = 5, 5


@pytest.fixture
def recording(tmp_path: Path) -> tuple[Path, list[Prediction]]:
    """Five seconds of a fleet, and the predictions in them."""
    path, bus, published = tmp_path / "flight.parauav", MemoryBus(), []
    with path.open("wb", buffering=0) as file:
        recorder = BusRecorder(bus, file)
        recorder.subscribe()
        bus.subscribe(Prediction, lambda message, _: published.append(message))
        fleet = PretendFleet(bus, UAVS)
        for k in range(10 * SECONDS):
            fleet.advance(T + k / 10)
        recorder.write()
    return path, [message for message in published if len(message.ahead.numpy())]


def test_the_notebook_reads_predictions_of_a_fleet_and_of_a_recording(
    router: str, recording: tuple[Path, list[Prediction]]
) -> None:
    path, published = recording
    given = {'"tcp/127.0.0.1:7447"': repr(router), '"flight.parauav"': repr(str(path))}
    notebook = json.loads((ROOT / "docs" / "predictions.ipynb").read_text())
    names: dict[str, object] = {}
    with connect(router) as bus:
        fleet = PretendFleet(bus, UAVS)
        fleet.advance(T)  # a query is answered with predictions of this time
        for cell in notebook["cells"]:
            if cell["cell_type"] == "code":
                assert not cell["outputs"]
                source = "".join(cell["source"])
                for text in [text for text in given if text in source]:
                    source = source.replace(text, given.pop(text))
                exec(compile(source, "predictions.ipynb", "exec"), names)
    assert not given
    answered = [uav.prediction(T, 0.0) for uav in fleet.uavs]
    check(names["live"], [message for message in answered if message is not None and len(message.ahead.numpy())])
    check(names["recorded"], published)


def check(frame: object, published: list[Prediction]) -> None:
    """Compare a table with the messages it was made from."""
    assert isinstance(frame, pd.DataFrame) and published
    assert set(frame.uav) == {message.uav for message in published}
    assert len(frame) == sum(len(message.ahead.numpy()) for message in published)
    for message in published[-UAVS:]:
        rows = frame[(frame.uav == message.uav) & (frame.t == pd.to_datetime(message.t, unit="s", utc=True))]
        assert rows[["north_m", "east_m", "down_m"]].to_numpy() == pytest.approx(message.path.numpy())
        assert rows.ahead_s.to_numpy() == pytest.approx(message.ahead.numpy())
        assert set(rows.horizon_s) == {message.horizon_s} and set(rows.state) == {message.state.value}
