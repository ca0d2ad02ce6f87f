"""The page in a browser on a phone, a laptop and a large screen, dark and light: boxes, contrast, keys, one truth."""

import base64
import contextlib
import os
import threading
import time
from collections.abc import Callable, Iterator
from itertools import combinations
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from conftest import unused_port
from playwright.sync_api import TimeoutError as TooLate

from fleet.contract import Prediction, TwinState
from tests.bench.viewing.page import NOTE_LABELS, PLACES, differing, drawn, labels_differing
from tests.support.memory_bus import MemoryBus
from tests.support.pretend_feed import PretendFleet
from tests.viewer.test_browser import ARGS, FEW_FRAMES, IN_SCENE, PATIENCE_MS, SCHEME
from viewer.browser.http_server import serve, stop_server
from viewer.scene.labels import EM_PX, overlap
from viewer.server.app import App
from viewer.store.forecast import ScenePrediction

pytestmark = pytest.mark.browser
UAVS, LOST, SHORT = 10, 5, 6  # one loses its link, one has an alert of a short horizon
CONSISTENCY_S = float(os.environ.get("PARAUAV_CONSISTENCY_S", "3"))
SIZES = {"1280x720": (1280, 720), "1920x1080": (1920, 1080), "390x844": (390, 844)}
FONT = 'system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif'
CUT = """() => {
  const bad = [], seen = e => e.getClientRects().length && getComputedStyle(e).visibility !== 'hidden';
  const boxes = [...document.querySelectorAll('.uav h1, .uav td, .uav th, .uav .card b, .uav .chip, .legend span, ' +
    '.uav.buttons button, .uav .say')].filter(seen);
  for (const e of boxes) {
    const r = e.getBoundingClientRect();
    const block = getComputedStyle(e).display !== 'inline';
    if (block && e.scrollWidth > e.clientWidth + 1) bad.push('cut: ' + e.textContent);
    if (r.right > innerWidth + 1 || r.left < -1) bad.push('outside: ' + e.textContent);
  }
  const bars = [...document.querySelectorAll('[data-mantine-scrollbar][data-orientation=vertical]')];
  for (const bar of bars.filter(seen)) {
    const edge = bar.getBoundingClientRect().left, area = bar.parentElement.getBoundingClientRect();
    for (const e of bar.parentElement.querySelectorAll('button, input, .uav td, .uav th, .uav .card, .uav .say, h1')) {
      const r = e.getBoundingClientRect(), padded = parseFloat(getComputedStyle(e).paddingRight) || 0;
      const end = e.matches('td, th') ? r.right - padded : r.right;
      if (seen(e) && r.bottom > area.top && r.top < area.bottom && end > edge - 2)
        bad.push('at the scroll bar: ' + (e.textContent || e.getAttribute('aria-label') || e.tagName));
    }
  }
  const choices = [...document.querySelectorAll('button.mantine-Button-root')].filter(
    e => seen(e) && ['All', 'Alerts', 'Selected'].includes(e.textContent)).map(e => e.getBoundingClientRect().top);
  if (new Set(choices).size > 1) bad.push('the choices of Show are in several rows');
  const entries = [...document.querySelectorAll('.legend span')];
  if (entries.length < 5) bad.push('the legend has ' + entries.length + ' entries');
  bad.push(...entries.filter(e => !seen(e)).map(e => 'not in the legend: ' + e.textContent));
  for (const group of ['.legend', '.uav .cards', '.uav.buttons', 'tr.on']) {
    const parts = [...(document.querySelector(group) || {children: []}).children].filter(seen);
    parts.forEach((a, i) => parts.slice(i + 1).forEach(b => {
      const p = a.getBoundingClientRect(), q = b.getBoundingClientRect();
      if (p.left < q.right - 1 && q.left < p.right - 1 && p.top < q.bottom - 1 && q.top < p.bottom - 1)
        bad.push('overlap: ' + a.textContent + ' | ' + b.textContent);
    }));
  }
  return bad;
}"""
CONTRAST = """() => {
  const parse = text => (text.match(/[\\d.]+/g) || [0, 0, 0, 0]).map(Number);
  const light = c => c.slice(0, 3).map(v => v / 255).map(v => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4)
    .reduce((sum, v, i) => sum + v * [0.2126, 0.7152, 0.0722][i], 0);
  const behind = e => { for (; e; e = e.parentElement) {
    const c = parse(getComputedStyle(e).backgroundColor);
    if (c.length < 4 || c[3] > 0.99) return c; } return [0, 0, 0]; };
  const bad = [];
  for (const e of document.querySelectorAll('.uav *')) {
    const own = [...e.childNodes].some(n => n.nodeType === 3 && n.textContent.trim());
    if (!own || !e.getClientRects().length || e.closest('svg')) continue;
    const [a, b] = [light(parse(getComputedStyle(e).color)), light(behind(e))];
    const ratio = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
    const sign = e.textContent.trim().length === 1 && !/\\w/.test(e.textContent);  // graphics need less
    if (ratio < (sign ? 3 : 4.5)) bad.push(ratio.toFixed(2) + ' ' + e.textContent.slice(0, 40));
  }
  return bad;
}"""
WIDTHS = """([texts, font]) => { const pen = document.createElement('canvas').getContext('2d'); pen.font = font;
  return texts.map(text => pen.measureText(text).width); }"""
