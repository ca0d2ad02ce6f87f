"""The page for people who need more than a mouse and good eyes: axe-core on every size and theme, text boxes, keys."""

import contextlib
from types import SimpleNamespace

import numpy as np
import pytest
from axe_playwright_python.sync_playwright import Axe
from conftest import unused_port
from playwright.sync_api import TimeoutError as TooLate

from tests.viewer.test_browser import FEW_FRAMES, PATIENCE_MS, SCHEME
from tests.viewer.test_browser_sizes import SIZES, live, until, view_of
from viewer.browser.http_server import serve, stop_server

pytestmark = pytest.mark.browser
__all__ = ["live"]  # the page of a fleet, a fixture
GRAVE = ("serious", "critical")
RULES = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa", "best-practice"]
NAMED = """() => [...document.querySelectorAll('button, input')].every(
  e => e.textContent.trim() || e.getAttribute('aria-label') || !e.getClientRects().length || e.labels.length)"""
TEXTS = """() => {  // every visible line of text with its box; the pointer finds nothing covered or scrolled away
  const lines = [], walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  for (let node = walker.nextNode(); node; node = walker.nextNode()) {
    const parent = node.parentElement, style = parent && getComputedStyle(parent);
    if (!node.textContent.trim() || !style || style.visibility !== 'visible') continue;
    if (parent.closest('style, script, svg')) continue;
    const range = document.createRange();
    range.selectNodeContents(node);
    for (const r of range.getClientRects()) {
      const x = r.left + r.width / 2, y = r.top + r.height / 2;
      if (r.width < 2 || x < 0 || y < 0 || x > innerWidth || y > innerHeight) continue;
      const top = document.elementFromPoint(x, y);
      if (style.pointerEvents !== 'none' && !(top && (parent.contains(top) || top.contains(parent)))) continue;
      lines.push({node, parent, text: node.textContent.trim().slice(0, 40), r});
    }
  }
  return lines;
}"""
CUT_OR_OVERLAPPING = f"""() => {{
  const lines = ({TEXTS})(), bad = [];
  for (const {{parent, text, r}} of lines) {{
    if (r.right > innerWidth + 1 || r.left < -1) bad.push('outside the window: ' + text);
    for (let e = parent; e && e !== document.body; e = e.parentElement) {{
      const style = getComputedStyle(e), box = e.getBoundingClientRect();
      if (style.position === 'fixed') break;
      const wide = /hidden|clip/.test(style.overflowX) && (r.right > box.right + 1 || r.left < box.left - 1);
      const tall = /hidden|clip/.test(style.overflowY) && (r.bottom > box.bottom + 3 || r.top < box.top - 3);
      if (wide || tall) bad.push('cut: ' + text);
      if (/auto|scroll/.test(style.overflowY)) break;  // scrolled: its own edge cuts by design
    }}
  }}
  lines.forEach((a, i) => lines.slice(i + 1).forEach(b => {{
    const w = Math.min(a.r.right, b.r.right) - Math.max(a.r.left, b.r.left);
    const h = Math.min(a.r.bottom, b.r.bottom) - Math.max(a.r.top, b.r.top);
    if (w > 2 && h > 4) bad.push('overlap: ' + a.text + ' | ' + b.text);
  }}));
  return bad;
}}"""


def show(page, live: SimpleNamespace, size: str, *, light: bool) -> None:
    """Set size and theme and wait until the page is drawn with both."""
    width, height = SIZES[size]
    page.set_viewport_size({"width": width, "height": height})
    view_of(live).browser.set_theme(light=light)
    page.wait_for_function(SCHEME, arg="light" if light else "dark", timeout=PATIENCE_MS)
    until(page, lambda: view_of(live).browser.layout[:2] == (width, height) and view_of(live).palette.dark != light)
    page.locator("tr.on").first.wait_for(state="attached", timeout=PATIENCE_MS)
    page.wait_for_function(NAMED, timeout=PATIENCE_MS)


