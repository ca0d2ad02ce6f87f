"""Labels in the scene: measured where the page draws them, in a crowd with alerts on a laptop."""

from collections.abc import Iterator
from types import SimpleNamespace

import pytest

from tests.bench.viewing.page import LABEL_OVERLAPS
from tests.viewer.test_browser import PATIENCE_MS, SCHEME
from tests.viewer.test_browser_sizes import FONT, Wild, page_of, until, view_of
from viewer.scene.labels import EM_PX

pytestmark = pytest.mark.browser
CROWD = 40


@pytest.fixture(scope="module")
def crowd(chromium: str) -> Iterator[SimpleNamespace]:
    """The page of a crowd, its most severe aircraft selected and all of it framed, at 1280 x 720."""
    with page_of(chromium, lambda bus: Wild(bus, CROWD)) as site:
        site.page.get_by_text(f"{CROWD} UAVs").first.wait_for(timeout=PATIENCE_MS)
        severest = site.page.locator("tr.pick").first.get_attribute("data-uav", timeout=PATIENCE_MS)
        view_of(site).focus_on(int(severest or 0))  # not by a click: one that arrives late would undo `show_all`
        yield site


# light first: a theme change creates the labels again, after the script that records them has started
@pytest.mark.parametrize("light", [True, False], ids=["light", "dark"])
def test_labels_of_a_crowd_do_not_overlap_on_the_screen(crowd: SimpleNamespace, *, light: bool) -> None:
    """Twenty-four seconds, with time marks, horizon, alerts; the page takes positions and texts of one record."""
    page = crowd.page
    view_of(crowd).browser.set_theme(light=light)
    page.wait_for_function(SCHEME, arg="light" if light else "dark", timeout=PATIENCE_MS)
    until(page, lambda: view_of(crowd).palette.dark != light)
    view_of(crowd).show_all()
    until(page, lambda: len(view_of(crowd)._labels.boxes) > 4)
    look = [f"{EM_PX}px {FONT}", EM_PX]
    until(page, lambda: page.evaluate(LABEL_OVERLAPS, [0.3, *look])["most"] > 4)  # a busy page shows them later
    found = page.evaluate(LABEL_OVERLAPS, [12.0, *look])
    assert found["pairs"] == [] and found["looks"] > 10 and found["most"] > 4 and crowd.errors == []