LONG_LIST = ".uav.list table { margin-bottom: 900px; }"  # the list of a fleet, longer than the window
LABEL_PIXELS = """async ([box, png]) => {  // of a screenshot: relative luminance in a box [CSS px]
  const image = await createImageBitmap(await (await fetch('data:image/png;base64,' + png)).blob());
  const canvas = document.createElement('canvas'); canvas.width = image.width; canvas.height = image.height;
  const pen = canvas.getContext('2d'); pen.drawImage(image, 0, 0);
  const [left, top, width, height] = box, pixels = pen.getImageData(left, top, width, height).data, found = [];
  for (let i = 0; i < pixels.length; i += 4)
    found.push([0.2126, 0.7152, 0.0722].reduce((sum, weight, k) => sum + weight * (pixels[i + k] / 255) ** 2.2, 0));
  return found.sort((a, b) => a - b);
}"""
SHARE = "window.__viserMutable.canvas.getBoundingClientRect().width / innerWidth"
SCROLL_BARS = """[...document.querySelectorAll('[data-mantine-scrollbar][data-orientation=vertical]')].filter(
  e => e.getClientRects().length && e.parentElement.querySelector('.uav.list')).length"""
BARS_IN_REACH = """() => [...document.querySelectorAll('[role=button][aria-expanded]')].every(
  e => e.getBoundingClientRect().bottom <= innerHeight + 1)"""
WIDE = """[...document.querySelectorAll('.mantine-Paper-root .mantine-ScrollArea-content')].filter(
  e => e.getBoundingClientRect().width > innerWidth + 1).length"""
SMALL = """[...document.querySelectorAll('.mantine-Paper-root :is(button, input:not([type=checkbox]))')].filter(
  e => e.getClientRects().length && e.getBoundingClientRect().height < 36).map(e => e.outerHTML.slice(0, 120))"""
AT_ZERO_SCROLL = "document.documentElement.scrollWidth <= innerWidth"


class Wild(PretendFleet):
    """A fleet whose horizons and fits change with each message, and one of which falls silent."""

    def __init__(self, bus: MemoryBus, uavs: int) -> None:
        super().__init__(bus, uavs)
        publish, start = bus.publish, time.time()
        self.predictions: list[Prediction] = []

        def changed(message, *more):
            if isinstance(message, Prediction):
                message = msgspec.structs.replace(message, horizon_s=6.0 + (message.t * 7.0) % 20.0)
                self.predictions.append(message)
            publish(message, *more)

        bus.publish, self._silent_from = changed, start + 1.0
        self.uavs[LOST].state = TwinState.LINK_LOST

    def advance(self, t: float) -> None:  # type: ignore[override]
        super().advance(t, lost_since=self._silent_from)


