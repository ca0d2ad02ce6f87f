"""The page for people who need more than a mouse and good eyes: axe-core on every size and theme, text boxes, keys."""

from types import SimpleNamespace

import pytest
from axe_playwright_python.sync_playwright import Axe

from tests.viewer.test_browser import PATIENCE_MS, SCHEME
from tests.viewer.test_browser_sizes import SIZES, live, until, view_of

pytestmark = pytest.mark.browser
__all__ = ["live"]  # the page of a fleet, a fixture
GRAVE = ("serious", "critical")
RULES = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa", "best-practice"]
NAMED = """() => [...document.querySelectorAll('button, input')].every(
  e => e.textContent.trim() || e.getAttribute('aria-label') || !e.getClientRects().length || e.labels.length)"""
TEXTS = """() => {  // every visible line of text with its box; the pointer does not find what is covered or scrolled away
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
    page.wait_for_function(NAMED, timeout=10_000)


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
        page.wait_for_function(NAMED, timeout=10_000)
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
    page.wait_for_function(f"({CUT_OR_OVERLAPPING})().length === 0", timeout=5_000)
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
