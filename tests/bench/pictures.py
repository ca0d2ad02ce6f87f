"""Pictures of the page for the README, from live data: aircraft that fly, twins that judge, a browser that draws.

python -m tests.bench.pictures                          all five, about a quarter of an hour on two cores
python -m tests.bench.pictures --only selected replay   some of them
python -m tests.bench.pictures --only selected --router tcp/127.0.0.1:7447   of a fleet that is up already

Eight aircraft fly a recording, which twins judge that need not hurry; all of it is then said on the bus again, the last
minutes in real time. The flight played again is one recorded of ArduPlane, judged likewise. The mismatch is found live.
The crowd is a synthetic fleet that speaks on the bus.
"""

import argparse
import contextlib
import io
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from PIL import Image

from fleet.bus import connect, open_router
from fleet.codec import Stamp
from fleet.contract import Account, Alert, AlertKind, Cause, Found, Mismatch, Status
from fleet.telemetry.recordings import Recording
from tests.bench.viewing.page import ARGS
from tests.bench.viewing.process import free_port, start, tell
from twin_worker.offline import run

ROOT = Path(__file__).resolve().parents[2]
OUT = ROOT / "viewer"
SIZE = {"width": 1440, "height": 810}
MOST_BYTES = 300_000
FLIGHT = "sitl/s02_nominal_light_wind.tlog.xz"
ROWS = """() => [...document.querySelectorAll('tr.pick')].map(e => ({uav: +e.dataset.uav, said: e.innerText,
  horizon: parseFloat((e.querySelector('td:last-child') || e).innerText) || 0}))"""


@contextlib.contextmanager
def running(*module: str) -> Iterator[subprocess.Popen]:
    """Run a module of this checkout until the end of the block."""
    process = subprocess.Popen([sys.executable, "-m", *module], cwd=ROOT, stdout=subprocess.DEVNULL)
    try:
        yield process
    finally:
        process.terminate()
        process.wait(timeout=30)


@contextlib.contextmanager
def fleet(*options: str) -> Iterator[str]:
    """Fly a fleet; give its router."""
    router = f"tcp/127.0.0.1:{free_port()}"
    with running("fleet.cli", "up", "--no-viewer", "--router", router, *options):
        yield router


def judged(path: Path) -> list[tuple[float, Any, Stamp | None]]:
    """Let twins judge a recording: everything said, theirs included, in the order of its time [s since 1970]."""
    said: list[tuple[float, Any, Stamp | None]] = []
    clock = [0.0]

    def heard() -> Iterator[Any]:
        for now, news in Recording(str(path), 0).steps():
            clock[0] = now
            for message in news:
                said.append((now, message, None))
                yield message

    for result in run(heard(), {}):
        said.append((clock[0], result, Stamp(1, 0xABCD)))  # noqa: PERF401  # `heard` appends in between
    return said


@contextlib.contextmanager
def told(said: list[tuple[float, Any, Stamp | None]], slow_s: float, links: tuple[str, ...] = ()) -> Iterator[str]:
    """Say it all on a bus, twelve times as fast as it was, the last `slow_s` [s] in real time; give its router."""
    router, stop = f"tcp/127.0.0.1:{free_port()}", threading.Event()
    session, end = open_router(router), said[-1][0]

    def speak() -> None:
        with connect(router) as bus:
            stop.wait(12.0)  # until the page is there
            due, before = time.monotonic(), said[0][0]
            for t, message, stamp in said:
                due += (t - before) / (1.0 if t > end - slow_s else 12.0)
                before = t
                if stop.wait(max(due - time.monotonic(), 0.0)):
                    return
                bus.publish(message, stamp)
                if links and isinstance(message, Status):
                    bus.publish(Account(t=t, links=links, uavs=(message.uav,)))
            stop.wait()

    speaker = threading.Thread(target=speak)
    speaker.start()
    try:
        yield router
    finally:
        stop.set()
        speaker.join()
        session.close()


