"""`fleet effects` lists what is in the folders, one's own too; a broken file is one sentence."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from fleet import cli
from fleet.effects import FOLDERS_ENV, Effect, catalogue

ALL = catalogue("")

NEWCOMER = '''"""A skid: side force from nowhere."""
from fleet.effects import Effect, Parameter, Stage

EFFECT = Effect(
    name="skid", stage=Stage.WRENCH, channel="side", equation="C_Y = dCY", source="Nobody 2001",
    parameters=(Parameter("dCY", "-", "side force", step=0.01, low=-1.0, high=1.0),),
    act=lambda flow, dCY: {"C_Y": dCY}, examples=((0.01,), (0.02,), (0.03,)),
)
'''


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder of one's own effects, which the environment names."""
    monkeypatch.setenv(FOLDERS_ENV, str(tmp_path))
    catalogue.cache_clear()
    yield tmp_path
    catalogue.cache_clear()


def test_a_file_dropped_in_a_folder_is_listed(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "skid.py").write_text(NEWCOMER)
    assert set(catalogue(str(folder))) == set(ALL) | {"skid"}
    assert cli.main(["effects"]) == 0
    assert [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()].count(
        "skid wrench, side dCY [-] C_Y = dCY"
    ) == 1
    assert cli.main(["effects", "skid"]) == 0
    assert "A skid: side force from nowhere." in capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "found"),
    [("x = (", "SyntaxError"), ("1 / 0", "ZeroDivisionError"), ("x = 1", "no EFFECT named 'odd'"), (NEWCOMER, "named")],
)
def test_a_broken_file_gives_one_sentence(
    text: str, found: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "odd.py").write_text(text)
    assert cli.main(["effects"]) == 2
    said = capsys.readouterr().err
    assert "odd.py" in said and found in said and "expected" in said and said.count("\n") == 1


def test_the_table_names_all_and_fits_a_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["effects"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert {line.split()[0] for line in lines if line[0] != " "} == set(ALL) | {"name"}
    assert max(map(len, lines)) <= 118


@pytest.mark.parametrize("effect", ALL.values(), ids=ALL)
def test_one_effect_shows_everything(effect: Effect, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["effects", effect.name]) == 0
    text = capsys.readouterr().out
    plain = " ".join(text.split())
    assert max(map(len, text.splitlines())) <= 118
    assert all(p.meaning in plain and f"{p.low:g} to {p.high:g}" in plain for p in effect.parameters)
    assert all(f"{rival} {how}" in plain for rival, how in effect.confusable_with.items())
    assert effect.equation in plain and effect.source in plain


def test_json_holds_all_of_it(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["effects", "--json"]) == 0
    described = json.loads(capsys.readouterr().out)
    assert set(described) == set(ALL) and all(one["summary"].endswith(".") for one in described.values())
    assert described["icing"]["told"] == ["lift_loss", "dCD", "dCm"] and described["stall"]["targets"][0] == "8 deg"
    assert described["gyro_bias"]["parameters"][0]["unit"] == "rad/s" and described["turbulence"]["variance"]


def test_an_unknown_effect_is_refused_with_its_neighbours(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["effects", "actuator_lagg"]) == 2
    said = capsys.readouterr().err
    assert "'actuator_lagg'" in said and "actuator_lag," in said and said.count("\n") == 1
