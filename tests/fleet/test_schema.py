"""`fleet schema` says what is on the wire, `fleet doctor` what is wrong with the machine."""

import json
import sys

import pytest

from fleet import cli
from fleet.contract import COLUMNS, TOPICS, Prediction, WhatIf
from fleet.health import machine
from fleet.health.machine import CheckResult


def shown(capsys: pytest.CaptureFixture[str], *argv: str) -> str:
    assert cli.main(list(argv)) == 0
    return capsys.readouterr().out


def test_the_table_names_every_key_with_its_encoding(capsys: pytest.CaptureFixture[str]) -> None:
    table = shown(capsys, "schema").split("\n\n")[0].splitlines()
    assert len(table) == len(TOPICS)
    assert table[0].split()[:2] == ["parauav/{uav}/sample", "application/msgpack;parauav.sample.1"]
    assert table[-1].split()[0] == "parauav/@handover/{writer}"


def test_one_topic_shows_fields_units_defaults_and_parts(capsys: pytest.CaptureFixture[str]) -> None:
    lines = [" ".join(line.split()) for line in shown(capsys, "schema", "model").splitlines()]
    assert "window_s float = 0.0 length of the identification window [s]" in lines
    assert "longitudinal LinearModel or null = null" in lines
    assert "states list of str required state names: u w q theta | phi psi p r v" in lines
    assert "not_identifiable" in lines
    assert any(line.startswith("attachment 16 bytes") for line in lines)


def test_no_line_is_wider_than_a_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    fields = shown(capsys, "schema").split("\n\n", 1)[1]
    assert max(map(len, fields.splitlines())) <= 118


def test_json_is_strict_and_complete(capsys: pytest.CaptureFixture[str]) -> None:
    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is no JSON")

    described = json.loads(shown(capsys, "schema", "--json"), parse_constant=refuse)
    assert list(described) == list(TOPICS)
    prediction = described["prediction"]
    assert prediction["key"] == "parauav/{uav}/prediction" and "epoch u64" in prediction["attachment"]
    assert set(prediction["components"]["Prediction"]["properties"]) == set(Prediction.__struct_fields__)
    assert prediction["query"] == {"$ref": "#/$defs/WhatIf"} and described["model"]["query"] is None
    assert set(prediction["components"]["WhatIf"]["properties"]) == set(WhatIf.__struct_fields__)
    assert list(described["sample"]["columns"]) == list(COLUMNS) and described["sample"]["attachment"] is None


def test_an_unknown_topic_is_refused_with_the_known_ones(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        cli.main(["schema", "nonsense"])
    assert left.value.code == 2 and "prediction" in capsys.readouterr().err


def test_doctor_gives_a_line_each_and_fails_only_on_what_is_bad(
    capsys: pytest.CaptureFixture[str], free_port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    router = f"tcp/127.0.0.1:{free_port}"
    lines = shown(capsys, "doctor", "--router", router).splitlines()
    assert {line.split()[0] for line in lines} <= {"ok", "note"}
    assert [line.split()[1] for line in lines[:2]] == ["python", "packages"]
    assert ".".join(map(str, sys.version_info[:3])) in lines[0]

    monkeypatch.setattr(machine, "packages", lambda: [CheckResult("BAD", "packages", "missing numpy; make setup")])
    assert cli.main(["doctor", "--router", router]) == 1
    assert cli.main(["doctor", "--router", "nonsense"]) == 2