def flown(uavs: int, seconds: int) -> Path:
    """Fly simulated aircraft into a recording, kept for the next time."""
    path = Path(tempfile.gettempdir()) / f"parauav-pictures-{uavs}-{seconds}.tlog"
    if not path.is_file():
        options = ["--uavs", f"0-{uavs - 1}", "--for", str(seconds), "--seed", "1", "--tlog", str(path)]
        subprocess.run([sys.executable, "-m", "fleet.cli", "fly", *options], cwd=ROOT, check=True)
    return path


@contextlib.contextmanager
def crowd(uavs: int) -> Iterator[str]:
    """Let a synthetic fleet speak; give its router."""
    router = f"tcp/127.0.0.1:{free_port()}"
    feeder = start("tests.bench.viewing.feeder", router, "--uavs", str(uavs), "--hz", "5")
    tell(feeder)
    try:
        yield router
    finally:
        feeder.kill()
        feeder.communicate()


def trouble(router: str, stop: threading.Event) -> None:
    """Say of some of the crowd, again and again, that they need an eye."""
    with connect(router) as bus:
        while not stop.wait(2.0):
            t = time.time()
            for uav in (23, 61, 118, 164):
                cause = Cause(name="thrust_loss", channel="thrust", segments=((t - 30.0, t),))
                bus.publish(Mismatch(uav=uav, t=t, outcome=Found.NAMED, causes=(cause,), sentence="thrust is lost"))
            for uav, other in ((7, 90), (45, 131), (150, 199)):
                words = f"uav-{uav}: 40 m from uav-{other} in 18 s"
                bus.publish(Alert(uav=uav, t=t, kind=AlertKind.CONFLICT, other=other, sentence=words))


@contextlib.contextmanager
def page(browser: Any, router: str, *options: str) -> Iterator[Any]:
    """Open a viewer of its own on a router and its page."""
    port = free_port()
    with running("viewer", "--router", router, "--port", str(port), *options):
        one = browser.new_page(viewport=SIZE)
        until = time.monotonic() + 60
        while time.monotonic() < until:
            with contextlib.suppress(Exception):
                one.goto(f"http://127.0.0.1:{port}/", timeout=5_000)
                break
        one.wait_for_function("window.__viserMutable && window.__viserMutable.canvas", timeout=60_000)
        yield one
        one.close()


def rows(one: Any) -> list[dict[str, Any]]:
    """Read the table."""
    return list(one.evaluate(ROWS))


def await_rows(one: Any, told: str, least: int, patience_s: float) -> None:
    """Wait until so many rows say something."""
    script = (
        "([told, n]) => [...document.querySelectorAll('tr.pick')].filter(e => e.innerText.includes(told)).length >= n"
    )
    one.wait_for_function(script, arg=[told, least], timeout=1e3 * patience_s, polling=1_000)


def turn_to(one: Any, uav: int) -> None:
    """Select a UAV with the command palette, which turns the camera to it."""
    one.keyboard.press("Control+k")
    one.get_by_placeholder("Search commands...").fill(f"UAV-{uav:03d}")
    one.locator(".mantine-Spotlight-action[data-selected]", has_text=f"UAV-{uav:03d}").wait_for(timeout=20_000)
    one.keyboard.press("Enter")
    one.locator(".uav .head h1", has_text=f"UAV-{uav:03d}").wait_for(timeout=20_000)


def shoot(one: Any, name: str, frames: int = 25) -> None:
    """Take the picture once it stands still, in as many colours as fit."""
    for button in one.locator(".mantine-Notification-closeButton").all():
        button.click()
    one.evaluate(
        "n => new Promise(done => { const step = () => n-- ? requestAnimationFrame(step) : done(); step(); })", frames
    )
    image = Image.open(io.BytesIO(one.screenshot(timeout=120_000))).convert("RGB")
    for colours in (256, 160, 96, 64):
        packed = io.BytesIO()
        image.quantize(colours, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE).save(
            packed, "PNG", optimize=True
        )
        if len(packed.getvalue()) <= MOST_BYTES:
            break
    (OUT / name).write_bytes(packed.getvalue())
    print(f"{name}: {len(packed.getvalue()) / 1e3:.0f} kB, {colours} colours", flush=True)