@contextlib.contextmanager
def page_of(chromium: str, make: Callable[[MemoryBus], Any]) -> Iterator[SimpleNamespace]:
    """A viewer in this process with a fleet that flies, `make(bus)`, and a browser with its page."""
    from playwright.sync_api import sync_playwright

    port, bus, stop = unused_port(), MemoryBus(), threading.Event()
    server = serve("127.0.0.1", port)
    app, fleet = App(bus, server), make(bus)

    def fly() -> None:
        while not stop.wait(0.1):
            fleet.advance(time.time())

    threads = [threading.Thread(target=fly), threading.Thread(target=app.run, args=(stop,))]
    for thread in threads:
        thread.start()
    errors: list[str] = []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=ARGS)
        page = browser.new_page(viewport={"width": 1280, "height": 720})
        page.add_init_script(FEW_FRAMES)
        page.add_init_script(NOTE_LABELS)
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(f"http://127.0.0.1:{port}/?fixedDpr=0.5")
        page.wait_for_function(IN_SCENE, timeout=PATIENCE_MS)
        yield SimpleNamespace(page=page, app=app, errors=errors, predictions=fleet.predictions)
        browser.close()
    stop.set()
    for thread in threads:
        thread.join()
    stop_server(server)


@pytest.fixture(scope="module")
def live(chromium: str) -> Iterator[SimpleNamespace]:
    """The page of a small fleet."""
    with page_of(chromium, lambda bus: Wild(bus, UAVS)) as site:
        yield site


def until(page, true) -> None:
    """Let the page go on until something is true of the server."""
    for _ in range(600):
        if true():
            return
        page.evaluate("new Promise(done => setTimeout(done, 100))")
    pytest.fail("it never was")


def labels_fit(page, view, height: int) -> bool:
    """Return whether every visible label has a box wider than its text."""
    texts = [node.text for node in view._labels._nodes if node.visible]
    room = sorted(float(box[1, 0] - box[0, 0]) * height for box in view._labels.boxes)
    widths = sorted(page.evaluate(WIDTHS, [texts, f"{EM_PX}px {FONT}"]))
    return len(room) == len(widths) and all(a > b for a, b in zip(room, widths, strict=True))


def settle_to_nothing(page, faults: str) -> None:
    """Wait until a script finds no faults of the page; fail with those that remain."""
    with contextlib.suppress(TooLate):
        page.wait_for_function(f"({faults})().length === 0", timeout=PATIENCE_MS)
    assert page.evaluate(faults) == []


def view_of(live: SimpleNamespace):
    return next(iter(live.app.views.values()))


def drawn_since(view, live: SimpleNamespace) -> bool:
    """Let the labels be drawn once more."""
    before = view._labels.boxes
    until(live.page, lambda: view._labels.boxes is not before)
    return True


def test_keys_select_the_next_and_the_previous_row(live: SimpleNamespace) -> None:
    page = live.page
    rows = "[...document.querySelectorAll('.uav.list tr.pick')].findIndex(row => row.classList.contains('on'))"
    page.locator("tr.pick").first.dispatch_event("pointerdown")
    page.wait_for_function(f"{rows} === 0", timeout=PATIENCE_MS)
    uav = page.evaluate("document.querySelectorAll('tr.pick')[1].dataset.uav")
    page.keyboard.press("j")
    page.wait_for_function("uav => document.querySelector('tr.on').dataset.uav === uav", arg=uav, timeout=PATIENCE_MS)
    page.keyboard.press("k")
    page.wait_for_function("uav => document.querySelector('tr.on').dataset.uav !== uav", arg=uav, timeout=PATIENCE_MS)
    assert live.errors == []