def serious(page) -> list[str]:
    """What axe-core objects to, gravest kinds only."""
    options = {"resultTypes": ["violations"], "runOnly": RULES}
    return [
        f"{one['impact']} {one['id']}: {node['html'][:150]}: {node['failureSummary'][:250]}"
        for one in Axe().run(page, options=options).response["violations"]
        for node in one["nodes"]
        if one["impact"] in GRAVE
    ]


@pytest.mark.parametrize("light", [False, True], ids=["dark", "light"])
@pytest.mark.parametrize("size", SIZES)
def test_axe_finds_nothing_serious(live: SimpleNamespace, size: str, *, light: bool) -> None:
    page = live.page
    show(page, live, size, light=light)
    assert serious(page) == []
    for tab in ("Alerts", "Display"):
        page.get_by_role("tab", name=tab).or_(page.locator(f'[title="{tab}"]')).first.click()
        page.wait_for_function(NAMED, timeout=PATIENCE_MS)
        assert serious(page) == [], tab
    page.get_by_role("tab", name="Fleet").or_(page.locator('[title="Fleet"]')).first.click()


def test_axe_would_notice(live: SimpleNamespace) -> None:
    """The check has teeth: a picture without a text and pale letters are found."""
    page = live.page
    show(page, live, "1280x720", light=False)
    page.evaluate("""() => { const bad = document.createElement('div'); bad.id = 'bad';
      bad.style = 'position:fixed;z-index:99999;top:200px;left:400px;pointer-events:auto';
      bad.innerHTML = '<p style="color:#999;background:#fff">pale text</p><img src="data:,">';
      document.getElementById('root').append(bad); }""")
    found = " ".join(serious(page))
    page.evaluate("document.getElementById('bad').remove()")
    assert "color-contrast" in found and "image-alt" in found


@pytest.mark.parametrize("light", [False, True], ids=["dark", "light"])
@pytest.mark.parametrize("size", SIZES)
def test_no_line_of_text_overlaps_another_or_is_cut(live: SimpleNamespace, size: str, *, light: bool) -> None:
    page = live.page
    show(page, live, size, light=light)
    page.wait_for_function(f"({CUT_OR_OVERLAPPING})().length === 0", timeout=PATIENCE_MS)
    assert page.evaluate(f"({TEXTS})().length") > 30


def test_the_measure_of_text_boxes_would_notice(live: SimpleNamespace) -> None:
    page = live.page
    show(page, live, "1280x720", light=False)
    page.evaluate("""() => { const bad = document.createElement('div'); bad.id = 'bad';
      bad.style = 'position:fixed;z-index:99999;top:200px;left:400px;font-size:16px;pointer-events:none';
      bad.innerHTML = '<span style="position:absolute">first</span><span style="position:absolute">second</span>' +
        '<div style="position:absolute;top:40px;width:30px;overflow:hidden;white-space:nowrap">a long line</div>';
      document.body.append(bad); }""")
    found = page.evaluate(CUT_OR_OVERLAPPING)
    page.evaluate("document.getElementById('bad').remove()")
    assert "overlap: first | second" in found and "cut: a long line" in found


# --- keys, camera, units, time ---------------------------------------------------------------------------------------

CAMERA = """() => { const m = window.__viserMutable, g = m.nodeRefFromName['/env'], V = m.camera.position.constructor;
  const at = (x, y, z) => g.worldToLocal(new V(x, y, z).applyMatrix4(m.camera.matrixWorld));
  const a = at(0, 0, 0), b = at(0, 0, -1); return [b.x - a.x, b.y - a.y, b.z - a.z]; }"""  # east, north, up


def turn(page, key: str, condition: str) -> None:
    """Press a key until the direction of view [x, y, z] is so: a selection just before moves the camera as well."""
    for _ in range(5):
        page.keyboard.press(key)
        with contextlib.suppress(TooLate):
            page.wait_for_function(f"() => {{ const [x, y, z] = ({CAMERA})(); return {condition}; }}", timeout=6_000)
            return
    pytest.fail(f"key {key} did not turn the camera")


