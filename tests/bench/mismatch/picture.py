"""Fly a fleet with a fault in one aircraft, wait until its twin has named it, and take the viewer's picture.

python -m tests.bench.mismatch.picture viewer/mismatch.png
"""

import argparse
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

from fleet.access.knock import reachable
from fleet.bus import connect
from fleet.contract import Found, Mismatch, Sample

from .world import FAULT, model

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
ARGS = ("--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
PATIENCE_S = 420.0
SETTLE_MS = 12_000  # until the scene stands
SIZE = {"width": 1600, "height": 900}


def unused_port() -> int:
    """Give a loopback port that nobody holds."""
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return int(s.getsockname()[1])


def main() -> int:
    """Take the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--uavs", type=int, default=4)
    parser.add_argument("--fault", default=FAULT)
    parser.add_argument("--models", type=Path, help="folder of models already calibrated (made anew)")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        base = model(args.seed, args.models or Path(folder))
        router, page = f"tcp/127.0.0.1:{unused_port()}", unused_port()
        command = [sys.executable, "-m", "fleet.cli", "up", "--uavs", str(args.uavs), "--seed", str(args.seed)]
        command += ["--baseline", f"0={base}", "--fault", f"{args.fault},at=120", "--fault-uav", "0"]
        command += ["--router", router, "--port", str(page), "--mavlink", f"127.0.0.1:{unused_port()}"]
        fleet = subprocess.Popen(command)
        try:
            return _wait(router, page, args.out)
        finally:
            fleet.terminate()
            fleet.wait(30)


def _wait(router: str, page: int, out: Path) -> int:
    begun = time.monotonic()
    first: list[float] = []
    while not reachable(router):
        pass
    with connect(router) as bus:
        bus.subscribe(Sample, lambda m, _: first.append(m.t) if m.uav == 0 and not first else None)
        while time.monotonic() - begun < PATIENCE_S:
            threading.Event().wait(1.0)
            for found, _ in bus.ask(Mismatch, 0):
                if found.outcome is Found.NAMED and found.t - (found.onset or found.t) > 20.0:
                    print(f"{found.t - first[0]:.0f} s after the first sample: {found.sentence}", flush=True)
                    return _shoot(page, out)
    print("picture: nothing was named in time", file=sys.stderr)
    return 1


def _shoot(port: int, out: Path) -> int:
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        chromium = next(filter(None, map(shutil.which, BROWSERS)))
        browser = playwright.chromium.launch(executable_path=chromium, args=list(ARGS))
        page = browser.new_page(viewport=SIZE)
        page.goto(f"http://127.0.0.1:{port}/?fixedDpr=1")
        page.add_style_tag(content=".mantine-Notification-root { display: none }")  # that it is drawn in software
        page.wait_for_selector(".say.mismatch", timeout=60_000)
        page.locator('[data-uav="0"]').first.dispatch_event("pointerdown")
        page.wait_for_function("document.querySelectorAll('.say.mismatch').length > 0")
        page.wait_for_function("t => performance.now() > t", arg=page.evaluate("performance.now()") + SETTLE_MS)
        page.screenshot(path=str(out))
        browser.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