def compare_places(live: SimpleNamespace, uav: int, *, silent: bool = False) -> list[dict]:
    """Select a UAV and compare row, tiles, labels, ring and messages; return the looks at the whole scene.

    Three seconds, twenty looks a second; with PARAUAV_CONSISTENCY_S=60 a minute, and `-s` prints counts. Labels and
    ring are compared three frames after a change of the row: a scene is drawn with the next frame.
    """
    page = live.page
    page.locator(f'tr[data-uav="{uav}"]').dispatch_event("pointerdown")
    page.wait_for_function(
        "uav => document.querySelector('tr.on').dataset.uav === uav", arg=str(uav), timeout=PATIENCE_MS
    )
    samples: list[dict] = []
    shown: list[dict] = []
    rings: list[dict] = []
    for _ in range(20):  # a busy machine draws few rows in three seconds, few of them with their labels and a ring
        samples += page.evaluate(PLACES, CONSISTENCY_S)
        shown = drawn(samples, with_ring=not silent)
        labelled = any(text.startswith("UAV") for one in shown for text in one["label"])
        rings = [one for one in shown if one["ring"] is not None and one["row"][1] != "–" and not silent]
        if labelled and (rings or silent) and len({tuple(one["row"]) for one in samples}) > 2:
            break
    assert labelled and (rings or silent) and len({tuple(one["row"]) for one in samples}) > 2
    assert differing(samples) == []
    assert [(one["row"], one["label"]) for one in labels_differing(shown)] == []
    forecasts = [ScenePrediction(m, live.app.store.scene_frame, 0.0) for m in list(live.predictions) if m.uav == uav]
    ends = np.array([one.position_at(one.horizon_s) for one in forecasts])
    for one in rings:  # the ring belongs to one message, and its horizon stands in the row
        distance = np.linalg.norm(ends - one["ring"], axis=1)
        near = [forecasts[k] for k in np.flatnonzero(distance < max(1e-3, 1.001 * float(distance.min())))]
        texts = {f"{'≥ ' if f.message.horizon_open else ''}{f.horizon_s:.0f} s" for f in near}
        assert distance.min() < 1e-3 and one["row"][1] in texts, one
    print(
        f"uav {uav}: {len(samples)} looks at row, tiles and state, {len({tuple(one['row']) for one in samples})} rows; "
        f"{len(shown)} with labels, {len(rings)} with ring and message: no difference"
    )
    return shown


@pytest.mark.parametrize("uav", [0, SHORT, LOST])
def test_all_places_of_the_page_show_what_the_bus_carries(live: SimpleNamespace, uav: int) -> None:
    compare_places(live, uav, silent=uav == LOST)
    if uav == SHORT:
        page = live.page
        page.get_by_role("tab", name="Alerts").click()
        page.locator(".uav .say.pick", has_text=f"UAV-{uav:03d}").wait_for(timeout=PATIENCE_MS)
        alerts = page.evaluate(PLACES, max(CONSISTENCY_S, 2.0))
        page.get_by_role("tab", name="Fleet").click()
        assert len({tuple(one["alert"]) for one in alerts if any(one["alert"])}) > 1 and differing(alerts) == []
        print(f"{len(alerts)} looks at the alert: no difference")


@pytest.mark.parametrize("light", [False, True], ids=["dark", "light"])
@pytest.mark.parametrize("size", SIZES)
def test_nothing_is_cut_or_covered_at_this_size(live: SimpleNamespace, size: str, *, light: bool) -> None:
    page, (width, height) = live.page, SIZES[size]
    page.set_viewport_size({"width": width, "height": height})
    view_of(live).browser.set_theme(light=light)
    page.wait_for_function(SCHEME, arg="light" if light else "dark", timeout=PATIENCE_MS)
    until(page, lambda: view_of(live).browser.layout[:2] == (width, height) and view_of(live).palette.dark != light)
    view = view_of(live)
    until(page, lambda: view.selection.tags and view.panels._table.content and view._labels.boxes)
    page.locator("tr.on").first.wait_for(state="attached", timeout=PATIENCE_MS)
    if width > 600:
        page.wait_for_function(f"{SHARE} >= 0.6", timeout=PATIENCE_MS)
    settle_to_nothing(page, CUT)
    if width > 600:
        style = page.add_style_tag(content=LONG_LIST)
        page.wait_for_function(f"{SCROLL_BARS} > 0", timeout=PATIENCE_MS)
        settle_to_nothing(page, CUT)
        style.evaluate("style => style.remove()")
    assert page.evaluate(CONTRAST) == [] and page.evaluate(AT_ZERO_SCROLL)
    until(page, lambda: (view.browser.layout.bottom > 0.4 * height) == (width < 600))  # the sheet, or the timeline
    until(page, lambda: 0 < view.browser.layout.top < 80)  # the header may be measured after the sheet
    until(page, lambda: view.camera.view().bottom_px == view.browser.layout.bottom and drawn_since(view, live))
    layout, boxes = view.browser.layout, list(view._labels.boxes)
    assert not any(overlap(a, b) for a, b in combinations(boxes, 2))
    assert all(box[0, 1] >= -0.5 + layout.bottom / height and box[1, 1] <= 0.5 - layout.top / height for box in boxes)
    until(page, lambda: labels_fit(page, view, height))  # labels come and go between two looks
    assert live.errors == []


