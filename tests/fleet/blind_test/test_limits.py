"""Limits of detection: built from graded flights, stored with their origin, shown where they matter."""

import json
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from fleet.blind_test.limits import detection_limit, limits_of, main, sources_of
from fleet.commands.offline import effects as effects_command
from fleet.effects import catalogue
from fleet.report import detection_limits as table_module
from fleet.report.detection_limits import (
    TABLE,
    DetectionLimit,
    LimitSource,
    LimitTable,
    describe_size,
    find_source,
    load_table,
    report_sentences,
)

THRUST = DetectionLimit("thrust_loss", "", "loss", 0.09, 0.4, 12, 20)
NEVER = DetectionLimit("gyro_bias", "p", "bias_dps", None, 4.0, 1, 6)
PLAIN = LimitSource("Skywalker", "model", False, 18.0, 26, 3, (1, 2), "2026-11-25", (THRUST, NEVER))


def trials(limit: float, n: int, seed: int = 0) -> list[tuple[float, bool]]:
    rng = np.random.default_rng(seed)
    sizes = np.geomspace(0.02, 0.5, n)
    slope = 4.5
    p = 1.0 / (1.0 + np.exp(-(np.log(9.0) + slope * np.log(sizes / limit))))
    return [(float(size), bool(rng.random() < chance)) for size, chance in zip(sizes, p, strict=True)]


@pytest.mark.parametrize("limit", [0.06, 0.1, 0.2])
def test_the_size_named_with_90_percent_is_recovered(limit: float) -> None:
    estimates = [detection_limit(trials(limit, 200, seed)) for seed in range(5)]
    assert np.median([x for x in estimates if x is not None]) == pytest.approx(limit, rel=0.25)


def test_a_limit_beyond_what_was_tried_is_none() -> None:
    assert detection_limit([(size, False) for size in np.geomspace(0.02, 0.5, 12)]) is None
    assert detection_limit([(0.1, True)] * 3) is None  # too few
    always = detection_limit([(float(size), True) for size in np.geomspace(0.02, 0.5, 12)])
    assert always == pytest.approx(0.02)  # the smallest tried, not less


def mark(name: str, values: dict[str, float], hit: bool, role: str = "single", part: str = "") -> dict[str, Any]:
    return {"role": role, "concealed": [name], "values": values, "hit": hit, "part": part, "airframe": "small"}


def test_limits_are_of_effect_and_part_and_of_single_effects_alone() -> None:
    marks = [mark("actuator_offset", {"offset": -s}, s > 0.08, part="rudder") for s in np.geomspace(0.02, 0.3, 10)]
    marks += [mark("airspeed_scale", {"scale": 1.0 - s}, True) for s in np.geomspace(0.02, 0.3, 10)]
    marks += [mark("icing", {"lift_loss": 0.1}, True, "compound"), mark("actuator_stuck", {}, True, part="rudder")]
    offset, scale = limits_of(marks)
    assert (offset.effect, offset.part, offset.flights) == ("actuator_offset", "rudder", 10)
    few = [mark("actuator_offset", {"offset": 0.1}, True, part="aileron") for _ in range(3)]
    pooled, _ = limits_of([*marks, *few])
    assert (pooled.part, pooled.flights) == ("", 13)
    assert offset.limit is not None and 0.06 < offset.limit < 0.15
    assert scale.limit == pytest.approx(0.02, rel=0.01) and scale.largest == pytest.approx(0.3)


def result(reference: str | None, seed: int = 1) -> dict[str, Any]:
    marks = [mark("thrust_loss", {"loss": float(s)}, bool(s > 0.1)) for s in np.geomspace(0.03, 0.4, 10)]
    facts = {"Va": 17.0, "vane": False}
    injected = {"reference": reference, "sources": {"monday": facts, "friday": facts | {"Va": 19.0}}}
    return {"seed": seed, "marks": marks, "injected": injected if reference else None}


def test_a_source_has_its_origin() -> None:
    (source,) = sources_of([result("model", 3), result("model", 9)], "Skywalker")
    assert (source.flights, source.recordings, source.seeds, source.speed) == (20, 2, (3, 9), 18.0)
    assert not source.vane and "20 flights with one concealed effect from 2 recordings" in source.origin
    (simulated,) = sources_of([result(None)], "")
    assert simulated.vane and simulated.aircraft == "JSBSim small fixed wing"
    with pytest.raises(ValueError, match="expected one reference"):
        sources_of([result("model"), result("own past")], "Skywalker")
    with pytest.raises(ValueError, match="--aircraft: found none"):
        sources_of([result("model")], "")


