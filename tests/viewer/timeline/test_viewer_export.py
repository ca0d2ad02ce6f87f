"""What is taken away from the page: the table of a UAV, the flight as a page of its own, the picture."""

import base64
import csv
import io
import re
from unittest.mock import MagicMock

import numpy as np
import pytest
from PIL import Image
from test_viewer_timeline import fly, tape_of, timeline

from fleet.contract import Alert, AlertKind, Status
from fleet.frames import to_geodetic
from tests.support.pretend_feed import Clock, PretendUav, T, feed_of
from viewer.export import COLUMNS, Export, escape_formula, flight_html, picture, png, table
from viewer.theme.palette import DARK, rgb


@pytest.fixture
def flown():
    clock = Clock()
    feed, fleet, bus = feed_of(clock, 2)
    one = timeline(feed)
    bus.publish(Alert(uav=0, t=T, kind=AlertKind.GROUND, sentence="=HYPERLINK(1)"))
    fly(one, feed, fleet, clock, 20.0)
    bus.publish(Status(uav=0, t=T + 20.5, mode="@SUM(1)"))
    fly(one, feed, fleet, clock, 25.0)
    return one, feed


def test_the_table_says_where_it_was_and_no_word_becomes_a_formula(flown) -> None:
    one, feed = flown
    rows = list(csv.DictReader(io.StringIO(table(tape_of(one), feed.scene_frame))))
    assert tuple(rows[0]) == COLUMNS and len(rows) == len(tape_of(one))
    for row in rows:
        lat, lon, _ = to_geodetic(feed.scene_frame.origin, np.zeros(3))
        assert abs(float(row["lat_deg"]) - lat * 1e-7) < 0.02 and abs(float(row["lon_deg"]) - lon * 1e-7) < 0.02
    uav = PretendUav(0)
    ends = [float(rows[k]["alt_m"]) for k in (5, -1)]
    told = [-uav.ned(float(rows[k]["t_s"]))[2] for k in (5, -1)]
    assert ends[1] - ends[0] == pytest.approx(told[1] - told[0], abs=0.5)
    assert rows[5]["utc"].startswith("2023-11-14T22:13") and rows[-20]["state"] == "predicting"
    assert rows[-20]["alerts"] == "'=HYPERLINK(1)" and {row["mode"] for row in rows} <= {"AUTO", "'@SUM(1)", ""}
    assert all(not value.startswith(("=", "@", "+")) for row in rows for value in row.values())
    assert escape_formula("-3.5") == "-3.5" and escape_formula("-cmd") == "'-cmd"


def test_the_flight_is_a_page_that_needs_nobody(flown) -> None:
    one, feed = flown
    shares: list[float] = []
    text = flight_html(feed, one._recordings, DARK, 0, shares.append)
    data = re.search(r'__VISER_EMBED_DATA__="([^"]+)"', text)
    assert data is not None and len(base64.b64decode(data[1])) > 20_000 and len(text) < 8_000_000
    assert "<title>ParaUAV" in text and shares == sorted(shares) and shares[-1] == 1.0
    assert len(shares) == pytest.approx(50, abs=3)  # two instants a second
    with pytest.raises(ValueError, match="export: found no recording of uav-9"):
        flight_html(feed, one._recordings, DARK, 9)


def test_a_picture_has_the_sky_where_nothing_is_drawn() -> None:
    drawn = np.zeros((40, 60, 4), np.uint8)
    drawn[20:, :, :] = [200, 10, 20, 255]
    found = np.asarray(Image.open(io.BytesIO(png(drawn, DARK))))
    assert found.shape == (40, 60, 3)
    assert np.allclose(found[0, 0], rgb(DARK.sky[0]), atol=1) and (found[30, 30] == [200, 10, 20]).all()


def test_a_picture_is_no_larger_than_a_browser_can_make() -> None:
    client = MagicMock()
    client.camera.image_width, client.camera.image_height = 5_120, 2_880
    client.get_render.return_value = np.zeros((1_440, 2_560, 4), np.uint8)
    picture(client, DARK)
    assert client.get_render.call_args.args == (1_440, 2_560)


def test_what_goes_wrong_is_said_on_the_page(flown) -> None:
    one, feed = flown
    client, chosen = MagicMock(), [None]
    export = Export(client, feed, one._recordings, DARK, lambda: chosen[0])
    export._export(export._table)
    assert "found no selection" in export._status.content and not client.send_file_download.called
    chosen[0] = 0
    export._export(export._table)
    name, data = client.send_file_download.call_args.args
    assert re.fullmatch(r"parauav-uav-0-[\w.-]+\.csv", name) and data.startswith(b"t_s,utc")
    client.camera.image_width = client.camera.image_height = 100
    client.get_render.side_effect = TimeoutError("no answer")
    export._export(export._picture)
    assert "no answer" in export._status.content
