"""Map, measure tool and altitude profile in a browser: drawn, usable with the keyboard, and alive with a bad map."""

import re
import sqlite3
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.viewer.scene.test_viewer_map import around_home, mbtiles
from tests.viewer.test_browser import PATIENCE_MS
from tests.viewer.test_browser_sizes import live, until, view_of
from viewer.scene.map.tiles import TileMap, open_tiles

pytestmark = pytest.mark.browser
__all__ = ["live"]  # the page of a fleet, a fixture
NODE = "name => !!window.__viserMutable.nodeRefFromName[name]"
MEASURE = "text => (document.querySelector('.measure') || {textContent: ''}).textContent.includes(text)"
HEADINGS = "[...document.querySelectorAll('.uav b')].map(e => e.textContent)"


def tab(page, name: str):
    return page.get_by_role("tab", name=name).or_(page.locator(f'[title="{name}"]')).first


def use_tiles(live: SimpleNamespace, tiles: TileMap | None) -> None:
    """Let the viewer read its map again, as at the start of a new scene."""
    layer = live.app._terrain_layer
    layer._tiles, layer._scene_frame = tiles, None
    layer._shown_frames = dict.fromkeys(layer._shown_frames)
    until(live.page, lambda: layer._scene_frame is not None)


def test_coast_and_borders_are_there_without_any_file(live: SimpleNamespace) -> None:
    page = live.page
    page.wait_for_function(NODE, arg="/env/world", timeout=PATIENCE_MS)
    tab(page, "Display").click()
    region = page.locator(".overview svg")
    region.wait_for(state="visible", timeout=PATIENCE_MS)
    assert region.get_attribute("aria-label") == "Coast and borders around 47.40° N, 8.55° E."
    client, layer = view_of(live).client.client_id, live.app._terrain_layer
    for visible in (False, True):
        page.get_by_label("Coast and borders", exact=True).click()
        until(page, lambda visible=visible: layer._world_lines[client]._node.visible is visible)
    tab(page, "Fleet").click()
    assert live.errors == []


def test_map_tiles_are_the_ground_and_a_broken_map_is_reported(live: SimpleNamespace, tmp_path: Path) -> None:
    page, file = live.page, mbtiles(tmp_path / "region.mbtiles", around_home())
    use_tiles(live, open_tiles(str(file)))
    page.wait_for_function(NODE, arg="/terrain/ground", timeout=PATIENCE_MS)
    broken = open_tiles(str(file))
    with sqlite3.connect(file) as base:
        base.execute("DROP TABLE tiles")
    base.close()
    use_tiles(live, broken)
    page.get_by_text("region.mbtiles: found no such table").first.wait_for(timeout=PATIENCE_MS)
    use_tiles(live, None)
    page.get_by_text("region.mbtiles").first.wait_for(state="hidden", timeout=PATIENCE_MS)
    page.wait_for_function(f"name => !({NODE})(name)", arg="/terrain/ground", timeout=PATIENCE_MS)
    page.wait_for_function(NODE, arg="/env/world", timeout=PATIENCE_MS)
    assert live.errors == []


def test_measuring_with_the_keyboard_and_with_the_pointer(live: SimpleNamespace) -> None:
    page = live.page
    selected = view_of(live).selected
    page.locator("body").press("m")
    page.wait_for_function(MEASURE, arg="press the first point", timeout=PATIENCE_MS)
    page.keyboard.press("x")
    page.wait_for_function(MEASURE, arg="press the second point", timeout=PATIENCE_MS)
    page.mouse.click(560, 330)
    page.wait_for_function(MEASURE, arg="line of sight", timeout=PATIENCE_MS)
    text = page.locator(".measure").inner_text()
    assert re.search(r" → .+: [\d.,]+ k?m(, bearing \d{3}°)?, altitude [+−±]\d+ m, line of sight", text), text
    assert page.locator(".measure").get_attribute("role") == "status" and view_of(live).selected == selected
    until(page, lambda: any(tag.key == "measure" for tag in view_of(live).measure.tags))
    page.keyboard.press("m")
    page.wait_for_function("!document.querySelector('.measure')", timeout=PATIENCE_MS)
    until(page, lambda: view_of(live).measure.tags == [])  # the page hides it first, the server a moment later
    assert live.errors == []


def test_measuring_begins_with_a_button_too(live: SimpleNamespace) -> None:
    page = live.page
    tab(page, "Display").click()
    for there in (True, False):
        page.get_by_role("button", name="Measure distance").click()
        page.wait_for_function(f"!!document.querySelector('.measure') === {str(there).lower()}", timeout=PATIENCE_MS)
    tab(page, "Fleet").click()


def test_the_profile_ahead_is_a_chart_of_the_selected_aircraft(live: SimpleNamespace) -> None:
    page = live.page
    page.locator('tr[data-uav="0"]').dispatch_event("pointerdown")
    page.wait_for_function(
        f"{HEADINGS}.includes('Altitude along the route, m over km')", timeout=PATIENCE_MS, polling=200
    )
    page.get_by_text(re.compile("Prediction region at least .+ above it, .+ ahead")).first.wait_for(timeout=PATIENCE_MS)
    assert "level of home (no terrain file)" in page.locator("body").inner_text() and live.errors == []