def test_keys_set_the_camera_and_follow(live: SimpleNamespace) -> None:
    page, view = live.page, view_of(live)
    show(page, live, "1280x720", light=False)
    view = view_of(live)
    page.locator('tr[data-uav="2"]').dispatch_event("pointerdown")
    until(page, lambda: view.selected == 2)
    page.locator("canvas").first.focus()
    turn(page, "t", "z < -0.99")
    page.wait_for_function(
        "document.querySelector('#compass svg').style.transform === 'rotate(0deg)'", timeout=PATIENCE_MS
    )
    turn(page, "v", "z > -0.2 && z < 0")
    psi = view.selected_vehicle().attitude[2]
    turn(page, "c", f"x * {np.sin(psi)} + y * {np.cos(psi)} > 0.5")  # where the aircraft flies to
    until(page, lambda: view.panels.follow.value is True)
    page.keyboard.press("f")
    until(page, lambda: view.panels.follow.value is False)
    page.keyboard.press("l")
    until(page, lambda: view.panels.follow.value is True)
    page.keyboard.press("l")
    until(page, lambda: view.panels.follow.value is False)
    page.keyboard.press("n")  # of those with an alert or a lost link
    until(page, lambda: view.selected in (5, 6))
    assert live.errors == []


def test_search_by_id_focuses_and_letters_in_it_are_no_keys(live: SimpleNamespace) -> None:
    page = live.page
    show(page, live, "1280x720", light=False)
    view = view_of(live)
    page.locator("canvas").first.focus()
    page.keyboard.press("/")
    page.keyboard.type("9tp")
    page.wait_for_function("document.activeElement.value === '9tp'", timeout=PATIENCE_MS)
    assert view.timeline.player.live
    page.keyboard.press("Control+a")
    page.keyboard.type("009")
    before = page.evaluate(CAMERA)
    page.keyboard.press("Enter")
    until(page, lambda: view.selected == 9)
    assert before is not None
    page.keyboard.press("Control+a")
    page.keyboard.press("Delete")
    page.keyboard.press("Escape")
    page.wait_for_function("document.activeElement.tagName !== 'INPUT'", timeout=PATIENCE_MS)


def test_the_timeline_obeys_keys(live: SimpleNamespace) -> None:
    page = live.page
    show(page, live, "1280x720", light=False)
    player = view_of(live).timeline.player
    page.locator("canvas").first.focus()
    page.keyboard.press("p")
    until(page, lambda: not player.live)
    page.locator(".then").wait_for(timeout=PATIENCE_MS)
    t = player.t
    page.keyboard.press(",")
    until(page, lambda: player.t is not None and player.t < t)
    page.keyboard.press(".")
    until(page, lambda: player.t == pytest.approx(t, abs=0.2))
    page.keyboard.press("p")
    until(page, lambda: player.live)


def test_the_list_and_events_obey_keys_and_the_focus_stays_while_they_are_redrawn(live: SimpleNamespace) -> None:
    page = live.page
    show(page, live, "1280x720", light=False)
    view = view_of(live)
    page.locator(".uav.list").focus()
    uavs = page.evaluate("[...document.querySelectorAll('tr.pick')].map(row => +row.dataset.uav)")
    page.locator(f'tr[data-uav="{uavs[0]}"]').dispatch_event("pointerdown")
    until(page, lambda: view.selected == uavs[0])
    page.evaluate(
        "() => { const list = document.querySelector('.uav.list'); window.drawnAnew = () => !list.isConnected; }"
    )
    page.wait_for_function("window.drawnAnew()", timeout=PATIENCE_MS)
    assert page.evaluate("document.activeElement.matches('.uav.list')")
    page.keyboard.press("ArrowDown")
    until(page, lambda: view.selected not in (None, uavs[0]))
    event = page.locator(".uav .event[tabindex]").first
    event.focus()
    page.keyboard.press("Enter")
    until(page, lambda: not view.timeline.player.live)
    page.locator("canvas").first.focus()
    page.locator(".then").wait_for(timeout=PATIENCE_MS)
    page.keyboard.press("p")
    until(page, lambda: view.timeline.player.live)


