"""The report for people: figures and page, from made-up diagnoses."""

import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from fleet.effects import catalogue
from tests.support.diagnosed import LENGTH, NAN, made
from twin_worker.diagnosis.inference.report import FigureSeries, ReportOutcome
from twin_worker.diagnosis.model.baseline import CHANNELS
from twin_worker.diagnosis.output.figures import KINDS, draw, stems
from twin_worker.diagnosis.output.page import amount, unit, write
from twin_worker.diagnosis.output.traces import CHANNEL_TEXT, choose_channels, format_segments, marks, true_segments


class Reader(HTMLParser):
    """Reads a page strictly enough to notice tags that do not close."""

    VOID = ("meta", "img", "br")

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.words: list[str] = []
        self.images: list[str] = []
        self.feed(text)
        self.close()
        assert not self.open, f"never closed: {self.open}"

    def handle_starttag(self, tag: str, attrs: list) -> None:
        self.tags.append(tag)
        assert not any(name.startswith("on") for name, _ in attrs)
        if tag == "img":
            self.images.append(dict(attrs)["src"])
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words.append(data)


def read(path: Path) -> Reader:
    return Reader(path.read_text(encoding="utf-8"))


@pytest.mark.parametrize("outcome", ReportOutcome)
def test_every_outcome_makes_four_pictures_and_a_page(outcome: ReportOutcome, tmp_path: Path) -> None:
    report = made(outcome=outcome)
    page = read(write([report], tmp_path))
    files = [tmp_path / f"s07-lag-{kind}.png" for kind in KINDS]
    assert sorted(tmp_path.iterdir()) == sorted([*files, tmp_path / "index.html"])
    for path in files:
        assert path.stat().st_size < 300_000
        with Image.open(path) as picture:
            assert picture.size[0] > 1000
    assert len(page.images) == 4 and all(src.startswith("data:image/png;base64,") for src in page.images)
    words = " ".join(page.words)
    assert report.sentence in words
    assert ("free-form" in words) == (outcome is ReportOutcome.UNKNOWN)
    assert ("0.2530 ± 0.0061" in words) == (outcome in (ReportOutcome.NAMED, ReportOutcome.SUSPECTED))
    assert "5 Hz" in words


def test_nothing_is_fetched_and_nothing_runs(tmp_path: Path) -> None:
    text = write([made()], tmp_path).read_text()
    assert "http://" not in text and "https://" not in text and "url(" not in text and "<script" not in text
    assert "default-src 'none'" in text


def test_a_hostile_name_is_only_a_name(tmp_path: Path) -> None:
    name = "../../<script>alert('$x$')</script>\x1b[31m\udc80"
    hostile = replace(made(name), sentence="<img src=x onerror=alert(1)>", limitations=("<b>", "&amp;"))
    folder = tmp_path / "in" / "here"
    page = read(write([hostile], folder))
    assert "script" not in page.tags and page.tags.count("img") == 4
    assert any("<script>alert('$x$')</script>?[31m?" in words for words in page.words)
    assert "&amp;" in page.words
    assert [path.parent for path in tmp_path.rglob("*.png")] == [folder] * 4
    assert not any(path.name.startswith(".") for path in folder.iterdir())


def test_files_of_flights_are_never_the_same_nor_elsewhere() -> None:
    names = stems(["a/b", "a_b", "..", "/", "", ".hidden", "x" * 300, "x" * 299, "Flug ü", "-rf", "a/b"])
    assert len(set(names)) == len(names)
    assert all(re.fullmatch(r"[\w-]+", name) and len(name) < 60 for name in names)
    assert "Flug_ü" in names


def test_several_flights_have_a_page_each_and_an_overview(tmp_path: Path) -> None:
    reports = [
        made("one", seed=1),
        made("one", ReportOutcome.NONE, seed=2),
        made("index", ReportOutcome.UNKNOWN, seed=3),
    ]
    overview = write(reports, tmp_path).read_text()
    read(tmp_path / "index.html")
    for stem, report in zip(("one", "one-2", "index-2"), reports, strict=True):
        assert report.sentence in overview and f'href="{stem}.html"' in overview
        page = read(tmp_path / f"{stem}.html")
        assert report.sentence in " ".join(page.words) and len(page.images) == 4
    assert len(list(tmp_path.glob("*.png"))) == 12