def selected(browser: Any, router: str) -> None:
    """Show eight aircraft, one of them selected, dark and light."""
    said = [] if router else judged(flown(8, 330))
    uav = -1
    for name, options in (("screenshot.png", ()), ("light.png", ("--light",))):
        with contextlib.ExitStack() as held:
            where = router or held.enter_context(told(said, 90.0))
            one = held.enter_context(page(browser, where, *options))
            one.wait_for_function("performance.now() > 50000", timeout=90_000)  # they fly in real time by now
            enough = f"({ROWS})().filter(r => r.horizon >= 10).length >= 3"
            one.wait_for_function(enough, timeout=300_000, polling=500)
            uav = uav if uav >= 0 else min(rows(one), key=lambda row: abs(row["horizon"] - 30))["uav"]
            turn_to(one, uav)
            shoot(one, name)


def many(browser: Any, router: str) -> None:
    """Show two hundred by exception."""
    with contextlib.ExitStack() as held:
        where = router or held.enter_context(crowd(200))
        stop = threading.Event()
        threading.Thread(target=trouble, args=(where, stop), daemon=True).start()
        held.callback(stop.set)
        one = held.enter_context(page(browser, where))
        one.get_by_text("200 UAVs").first.wait_for(timeout=60_000)
        one.wait_for_function("performance.now() > 45000", timeout=90_000)  # trails grow
        turn = one.locator("tr.pick").first
        turn.dispatch_event("pointerdown")
        shoot(one, "crowd.png")


def mismatch(browser: Any, router: str) -> None:
    """Show a fault that was concealed, found and named."""
    options = ("--uavs", "2", "--fault", "airspeed_bias,bias_mps=-6,at=120", "--fault-uav", "0")
    with contextlib.ExitStack() as held:
        where = router or held.enter_context(fleet(*options, "--mavlink", f"127.0.0.1:{free_port()}"))
        one = held.enter_context(page(browser, where))
        await_rows(one, "airspeed bias", 1, 900)
        turn_to(one, 0)
        one.locator(".say.mismatch", has_text="named").wait_for(timeout=60_000)
        shoot(one, "mismatch.png")


def replay(browser: Any, router: str) -> None:
    """Show a recorded flight played again: what was predicted then against what happened."""
    flight = Path(os.environ["PARAUAV_RECORDINGS"]) / FLIGHT
    with contextlib.ExitStack() as held:
        where = router or held.enter_context(told(judged(flight), 0.0, (f"replay:{flight.name}",)))
        one = held.enter_context(page(browser, where))
        await_rows(one, "recording ended", 1, 900)
        bar = one.locator(".strip").bounding_box()
        for share in (0.36, 0.35, 0.37, 0.63, 0.62, 0.64, 0.55, 0.7):
            one.mouse.click(bar["x"] + share * bar["width"], bar["y"] + 0.5 * bar["height"])
            one.get_by_text("Not live").wait_for(timeout=20_000)
            one.wait_for_function("() => new Promise(done => setTimeout(() => done(true), 2500))", timeout=10_000)
            if one.locator(".miss").count() >= 3 and 10 <= rows(one)[0]["horizon"] <= 70:
                break
        shoot(one, "replay.png")


SCENES = {"selected": selected, "many": many, "mismatch": mismatch, "replay": replay}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--router", default="", help="of a fleet that is up already; flies one where it is not given")
    parser.add_argument("--chromium", default=os.environ.get("PARAUAV_CHROMIUM", "/usr/bin/chromium"))
    args = parser.parse_args()
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=args.chromium, headless=True, args=ARGS)
        for name in args.only:
            SCENES[name](browser, args.router)
        browser.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