def test_units_of_aviation_are_shown_and_kept(live: SimpleNamespace) -> None:
    page = live.page
    show(page, live, "1280x720", light=False)
    view = view_of(live)
    view.browser.set_units(aviation=True)
    page.locator(".uav .card b", has_text=" kn").wait_for(timeout=PATIENCE_MS)
    page.locator(".uav td.value", has_text=" ft above mean sea level").wait_for(state="attached", timeout=PATIENCE_MS)
    page.get_by_text("Altitude, ft").wait_for(state="attached", timeout=PATIENCE_MS)
    page.wait_for_function("/ (ft|NM)$/.test(document.querySelector('#compass span').textContent)", timeout=PATIENCE_MS)
    page.wait_for_function(
        "Object.values(localStorage).some(text => /aviation\\W+true/.test(text))", timeout=PATIENCE_MS
    )
    view.browser.set_units(aviation=False)
    page.locator(".uav .card b", has_text=" m/s").wait_for(timeout=PATIENCE_MS)


def test_the_scale_bar_has_the_length_it_states(live: SimpleNamespace) -> None:
    """Seen from above, the bar is as long as the same distance between two points of the ground."""
    page = live.page
    show(page, live, "1280x720", light=False)
    page.locator("canvas").first.focus()
    page.keyboard.press("f")
    turn(page, "t", "z < -0.99")
    page.wait_for_function("document.querySelector('#compass').style.visibility === 'visible'", timeout=PATIENCE_MS)
    measure = """() => {
      const m = window.__viserMutable, g = m.nodeRefFromName['/env'], V = m.camera.position.constructor;
      const w = m.canvas.getBoundingClientRect().width, x = e => g.localToWorld(new V(e, 0, 0)).project(m.camera).x;
      const text = document.querySelector('#compass span').textContent, unit = /km/.test(text) ? 1000 : 1;
      const bar = document.querySelector('#compass i').getBoundingClientRect().width;
      return [bar, (x(parseFloat(text) * unit / 10) - x(0)) / 2 * w]; }"""
    agree = f"() => {{ const [bar, ground] = ({measure})(); return Math.abs(bar - ground) < 0.06 * bar; }}"
    page.wait_for_function(agree, timeout=PATIENCE_MS)  # the bar follows the camera five times a second


def test_local_time_is_shown_beside_utc_where_it_differs(live: SimpleNamespace) -> None:
    context = live.page.context.browser.new_context(timezone_id="Asia/Kolkata", viewport={"width": 1280, "height": 720})
    page = context.new_page()
    page.add_init_script(FEW_FRAMES)
    page.goto(live.page.url)
    page.locator(".uav .local", has_text=" local").wait_for(timeout=PATIENCE_MS)
    utc, local = page.locator(".time b.now").inner_text(), page.locator(".uav .local").inner_text()
    context.close()
    minutes = [int(text[:2]) * 60 + int(text[3:5]) for text in (utc.split()[1], local)]
    assert (minutes[1] - minutes[0] - 330) % 1440 in (0, 1, 1439)
    assert live.page.locator(".uav .local").inner_text() == ""  # this one is in UTC


def test_the_panel_of_the_client_is_never_shown(live: SimpleNamespace) -> None:
    """Before the viewer has sent its page there is a sentence; with it, no way to the client's settings."""
    server = serve("127.0.0.1", port := unused_port())
    page = live.page.context.browser.new_page()
    page.goto(f"http://127.0.0.1:{port}/?fixedDpr=0.5")
    page.wait_for_function("document.querySelector('#root button')", timeout=PATIENCE_MS)  # the client has drawn itself
    shown = page.inner_text("body")
    page.close()
    stop_server(server)
    assert "waiting for the viewer" in shown and "Save Canvas" not in shown and "Scene tree" not in shown
    assert not live.page.locator("#opening").is_visible() and live.page.locator("#root").is_visible()
    icon = live.page.locator(".tabler-icon-adjustments").first
    assert icon.count() and not icon.is_visible()
