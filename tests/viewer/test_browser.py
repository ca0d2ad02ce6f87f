"""The page in a real browser: it draws, it selects, it survives hostile words and its own restart."""

import io
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from ctypes.util import find_library
from pathlib import Path

import msgspec
import numpy as np
import pytest
from conftest import ROOT, unused_port

from fleet.bus.session import connect, open_router
from fleet.contract import Array, Rows, Sample
from tests.bench.viewing.page import FEW_FRAMES
from tests.support.cable import Cable
from tests.support.fake_link import untimed
from tests.support.pretend_feed import HOSTILE, PretendFleet

pytestmark = pytest.mark.browser
UAVS, EVIL, LONG, NOWHERE, ABROAD = 20, 3, 17, 18, 19
PLAIN = ["--headless=new", "--no-sandbox", "--disable-background-networking", "--disable-component-update"]
PLAIN += ["--no-first-run"]
SWIFTSHADER = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
MESA = ["--use-gl=angle", "--use-angle=gl-egl", "--ignore-gpu-blocklist"]  # a quarter of the time for a page
ARGS = [*PLAIN, *(MESA if find_library("EGL_mesa") else SWIFTSHADER), "--disable-gpu-compositing"]
IN_SCENE = "window.__viserMutable && window.__viserMutable.nodeRefFromName['/fleet/vehicles']"
NODES = "Object.keys(window.__viserMutable.nodeRefFromName).length"
SHOWN = "name => [...document.querySelectorAll('.uav .head h1')].some(e => e.textContent === name)"
PATIENCE_MS = 60_000  # a busy machine is slow, and nothing here is about speed
SCHEME = "name => document.documentElement.dataset.mantineColorScheme === name"
PROJECT = """n => {
  const m = window.__viserMutable; let batch = null;
  m.nodeRefFromName['/fleet/vehicles'].traverse(o => { if (!batch && o.getPositionAt) batch = o; });
  const V = m.camera.position.constructor, r = m.canvas.getBoundingClientRect(), found = [];
  for (let i = 0; i < n; i++) {
    const p = batch.getPositionAt(i), v = new V(p.x, p.y, p.z);
    batch.localToWorld(v); v.project(m.camera);
    found.push([i, r.x + (v.x + 1) / 2 * r.width, r.y + (1 - v.y) / 2 * r.height]);
  }
  return found;
}"""


BANNER = "state => [...document.querySelectorAll('.stale')].some(e => getComputedStyle(e).visibility === state)"
FRAMES = """ms => new Promise(done => {
  const until = performance.now() + ms, step = now => now < until ? requestAnimationFrame(step) : done();
  requestAnimationFrame(step);
})"""


def odd(fleet: PretendFleet) -> PretendFleet:
    """Make three of them odd: ten thousand letters of status, no sound position, another continent."""

    def misplaced(make, lat: float, lon: float, alt: float):
        def sample(t0: float, t: float) -> Sample:
            good = make(t0, t)
            n = len(good.position.t.numpy())
            x = Array.of(np.tile([lat, lon, alt], (n, 1)), "<f8")
            return msgspec.structs.replace(good, position=Rows(t=good.position.t, x=x))

        return sample

    fleet.uavs[LONG].text = "y" * 10_000
    fleet.uavs[NOWHERE].sample = misplaced(fleet.uavs[NOWHERE].sample, np.nan, np.nan, np.nan)
    fleet.uavs[ABROAD].sample = misplaced(fleet.uavs[ABROAD].sample, -338_600_000, 1_512_000_000, 90_000)
    return fleet


