"""The blind examination: seal, marks, scores, and one run of the whole."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from conftest import exit_code

from fleet.blind_test.examiner import ForceCheck
from fleet.blind_test.mark import REQUIREMENTS, GradedFlight, ScoredParameter, grade, meets_requirement, score
from fleet.blind_test.seal import consume_key, decrypt, digest, encrypt
from fleet.blind_test.shown import confusion, misses_first
from fleet.cli import main as fleet


def effect(name: str, **params: float) -> dict[str, Any]:
    return {"name": name, "params": params}


def label(role: str, *effects: dict[str, Any]) -> dict[str, Any]:
    return {"role": role, "airframe": "small", "seed": 1, "effects": list(effects), "flown_s": 200.0}


def report(*named: str, verdict: str = "named", **more: Any) -> dict[str, Any]:
    empty: list[dict[str, Any]] = [{} for _ in named]
    where = [{"channel": "drag", "surface": None, "segments": [[60.0, 200.0]]} for _ in named]
    said = {"verdict": verdict, "named": list(named), "sentence": "so it is", "equivalents": [[] for _ in named]}
    return said | {"located": where, "parameters": empty, "sigma": empty, "fit_before": 2.0, "fit_after": 1.0} | more


# --- seal ------------------------------------------------------------------------------------------------------------


def sealed(folder: Path) -> tuple[Path, Path]:
    letter, key = folder / "labels.sealed", folder / "key"
    encrypt(b"nothing but the truth", letter, key)
    return letter, key


def test_a_seal_hides_and_opens(tmp_path: Path) -> None:
    letter, key = sealed(tmp_path)
    assert b"truth" not in letter.read_bytes() and key.stat().st_mode & 0o077 == 0
    assert decrypt(letter, consume_key(key), digest(letter)) == b"nothing but the truth"


def test_a_changed_letter_is_refused(tmp_path: Path) -> None:
    letter, key = sealed(tmp_path)
    promised = digest(letter)
    encrypt(b"another truth", letter, key)
    with pytest.raises(ValueError, match=r"labels\.sealed: found another hash"):
        decrypt(letter, consume_key(key), promised)


@pytest.mark.parametrize("wrong", [b"", b"no key", b"A" * 43 + b"="])
def test_another_key_does_not_fit(wrong: bytes, tmp_path: Path) -> None:
    letter, _ = sealed(tmp_path)
    with pytest.raises(ValueError, match="found a wrong key"):
        decrypt(letter, wrong, digest(letter))


# --- marks -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("role", "concealed", "said", "hit"),
    [
        ("control", [], report(verdict="none"), True),
        ("control", [], report("icing"), False),
        ("control", [], report(verdict="unknown"), False),
        ("unknown", ["_slosh"], report(verdict="unknown"), True),
        ("unknown", ["_slosh"], report(verdict="none"), False),
        ("unknown", ["_slosh"], report("icing"), False),
        ("single", ["icing"], report("icing", "gyro_bias"), True),
        ("single", ["icing"], report("gyro_bias", "icing"), False),
        ("single", ["icing"], report(verdict="unknown"), False),
        ("single", ["icing"], None, False),
        ("compound", ["icing", "gyro_bias"], report("gyro_bias", "icing"), True),
        ("compound", ["icing", "gyro_bias"], report("icing"), False),
    ],
)
def test_what_is_a_hit(role: str, concealed: list[str], said: dict[str, Any] | None, hit: bool) -> None:
    assert grade("one", label(role, *map(effect, concealed)), said).hit is hit


def test_a_rival_is_in_the_class() -> None:
    one = grade("one", label("single", effect("icing")), report("drag_increase", equivalents=[["icing"]]))
    assert one.in_class and not one.hit


@pytest.mark.parametrize("name", ["dCD", "dCD_relative"])
def test_where_when_and_how_much(name: str) -> None:
    """Without an airframe the magnitude of a label is relative as well."""
    concealed = effect("drag_increase", dCD=0.02) | {"t0": 57.0}
    diagnosis = report("drag_increase", parameters=[{name: 0.022}], sigma=[{name: 0.002}])
    one = grade("one", label("single", concealed), diagnosis)
    assert one.located == (True,) and one.late == ((3.0, 5.0),)
    (_, size) = one.sizes[0]
    assert size.error == pytest.approx(0.1) and size.covered


@pytest.mark.parametrize(
    ("size", "error"),
    [
        (ScoredParameter("from_deg", 350.0, 5.0, None), 15 / 45),
        (ScoredParameter("scale", 0.9, 0.92, None), 0.2),
        (ScoredParameter("density_ratio", 0.9, 0.88, None), 0.2),
        (ScoredParameter("roll_deg", 0.0, 0.5, None), 0.5),
        (ScoredParameter("bias_deg", 10.0, 9.0, None), 0.1),
        (ScoredParameter("loss", 0.5, None, None), 1.0),
    ],
)
def test_errors_of_numbers(size: ScoredParameter, error: float) -> None:
    assert size.error == pytest.approx(error) and size.covered is None


# --- scores ----------------------------------------------------------------------------------------------------------


def examined() -> list[GradedFlight]:
    asked = [
        ("control", [], report(verdict="none")),
        ("control", [], report("icing")),
        ("single", ["icing"], report("icing")),
        ("single", ["stall"], report("drag_increase", equivalents=[["stall"]], fit_after=2.5)),
        ("compound", ["icing", "gyro_bias"], report("icing", "stall")),
        ("unknown", ["_slosh"], report(verdict="unknown")),
    ]
    flights = [(label(role, *map(effect, names)), said) for role, names, said in asked]
    checks = [None, *(ForceCheck(1.0, after, 2.0, 0.1, 0.3) for after in (0.8, 0.8, 1.2, 0.8)), None]
    return [
        grade(f"rec_{k}", one, said, check) for k, ((one, said), check) in enumerate(zip(flights, checks, strict=True))
    ]


def test_a_direction_is_covered_across_north() -> None:
    assert (
        ScoredParameter("from_deg", 355.0, 3.0, 5.0).covered
        and not ScoredParameter("from_deg", 355.0, 3.0, 3.0).covered
    )


def test_scores_count_what_they_say() -> None:
    told = score(examined())
    expected = {
        "top1_naming": 0.5,
        "in_class": 1.0,
        "false_alarm": 0.5,
        "compound_recall": 0.5,
        "compound_extra": 1,
        "compound_extra_per_flight": 1.0,
        "unknown_abstained": 1.0,
        "named_improving": 0.75,
        "class_size_median": 1.0,
        "onset_within_5s": None,
    }
    assert {name: told[name] for name in expected} == expected
    assert told["n"] == {"control": 2, "single": 2, "compound": 1, "unknown": 1, "sizes": 0, "onsets": 0}


def test_nothing_to_score_is_no_failure() -> None:
    told = score([])
    assert all(meets_requirement(name, told[name]) for name in REQUIREMENTS)


def test_what_is_asked_is_at_least_or_at_most() -> None:
    assert meets_requirement("false_alarm", 1 / 60) and not meets_requirement("false_alarm", 2 / 60)
    assert meets_requirement("top1_naming", 44 / 50) and not meets_requirement("top1_naming", 43 / 50)


def test_misses_come_first_and_confusion_counts_every_name() -> None:
    marks = examined()
    assert [one.hit for one in misses_first(marks)] == [False] * 3 + [True] * 3
    pairs = confusion(marks)
    assert pairs["stall", "drag_increase"] == pairs["gyro_bias", "stall"] == pairs["_slosh", "unknown"] == 1
    assert pairs["icing", "icing"] == 2 and pairs["nothing", "icing"] == pairs["nothing", "nothing"] == 1


# --- the whole -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--flights", "2"], "--flights: found 2"),
        (["--seed", "-1"], "--seed: found -1"),
        (["--jobs", "0"], "--jobs: found 0"),
        (["--json", "nowhere/here.json"], "--json: found no folder"),
        (["--report", "."], "expected an empty folder"),
    ],
)
def test_wrong_use_is_refused_before_anything_flies(
    options: list[str], words: str, capfd: pytest.CaptureFixture[str]
) -> None:
    code = exit_code(lambda: fleet(["prove", *options]))
    said = capfd.readouterr().err
    assert code == 2 and words in said.splitlines()[-1]


def test_an_examination_runs_and_keeps_its_promises(tmp_path: Path) -> None:
    folder, out = tmp_path / "proof", tmp_path / "proof.json"
    options = ["--flights", "6", "--seed", "5", "--jobs", "1", "--report", folder, "--json", out]
    done = subprocess.run([sys.executable, "-m", "fleet.cli", "prove", *options], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    told = json.loads(out.read_text())
    said = done.stderr.splitlines()
    promised = [
        next(k for k, line in enumerate(said) if told[name] in line) for name in ("labels_sha256", "reports_sha256")
    ]
    opened = next(k for k, line in enumerate(said) if "labels decrypted" in line)
    assert promised[0] < promised[1] < opened
    assert digest(folder / "labels.sealed") == told["labels_sha256"]
    assert digest(*sorted(folder.glob("*/reports.json"))) == told["reports_sha256"]
    assert len(told["marks"]) == 6 and set(REQUIREMENTS) <= set(told)
    page = (folder / "index.html").read_text()
    for one in told["marks"]:
        assert (folder / one["airframe"] / "pages" / f"{one['flight']}.html").exists() and one["flight"] in page
