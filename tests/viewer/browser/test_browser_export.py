"""What the export buttons give in a browser, and the notice of software rendering."""

import csv
import io
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from tests.viewer.test_browser import FEW_FRAMES, IN_SCENE, PATIENCE_MS
from tests.viewer.test_browser_sizes import live, until, view_of
from viewer.export import COLUMNS

pytestmark = pytest.mark.browser
__all__ = ["live"]  # the page of a fleet, a fixture
DRAWN = "[...document.querySelectorAll('canvas')].some(canvas => canvas.width > 100)"
NOTICE = ".mantine-Notification-root.software"
NOTED = """(() => {  // size and close button of the notice when it is first there, and how long it stays
  window.notice = {};
  setInterval(() => {
    const seen = document.querySelector('.mantine-Notification-root.software');
    const box = seen && seen.getBoundingClientRect(), now = performance.now();
    if (box && box.width) {
      const close = seen.querySelector('button');
      notice.first = notice.first || {width: box.width, height: box.height, close: !!close, since: now};
      notice.until = now;
    }
  }, 20);
})()"""


def colours(image: bytes) -> int:
    """Return the number of colours of a picture, in 16 levels each."""
    pixels = np.asarray(Image.open(io.BytesIO(image)).convert("RGB")) // 16
    return len(np.unique(pixels.reshape(-1, 3), axis=0))


def downloaded(live: SimpleNamespace, button: str, folder: Path) -> Path:
    with live.page.expect_download(timeout=2 * PATIENCE_MS) as waiting:
        live.page.get_by_role("button", name=button).click()
    path = folder / waiting.value.suggested_filename
    waiting.value.save_as(path)
    return path


def test_picture_film_and_table_are_saved_and_the_film_opens_from_disk(live: SimpleNamespace, tmp_path: Path) -> None:
    page, uav = live.page, 3
    page.locator(f'tr[data-uav="{uav}"]').dispatch_event("pointerdown")
    until(page, lambda: view_of(live).selected == uav)
    until(page, lambda: len(live.app.recordings.by_uav.get(uav, ())) > 20)
    page.get_by_role("tab", name="Export").click()
    table = downloaded(live, "Selected UAV as CSV", tmp_path)
    rows = list(csv.DictReader(io.StringIO(table.read_text())))
    assert table.name.startswith(f"parauav-uav-{uav}-") and tuple(rows[0]) == COLUMNS and len(rows) > 20
    picture = downloaded(live, "View as PNG", tmp_path)
    assert picture.suffix == ".png" and colours(picture.read_bytes()) > 6
    film = downloaded(live, "Flight as HTML", tmp_path)
    page.get_by_role("tab", name="Timeline").click()
    errors: list[str] = []
    offline = page.context.browser.new_context(offline=True)  # nothing but the file
    alone = offline.new_page()
    alone.on("pageerror", lambda error: errors.append(str(error)))
    alone.goto(film.as_uri())
    alone.wait_for_function(DRAWN, timeout=PATIENCE_MS)
    for _ in range(60):  # a software renderer takes its time
        if colours(alone.screenshot()) > 6:
            break
    assert colours(alone.screenshot()) > 6 and alone.title() == "ParaUAV: a flight" and errors == []
    offline.close()
    assert live.errors == []


def test_the_notice_of_software_rendering_is_small_closable_and_shown_once(live: SimpleNamespace) -> None:
    context = live.page.context.browser.new_context(viewport={"width": 1280, "height": 720})
    page = context.new_page()
    page.add_init_script(FEW_FRAMES)
    page.add_init_script(NOTED)
    page.goto(live.page.url)
    page.wait_for_function("!!window.notice.first", timeout=PATIENCE_MS)
    first = page.evaluate("window.notice.first")
    assert first["width"] < 0.4 * 1280 and first["height"] < 0.2 * 720 and first["close"]
    page.locator(NOTICE).wait_for(state="detached", timeout=PATIENCE_MS)
    page.reload()
    page.wait_for_function(IN_SCENE, timeout=PATIENCE_MS)
    page.locator(NOTICE).wait_for(state="detached", timeout=PATIENCE_MS)
    stayed = page.evaluate("(({first, until}) => first ? until - first.since : 0)(window.notice)")
    assert stayed < 2_000  # the client raises it at each visit; the page closes it at once
    context.close()