def test_without_flights_the_page_says_so(tmp_path: Path) -> None:
    assert "Diagnosis of 0 flights" in " ".join(read(write([], tmp_path)).words)


def test_what_is_not_there_is_left_blank(tmp_path: Path) -> None:
    """A channel, the accelerometer, the position, every row: none of it may be missing and break a picture."""
    report = made(effects=3)
    series = report.series
    blank = np.full_like(series.before, NAN)
    channel = blank.copy()
    channel[:, 1:] = series.before[:, 1:]
    nothing = np.full((len(series.t), 3), NAN)
    for k, less in enumerate(
        (
            replace(series, before=channel, after=channel),
            replace(series, before=blank, after=blank, measured=nothing, position=nothing),
            replace(series, ok=np.zeros_like(series.ok), held_out=np.zeros_like(series.held_out)),
            FigureSeries(*(x[:0] for x in vars(series).values())),
        )
    ):
        assert all(path.exists() for path in draw(replace(report, series=less), tmp_path, f"less-{k}"))
    names, title = choose_channels(replace(report, series=replace(series, before=channel)))
    assert "force_x" not in names and "1 without data" in title


def test_only_channels_that_differ_are_drawn_and_the_others_counted(tmp_path: Path) -> None:
    report = made()
    ratios = dict.fromkeys(CHANNELS, 1.0)
    names, title = choose_channels(replace(report, ratio_before=ratios | {"pitch": 9.0, "lift": 12.0}))
    assert names == ["lift", "pitch"] and title == "12 of 14 channels at their usual"
    wide = replace(report, ratio_before=dict.fromkeys(CHANNELS, 2.0))
    assert all(path.stat().st_size < 300_000 for path in draw(wide, tmp_path))
    names, title = choose_channels(wide)
    assert len(names) == 8 and "0 of 14" in title and "worst 8 of the other 14" in title
    names, title = choose_channels(replace(report, ratio_before=ratios))
    assert len(names) == 4 and "14 of 14" in title


def test_every_channel_has_a_meaning() -> None:
    assert set(CHANNEL_TEXT) == set(CHANNELS)


def test_onsets_and_segments() -> None:
    found = marks(made(effects=3))
    assert [mark.onset_times((0.0, LENGTH)) for mark in found] == [[83.0], [], [140.0]]
    assert len({mark.colour for mark in found}) == 3
    assert [mark.name for mark in marks(made(outcome=ReportOutcome.UNKNOWN))] == ["unknown, pitch acceleration"]
    assert format_segments([(1.0, 2.0), (3.0, 4.4), (5.0, 6.0), (7.0, 8.0)]) == "1–2, 3–4, 5–6 s and 1 more"
    assert true_segments(np.arange(6.0), np.array([1, 1, 0, 0, 1, 1], bool)) == [(0.0, 1.0), (4.0, 5.0)]


@pytest.mark.parametrize(
    ("value", "sigma", "said"),
    [
        (0.2534, 0.0061, "0.2534 ± 0.0061"),
        (213.7, 4.42, "213.7 ± 4.4"),
        (1234.5, 230.0, "1234 ± 230"),
        (0.5, NAN, "0.5 ± not known"),
        (0.5, 0.0, "0.5 ± not known"),
        (float("inf"), 0.1, "not known"),
    ],
)
def test_numbers_are_written_to_what_is_known_of_them(value: float, sigma: float, said: str) -> None:
    assert amount(value, sigma) == said


def test_units_come_from_the_names() -> None:
    lag, shear = catalogue()["actuator_lag"], catalogue()["wind_shear"]
    names = ("tau_s", "speed_mps", "bias_mps2", "from_deg", "rate_per_s", "slope_lost_per_rad", "dmass_kg", "dx_m")
    assert [unit(name, lag) for name in names] == ["s", "m/s", "m/s²", "°", "1/s", "1/rad", "kg", "m"]
    assert unit("mps_per_100m", shear) == "m/s per 100 m" and unit("w_n", shear) == "m/s" and unit("loss", lag) == "–"