def test_the_generator_replaces_a_source_and_keeps_the_others(tmp_path: Path) -> None:
    out = tmp_path / "limits.json"
    for number, (reference, seed) in enumerate((("model", 1), ("own past", 2), ("model", 7))):
        path = tmp_path / f"{number}.json"
        path.write_text(json.dumps(result(reference, seed)))
        assert main([str(path), "--aircraft", "Skywalker", "--out", str(out)]) == 0
        load_table.cache_clear()
    sources = load_table(out).sources
    assert [(source.reference, source.seeds) for source in sources] == [("model", (7,)), ("own past", (2,))]
    assert main([str(tmp_path / "none.json"), "--aircraft", "x", "--out", str(out)]) == 2
    (tmp_path / "bad.json").write_text("{}")
    assert main([str(tmp_path / "bad.json"), "--aircraft", "x", "--out", str(out)]) == 2


def test_a_damaged_table_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "table.json"
    path.write_text("{")
    with pytest.raises(ValueError, match=r"table\.json: found .*rebuild it"):
        load_table(path)


@pytest.mark.parametrize(
    ("parameter", "size", "text"),
    [
        ("loss", 0.093, "9.3 %"),
        ("bias_dps", 1.24, "1.2 deg/s"),
        ("bias_mps2", 0.4, "0.4 m/s2"),
        ("dCD", 0.0031, "0.0031"),
    ],
)
def test_sizes_have_units(parameter: str, size: float, text: str) -> None:
    assert describe_size(parameter, size) == text


def test_the_nearest_aircraft_with_the_same_telemetry_and_reference_counts() -> None:
    fast = LimitSource("Fast", "model", False, 27.0, 9, 2, (1,), "2026-11-25", (THRUST,))
    table = LimitTable(sources=(PLAIN, fast))
    assert find_source(table, vane=False, own_past=False, speed=19.0) is PLAIN
    assert find_source(table, vane=False, own_past=False, speed=25.0) is fast
    assert find_source(table, vane=True, own_past=False, speed=19.0) is None
    assert find_source(table, vane=False, own_past=True, speed=19.0) is None
    assert find_source(table, vane=False, own_past=False, speed=80.0) is None


def test_a_report_says_what_would_have_been_named_and_where_that_comes_from() -> None:
    above, never, origin = report_sentences(PLAIN, [])
    assert above == "would have been named here with 90% probability above: thrust_loss 9 %"
    assert never == "not named reliably at any magnitude tried: gyro_bias (p)" and "Skywalker" in origin
    assert not any("thrust_loss" in sentence for sentence in report_sentences(PLAIN, ["thrust_loss"]))
    rare = msgspec.structs.replace(PLAIN, limits=(msgspec.structs.replace(NEVER, flights=3),))
    assert report_sentences(rare, []) == ()  # three flights say nothing
    assert report_sentences(None, []) == ()


def test_effects_show_their_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(effects_command, "load_table", lambda: LimitTable(sources=(PLAIN,)))
    text = effects_command.as_text(catalogue("")["thrust_loss"])
    assert "loss 9 %, 12 of 20 named; Skywalker, against model" in " ".join(text.split())
    assert "bias_dps p none up to 4 deg/s" in " ".join(effects_command.as_text(catalogue("")["gyro_bias"]).split())
    (shown,) = effects_command.as_json(catalogue("")["thrust_loss"])["detection_limits"]
    assert shown["limit"] == 0.09 and "Skywalker" in shown["origin"]


def test_the_shipped_table_is_complete_and_of_known_effects() -> None:
    assert Path(table_module.__file__).with_suffix(".json") == TABLE
    table, known = load_table(), catalogue("")
    assert len(table.sources) >= 3
    for source in table.sources:
        assert source.limits and source.made and source.seeds
        for one in source.limits:
            assert one.effect in known and one.named <= one.flights
            assert one.limit is None or 0.0 < one.limit <= one.largest * 1.001