@pytest.mark.parametrize("light", [False, True], ids=["dark", "light"])
def test_labels_in_the_scene_have_the_colours_of_the_theme(live: SimpleNamespace, *, light: bool) -> None:
    """Most of a label is its ground; the letters differ from it by the contrast of WCAG AA."""
    page = live.page
    page.set_viewport_size({"width": 1280, "height": 720})
    view_of(live).browser.set_theme(light=light)
    page.wait_for_function(SCHEME, arg="light" if light else "dark", timeout=PATIENCE_MS)
    until(page, lambda: view_of(live).palette.dark != light and view_of(live)._labels.boxes)
    canvas = page.evaluate("(r => [r.x, r.y, r.width, r.height])(window.__viserMutable.canvas.getBoundingClientRect())")

    def grounds() -> tuple[float, float]:
        """Return ground of the first label and contrast of its letters: luminance and ratio."""
        (left, low), (right, high) = view_of(live)._labels.boxes[0] * canvas[3]
        box = canvas[0] + canvas[2] / 2 + left, canvas[1] + canvas[3] / 2 - high, right - left, high - low
        inner = [box[0] + 0.2 * box[2], box[1] + 0.2 * box[3], 0.6 * box[2], 0.6 * box[3]]
        png = base64.b64encode(page.screenshot()).decode()
        found = np.array(page.evaluate(LABEL_PIXELS, [[round(x) for x in inner], png]))
        ground, letters = np.median(found), found[0 if light else -1]
        return float(ground), float((max(ground, letters) + 0.05) / (min(ground, letters) + 0.05))

    until(page, lambda: (grounds()[0] > 0.5) == light)
    until(page, lambda: grounds()[1] > 4.5)


def test_a_phone_has_list_detail_and_timeline_as_sheets(live: SimpleNamespace) -> None:
    page = live.page
    page.set_viewport_size({"width": 390, "height": 844})
    page.locator('tr[data-uav="3"]').click(timeout=PATIENCE_MS)
    page.wait_for_function("document.querySelector('tr.on').dataset.uav === '3'", timeout=PATIENCE_MS)
    page.wait_for_function(BARS_IN_REACH, timeout=PATIENCE_MS)  # without scrolling
    for name, shown in (("Selected", ".uav .cards"), ("Timeline", ".uav.buttons")):
        assert page.evaluate(SMALL) == []
        bar = page.get_by_role("button", name=f"Expand panel {name}")
        assert bar.bounding_box()["height"] >= 44  # for a thumb
        bar.press("Enter")
        page.locator(shown).wait_for(state="visible", timeout=PATIENCE_MS)
        assert not page.locator(".uav.list").is_visible() and page.evaluate(WIDE) == 0
        page.get_by_role("button", name=f"Collapse panel {name}").dispatch_event("click")
        page.locator(".uav.list").wait_for(state="visible", timeout=PATIENCE_MS)
    assert page.evaluate("document.elementFromPoint(195, 200).tagName") == "CANVAS" and live.errors == []
