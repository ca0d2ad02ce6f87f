"""A new effect is one new file: dropped into a folder at run time it is listed, flown, found and proven."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import ROOT

from fleet import cli
from fleet.effects import FOLDERS_ENV, Onset, catalogue
from tests.support.effect_flights import CARD, Plan, flown
from twin_worker.diagnosis.baseline.calibrate import calibrate
from twin_worker.diagnosis.data.card import FaultHypothesis, OnsetProfile
from twin_worker.diagnosis.inference.diagnose import diagnose
from twin_worker.diagnosis.inference.report import ReportOutcome
from twin_worker.diagnosis.inference.validation.cross_validate import MIN_RMS_DROP

PAGE = (ROOT / "docs" / "extending.md").read_text()
(DOOR,) = re.findall(r'^```python title="door_jammed.py"\n(.*?)^```', PAGE, re.M | re.S)
"""The file of the walk-through in the documentation."""


@pytest.fixture
def door(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The file in a folder of its own, which the environment names."""
    (tmp_path / "door_jammed.py").write_text(DOOR)
    monkeypatch.setenv(FOLDERS_ENV, str(tmp_path))
    catalogue.cache_clear()
    yield
    catalogue.cache_clear()


def test_a_new_file_is_listed_flown_found_and_proven(door: None, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["effects"]) == 0
    assert "door_jammed" in capsys.readouterr().out
    jammed = FaultHypothesis(catalogue()["door_jammed"], "", (0.4,), OnsetProfile(Onset.STEP, 35.0))
    plans = [Plan(f"nominal {seed}", seed) for seed in range(3)]
    *nominal, flight = flown([*plans, Plan("door", 7, (jammed,))])
    report = diagnose(flight, calibrate(nominal, CARD))
    assert report.outcome is ReportOutcome.NAMED, report.sentence
    first = report.findings[0]
    assert first.hypothesis.effect.name == "door_jammed", report.sentence
    assert first.reported["open"] == pytest.approx(0.4, abs=max(0.05, 3 * first.sigma["open"]))
    assert first.hypothesis.onset.t0 == pytest.approx(35.0, abs=1.0)
    assert 1.0 - report.fit_after / report.fit_before > MIN_RMS_DROP
    without = dict(zip(("before", "after"), (report.force_before, report.force_after), strict=True))
    assert without["after"] < 0.9 * without["before"], without