class Viewer:
    """The viewer process under test."""

    def __init__(self, port: int, router: str) -> None:
        self.port, self._router = port, router
        self.start()

    def start(self) -> None:
        command = [sys.executable, "-W", "error", "-m", "viewer", "--port", str(self.port), "--router", self._router]
        env = {**os.environ, "PYTHONPATH": str(ROOT)}
        self.process = subprocess.Popen(command, cwd=ROOT, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
        line = self.process.stdout.readline().decode()
        assert untimed(line) == [f"viewer: http://127.0.0.1:{self.port}\n"], line + self.process.stdout.read().decode()

    def cpu_s(self) -> float:
        """Give the processor time it has used [s]."""
        fields = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def kill(self) -> None:
        self.process.kill()
        self.process.communicate(timeout=60)


@pytest.fixture(scope="module")
def router() -> Iterator[str]:
    """A router with a pretend fleet on it."""
    address, stop = f"tcp/127.0.0.1:{unused_port()}", threading.Event()
    session = open_router(address)
    with connect(address) as bus:
        fleet = odd(PretendFleet(bus, UAVS, hostile=EVIL))

        def publish() -> None:
            while not stop.wait(0.1):
                fleet.advance(time.time())

        feeder = threading.Thread(target=publish)
        feeder.start()
        yield address
        stop.set()
        feeder.join()
    session.close()


@pytest.fixture(scope="module")
def viewer(router: str) -> Iterator[Viewer]:
    one = Viewer(unused_port(), router)
    yield one
    one.kill()


@pytest.fixture(scope="module")
def cable(viewer: Viewer) -> Iterator[Cable]:
    one = Cable(viewer.port)
    yield one
    one.close()


@pytest.fixture(scope="module")
def errors() -> list[str]:
    return []


@pytest.fixture(scope="module")
def page(chromium: str, cable: Cable, errors: list[str], tmp_path_factory: pytest.TempPathFactory) -> Iterator:
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        context = playwright.chromium.launch_persistent_context(
            str(tmp_path_factory.mktemp("profile")),
            executable_path=chromium,
            headless=True,
            args=ARGS,
            viewport={"width": 1280, "height": 720},
        )
        context.add_init_script(FEW_FRAMES)
        one = context.pages[0]
        one.on("pageerror", lambda error: errors.append(f"{error} {error.stack}"))
        one.goto(f"http://127.0.0.1:{cable.port}/?fixedDpr=0.5")
        one.wait_for_function(IN_SCENE, timeout=PATIENCE_MS)
        yield one
        context.close()


def colours(page) -> int:
    from PIL import Image

    clip = {"x": 380, "y": 150, "width": 500, "height": 500}
    pixels = np.asarray(Image.open(io.BytesIO(page.screenshot(clip=clip))).convert("RGB")).reshape(-1, 3)
    return len(np.unique(pixels // 16, axis=0))


def selected(page, name: str, timeout: int = PATIENCE_MS) -> None:
    """Wait until the right panel shows a UAV."""
    page.wait_for_function(SHOWN, arg=name, timeout=timeout)


def test_the_page_draws_the_fleet(page, errors: list[str]) -> None:
    assert page.evaluate("document.createElement('canvas').getContext('webgl2') !== null")
    page.get_by_text(f"{UAVS} UAVs").wait_for(timeout=PATIENCE_MS)
    for _ in range(20):  # the first frames of a software renderer take their time
        if (found := colours(page)) > 6:
            break
    assert found > 6
    assert errors == []


def test_few_nodes_whatever_the_fleet(page) -> None:
    page.wait_for_function(f"{NODES} > 25", timeout=PATIENCE_MS)
    assert page.evaluate(NODES) <= 46


def test_a_click_in_3d_selects_the_same_uav(page) -> None:
    from playwright.sync_api import TimeoutError as TooLate

    selected(page, "UAV-000")  # chosen by itself at the start
    tried = []
    for _ in range(15):  # aircraft fly on while the mouse travels: aim again
        inside = [(i, x, y) for i, x, y in page.evaluate(PROJECT, UAVS) if i and 400 < x < 880 and 60 < y < 660]
        i, x, y = min(inside, key=lambda one: np.hypot(one[1] - 640, one[2] - 360))
        page.mouse.move(x, y)
        page.mouse.click(x, y)
        tried.append((i, x, y))
        try:
            return selected(page, f"UAV-{i:03d}", timeout=1_500)
        except TooLate:
            continue
    pytest.fail(f"no click on a projected aircraft selected it: {tried}")


def test_a_row_click_selects(page) -> None:
    for uav in (7, 12):
        page.locator(f'tr[data-uav="{uav}"]').dispatch_event("pointerdown")
        selected(page, f"UAV-{uav:03d}")


def test_what_happened_is_listed_and_marked_in_one_batch(page, errors: list[str]) -> None:
    page.locator('tr[data-uav="7"]').click()
    selected(page, "UAV-007")
    for kind, words in (("mode", "AUTO"), ("armed", "armed"), ("verified", "model verified"), ("mission", "11 items")):
        page.locator(f'.uav .event[data-kind="{kind}"]', has_text=words).wait_for(timeout=PATIENCE_MS)
    before = page.evaluate(NODES)
    assert page.evaluate("'/selected/events' in window.__viserMutable.nodeRefFromName")
    page.locator('tr[data-uav="1"]').click()  # its model was never verified
    selected(page, "UAV-001")
    page.locator('.uav .event[data-kind="no model"]', has_text="no model yet: insufficient data").wait_for(
        timeout=PATIENCE_MS
    )
    assert page.locator('.uav .event[data-kind="verified"]').count() == 0
    assert page.evaluate(NODES) == before and errors == []


def test_ctrl_k_finds_and_selects(page) -> None:
    page.keyboard.press("Control+k")
    page.get_by_placeholder("Search commands...").fill("UAV-015")
    page.locator(".mantine-Spotlight-action[data-selected]", has_text="UAV-015").wait_for(timeout=PATIENCE_MS)
    page.keyboard.press("Enter")
    selected(page, "UAV-015")


def test_hostile_words_stay_words(page, errors: list[str]) -> None:
    page.locator(f'tr[data-uav="{EVIL}"]').click()
    selected(page, f"UAV-{EVIL:03d}")
    for place in (".uav .say", ".uav .event"):
        page.locator(place, has_text=HOSTILE).first.wait_for(timeout=PATIENCE_MS)
    assert page.locator("img[src='x']").count() == 0
    assert page.evaluate("window.pwned") is None
    assert errors == []


def test_letters_without_end_and_places_that_are_none_break_nothing(page, errors: list[str]) -> None:
    for uav, words in ((LONG, "y" * 400), (ABROAD, "km from the scene origin"), (NOWHERE, "mean fit")):
        page.locator(f'tr[data-uav="{uav}"]').dispatch_event("pointerdown")
        selected(page, f"UAV-{uav:03d}")
        page.locator(".uav .say", has_text=words).first.wait_for(timeout=PATIENCE_MS)
    assert max(page.evaluate("[...document.querySelectorAll('.uav .say')].map(e => e.innerText.length)")) < 700
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth") and errors == []


def test_another_time_is_shown_and_now_again(page, errors: list[str]) -> None:
    page.get_by_role("button", name="Pause").click()
    page.get_by_text("Not live: showing").wait_for(timeout=PATIENCE_MS)
    at = page.locator(".time b.now")
    paused = at.inner_text()
    page.locator(".strip").click(timeout=PATIENCE_MS)  # in its middle, once the panel has grown by a line
    page.wait_for_function("t => document.querySelector('.time b.now').innerText < t", arg=paused, timeout=PATIENCE_MS)
    page.get_by_text("predicted").first.wait_for(timeout=PATIENCE_MS)
    then = at.inner_text()
    page.get_by_role("button", name="1 s ▸").click()
    page.wait_for_function("t => document.querySelector('.time b.now').innerText > t", arg=then, timeout=PATIENCE_MS)
    page.get_by_role("button", name="4×").click()
    page.get_by_text("playing 4×").wait_for(timeout=PATIENCE_MS)
    page.get_by_role("button", name="● Live").click()
    page.wait_for_function("!document.querySelector('.then')", timeout=PATIENCE_MS)
    assert page.evaluate(NODES) <= 48 and errors == []


def test_colours_are_the_page_s_own_and_a_reload_brings_all_back(page, errors: list[str]) -> None:
    page.locator('tr[data-uav="12"]').dispatch_event("pointerdown")
    selected(page, "UAV-012")
    nodes = page.evaluate(NODES)
    for light in (True, False):
        page.get_by_role("tab", name="Display").click()
        page.get_by_label("Light colours").click()
        page.wait_for_function(SCHEME, arg="light" if light else "dark", timeout=PATIENCE_MS)
        page.wait_for_function(f"{NODES} == {nodes}", timeout=PATIENCE_MS)
        selected(page, "UAV-012")
        if light:
            page.reload()
            page.wait_for_function(IN_SCENE, timeout=PATIENCE_MS)
            page.wait_for_function(SCHEME, arg="light", timeout=PATIENCE_MS)
            selected(page, "UAV-012")
            page.get_by_text(f"{UAVS} UAVs").wait_for(timeout=PATIENCE_MS)
    page.get_by_role("tab", name="Fleet").click()
    assert errors == []


def test_what_it_costs(page, viewer: Viewer, cable: Cable, record_property) -> None:
    """Bound the bytes of a tick; processor time is printed only, it depends on the machine."""
    bytes_, cpu_s, began = cable.received, viewer.cpu_s(), time.monotonic()
    page.evaluate(FRAMES, 3_000)
    passed = time.monotonic() - began
    per_tick, share = (cable.received - bytes_) / passed / 10, (viewer.cpu_s() - cpu_s) / passed
    record_property("bytes_per_tick", round(per_tick))
    record_property("server_cpu", round(share, 3))
    print(f"{per_tick / 1e3:.1f} kB a tick, server {share:.1%} of a core")
    assert 0 < per_tick <= 60_000


def test_a_pulled_cable_is_announced_and_the_page_comes_back(page, cable: Cable) -> None:
    cable.pull()
    page.wait_for_function(BANNER, arg="visible", timeout=PATIENCE_MS)
    cable.put_back()
    page.bring_to_front()
    page.wait_for_function(f"!({BANNER})('visible')", timeout=PATIENCE_MS)
    page.get_by_text(f"{UAVS} UAVs").wait_for(timeout=PATIENCE_MS)


def test_a_killed_server_is_announced_and_comes_back(page, viewer: Viewer) -> None:
    viewer.kill()
    page.wait_for_function(BANNER, arg="visible", timeout=PATIENCE_MS)
    viewer.start()
    page.bring_to_front()
    page.wait_for_function(f"!({BANNER})('visible')", timeout=PATIENCE_MS)
    page.get_by_text(f"{UAVS} UAVs").wait_for(timeout=PATIENCE_MS)
    page.locator('tr[data-uav="9"]').dispatch_event("pointerdown")
    selected(page, "UAV-009")


def test_an_empty_page_says_what_it_waits_for(page) -> None:
    """Open another viewer on a router without a fleet, and stop it as an operator would."""
    address = f"tcp/127.0.0.1:{unused_port()}"
    session = open_router(address)
    other = Viewer(unused_port(), address)
    try:
        page.goto(f"http://127.0.0.1:{other.port}/?fixedDpr=0.5")
        page.get_by_text("No aircraft yet").wait_for(timeout=PATIENCE_MS)
        assert "parauav/@fleet/sample/*" in page.inner_text("body")
        aligned = "getComputedStyle(document.querySelector('.uav.empty .value')).textAlign"
        assert page.evaluate(aligned) == "left"  # sentences of several lines
    finally:
        other.process.send_signal(signal.SIGTERM)
        rest, _ = other.process.communicate(timeout=60)
        session.close()
    assert (other.process.returncode, rest) == (0, b"")


def test_without_webgl_the_page_says_so(chromium: str, viewer: Viewer) -> None:
    with tempfile.TemporaryDirectory() as profile:
        command = [chromium, *PLAIN, f"--user-data-dir={profile}", "--disable-3d-apis", "--disable-gpu"]
        command += ["--virtual-time-budget=4000", "--dump-dom", f"http://127.0.0.1:{viewer.port}/"]
        ended = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert "display: flex" in ended.stdout and "it has no WebGL 2" in ended.stdout


def test_a_taken_port_is_a_sentence(router: str, free_port: int) -> None:
    with socket.socket() as held:
        held.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        held.bind(("127.0.0.1", free_port))
        held.listen()
        command = [sys.executable, "-m", "viewer", "--port", str(free_port), "--router", router]
        env = {**os.environ, "PYTHONPATH": str(ROOT)}
        ended = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True, timeout=60, check=False)
    assert ended.returncode == 2 and ended.stdout == ""
    assert untimed(ended.stderr)[0].startswith(f"viewer: --port: found {free_port} in use")
