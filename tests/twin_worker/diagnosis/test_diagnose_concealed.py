"""Concealed effects in flights on foreign physics, diagnosed as a user would and scored by the recordings' own key."""

import json
import subprocess
import sys
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support.left_out import left_out
from twin_worker.diagnosis import __main__ as diagnose
from twin_worker.diagnosis import learn
from twin_worker.diagnosis.data.card import read_card
from twin_worker.diagnosis.data.flight import read_flights
from twin_worker.diagnosis.inference.diagnose import diagnose as diagnose_one
from twin_worker.diagnosis.inference.report import ReportOutcome
from twin_worker.diagnosis.output import keep

pytestmark = pytest.mark.recordings


@pytest.fixture(scope="module")
def folder(recordings: Path) -> Path:
    return recordings / "concealed-open"


@pytest.fixture(scope="module")
def model(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("model") / "c172.json"
    files = sorted(map(str, folder.glob("cal_*.tlog")))
    assert learn.main([*files, "--airframe", str(folder / "card.json"), "--out", str(out)]) == 0
    return out


@pytest.fixture(scope="module")
def verdicts(folder: Path, model: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("verdicts") / "open.json"
    assert (
        diagnose.main(
            [*sorted(map(str, folder.glob("rec_*.tlog"))), "--model", str(model), "--json", str(out), "--jobs", "2"]
        )
        == 0
    )
    return out


@pytest.fixture(scope="module")
def score(folder: Path, verdicts: Path) -> dict[str, Any]:
    command = [sys.executable, "score.py", "labels.json", str(verdicts), "--rec", "."]
    said = subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True).stdout
    return json.loads(said[said.index("\n{") :])


def test_every_concealed_effect_is_named_and_no_control_is(score: dict[str, Any]) -> None:
    assert score["top1_naming"] == 1.0 and score["n"]["single"] == 11
    assert score["false_alarm"] == 0.0 and score["n"]["ctrl"] == 2
    assert score["compound_recall"] == 1.0 and score["compound_extra"] == 0
    assert score["channel_ok"] == 1.0 and score["surface_ok"] == 1.0 and score["onset_ok"] == 1.0


def test_magnitudes_are_right_and_their_doubt_honest(score: dict[str, Any]) -> None:
    assert score["magnitude_median_err"] <= 0.05
    assert score["sigma2_coverage"] >= 0.85
    assert score["heldout_improvement_median"] >= 0.5


def test_classes_are_small_and_doubts_too(verdicts: Path) -> None:
    told = [one for one in json.loads(verdicts.read_text()) if one["named"]]
    sizes = [1 + len(rivals) for one in told for rivals in one["equivalents"]]
    assert np.median(sizes) <= 2 and max(sizes) <= 4
    shares = []
    for one in told:
        for par, sigma in zip(one["parameters"], one["sigma"], strict=True):
            shares += [abs(sigma[name] / par[name]) for name in par if par[name] and sigma[name]]
    assert np.median(shares) <= 0.10


def test_a_model_corrected_by_what_was_found_is_loaded_again(model: Path, folder: Path, tmp_path: Path) -> None:
    base, guesses = keep.load(model)
    assert not guesses and base.card.name.startswith("FW-A")
    flight = read_flights(folder / "rec_2e0d2cd3.tlog", base.card)[0]
    report = diagnose_one(flight, base)
    assert report.outcome is ReportOutcome.NAMED and report.free_run_error_after < 0.5 * report.free_run_error_before
    keep.save(tmp_path / "corrected.json", base, report.findings)
    again, guesses = keep.load(tmp_path / "corrected.json")
    assert [guess.effect.name for guess in guesses] == ["wind_steady"] and guesses[0] == report.findings[0].hypothesis
    assert all(np.array_equal(again.coef[name], x) for name, x in base.coef.items())


def test_nominal_flights_left_out_show_no_mismatch(folder: Path) -> None:
    card = read_card(folder / "card.json")
    flights = [flight for path in sorted(folder.glob("cal_*.tlog")) for flight in read_flights(path, card)]
    for report in islice(left_out(flights, card), 1):
        assert report.outcome is ReportOutcome.NONE, report.sentence


def test_a_recording_of_a_simulator_is_a_baseline_too(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.json"
    card, simulated = str(folder / "card.json"), str(folder / "cal_3ac41116.tlog")
    flight = str(folder / "rec_2e0d2cd3.tlog")
    assert diagnose.main([flight, "--against", simulated, "--airframe", card, "--json", str(out)]) == 0
    assert json.loads(out.read_text())[0]["named"] == ["wind_steady"]
