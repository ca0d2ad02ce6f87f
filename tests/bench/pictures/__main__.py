"""Pictures of the page for the README: simulated flights, their twins, and a browser.

    PARAUAV_RECORDINGS=recordings python -m tests.bench.pictures             all of them
    python -m tests.bench.pictures --only selected mismatch --out pictures   some of them
    python -m tests.bench.pictures --sizes --out sizes                       twelve, to look at: not for the README

The flights are simulated into recordings, which twins process offline. All messages are then published on a bus: fast
until the moment of the picture, and slowly from then on, because a browser without a graphics card draws slowly. One
flight has a faulty airspeed sensor, one is a replayed real flight, and the crowd is a synthetic fleet.
"""

import argparse
import json
import os
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from fleet.bus.session import connect
from fleet.contract import Alert, AlertKind, Cause, DiagnosisOutcome, Mismatch
from fleet.terrain.areas import read_areas
from tests.bench.viewing.page import ARGS
from tests.bench.viewing.process import free_port, start, tell

from .messages import (
    ROOT,
    SETTLED_S,
    Publisher,
    TimedMessages,
    moment,
    named_s,
    position_at,
    proposed,
    recorded_flight,
    twin_messages,
    with_replay_link,
)
from .page import command, page, settled, shoot, turn_to, viewer

OUT = ROOT / "docs" / "images"
REAL = "real/alfa_20180718_155331_1_engine_failure.tlog"
EIGHT = ("--uavs", "0-7", "--for", "232")
FAULTY = ("--uavs", "0-3", "--for", "260", "--fault", "airspeed_bias,bias_mps=-6,at=120", "--fault-uav", "0")
MEETING, PROPOSED_S = ("--uavs", "0-1", "--for", "125", "--story", "conflict"), 80.0
MIXED, AROUND_UAV, AROUND_S = ("--uavs", "0-7", "--for", "232", "--aircraft", "mixed"), 5, 190.0
AREA_M = 120.0  # half side of the no-fly area around the place where that aircraft is then
FAULTY_UAV = 1  # its id
CROWD, ROTOR_SHARE = 60, 0.3  # aircraft of the pictures in three sizes; multirotors among them [-]
SIZES, PHONE_PX = ((390, 844), (1280, 720), (1920, 1080)), 600  # of the window [CSS px]; narrower is a phone
THEMES = {"dark": "", "light": "--light"}  # and the option of the viewer
TRAILS_S = 45.0  # time for the trails of the crowd [s]
SHARE = 0.62  # of the real flight: time of the picture [-]


def take(browser: Any, messages: TimedMessages, when: tuple[int, float], file: Path, *options: str) -> None:
    """Publish the messages and take the picture of a UAV at a moment."""
    uav, t = when
    with (
        Publisher(messages, t) as publisher,
        viewer(publisher.router, *options) as address,
        page(browser, address) as one,
    ):
        publisher.begin()
        publisher.reached.wait()
        turn_to(one, uav)
        shoot(one, file)


def selected(browser: Any, out: Path) -> None:
    """Show eight aircraft, one of them selected, dark and light."""
    messages = twin_messages(recorded_flight("eight", *EIGHT))
    when = moment(messages)
    take(browser, messages, when, out / "screenshot.png")
    take(browser, messages, when, out / "light.png", "--light")


def mismatch(browser: Any, out: Path) -> None:
    """Show a fault that the diagnosis has named."""
    messages = twin_messages(recorded_flight("faulty", *FAULTY), FAULTY_UAV)
    take(browser, messages, moment(messages, named_s(messages), FAULTY_UAV), out / "mismatch.png")


def proposal(browser: Any, out: Path) -> None:
    """Show a predicted conflict and a proposal that can be approved."""
    messages = twin_messages(recorded_flight("conflict", *MEETING), proposes=True)
    take(browser, messages, proposed(messages, PROPOSED_S), out / "proposal.png", "--allow", "approvals")


def mixed(browser: Any, out: Path) -> None:
    """Show wings and multirotors, and a no-fly area on the way of one of them."""
    flight = recorded_flight("mixed", *MIXED)
    lat, lon = (x * 1e-7 for x in position_at(flight, AROUND_UAV, AROUND_S))
    north, east = np.degrees(AREA_M / 6_367_000), np.degrees(AREA_M / 6_367_000) / np.cos(np.radians(lat))
    ring = [[lon + e * east, lat + n * north] for n, e in ((-1, -1), (-1, 1), (1, 1), (1, -1))]
    feature = {
        "type": "Feature",
        "properties": {"name": "village"},
        "geometry": {"type": "Polygon", "coordinates": [ring]},
    }
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "areas.geojson"
        file.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
        messages = twin_messages(flight, proposes=True, areas=read_areas(file))
        when = proposed(messages, SETTLED_S, AROUND_UAV)
        take(browser, messages, when, out / "mixed.png", "--allow", "approvals", "--areas", str(file))


def trouble(router: str, stop: threading.Event, uavs: int) -> None:
    """Publish alerts and mismatches of some aircraft repeatedly."""
    faulty, pairs = ((23, 61, 118, 164), ((7, 90), (45, 131), (150, 199))) if uavs > CROWD else ((23, 31), ((7, 40),))
    with connect(router) as bus:
        while not stop.wait(2.0):
            t = time.time()
            for uav in faulty:
                cause = Cause(name="thrust_loss", channel="thrust", segments=((t - 30.0, t),))
                bus.publish(
                    Mismatch(uav=uav, t=t, outcome=DiagnosisOutcome.NAMED, causes=(cause,), sentence="thrust is lost")
                )
            for uav, other in pairs:
                words = f"uav-{uav}: 40 m from uav-{other} in 18 s"
                bus.publish(Alert(uav=uav, t=t, kind=AlertKind.CONFLICT, other=other, sentence=words))


@contextmanager
def crowd(uavs: int, *themes: str) -> Iterator[list[str]]:
    """Fly a synthetic fleet with alerts; give the address of a viewer for each theme, dark unless `--light`."""
    router, stop = f"tcp/127.0.0.1:{free_port()}", threading.Event()
    with ExitStack() as held:
        command = "--uavs", str(uavs), "--hz", "5", "--multirotors", f"{ROTOR_SHARE}"
        feeder = start("tests.bench.viewing.feeder", router, *command)
        held.callback(feeder.communicate)
        held.callback(feeder.kill)
        addresses = [held.enter_context(viewer(router, *filter(None, [theme]))) for theme in themes]
        tell(feeder)
        threading.Thread(target=trouble, args=(router, stop, uavs), daemon=True).start()
        held.callback(stop.set)
        stop.wait(TRAILS_S)
        yield addresses


def many(browser: Any, out: Path) -> None:
    """Show two hundred aircraft, those with alerts first."""
    with ExitStack() as held:
        (address,) = held.enter_context(crowd(200, ""))
        one = held.enter_context(page(browser, address))
        one.get_by_text("200 UAVs").first.wait_for(timeout=60_000)
        one.locator("tr.pick").first.dispatch_event("pointerdown")
        command(one, "Show the whole fleet")
        shoot(one, out / "crowd.png")


def replay(browser: Any, out: Path) -> None:
    """Show a replayed real flight at a time before its end: the prediction of that time and the path flown since."""
    flight = Path(os.environ["PARAUAV_RECORDINGS"]) / REAL
    messages = with_replay_link(twin_messages(flight), flight.name)
    with (
        Publisher(messages, messages[-1][0]) as publisher,
        viewer(publisher.router) as address,
        page(browser, address) as one,
    ):
        publisher.begin()
        one.get_by_text("recording ended").first.wait_for(timeout=240_000)
        bar = one.locator(".strip").bounding_box()
        one.mouse.click(bar["x"] + SHARE * bar["width"], bar["y"] + 0.5 * bar["height"])
        one.get_by_text("Not live").wait_for(timeout=60_000)
        turn_to(one, messages[0][1].uav)
        shoot(one, out / "replay.png")


def in_sizes(browser: Any, address: str, name: str, out: Path, prepare: Callable[[Any, bool], None]) -> None:
    """Take the pictures of one theme in all sizes, as they are on the screen."""
    for size in SIZES:
        with page(browser, address, size) as one:
            prepare(one, size[0] < PHONE_PX)
            (out / f"{name}-{size[0]}x{size[1]}.png").write_bytes(settled(one))


def sizes_selected(browser: Any, out: Path) -> None:
    """Show one selected aircraft of eight in three sizes, dark and light; on a phone with the sheet of its details."""
    messages = twin_messages(recorded_flight("eight", *EIGHT))
    uav, t = moment(messages)

    def prepare(one: Any, is_phone: bool) -> None:
        turn_to(one, uav)
        if is_phone:
            one.get_by_role("button", name="Expand panel Selected").press("Enter")
            one.locator(".uav .cards").wait_for(state="visible", timeout=60_000)

    with Publisher(messages, t) as publisher, ExitStack() as held:
        addresses = [
            held.enter_context(viewer(publisher.router, *filter(None, [option]))) for option in THEMES.values()
        ]
        publisher.begin()
        publisher.reached.wait()
        for theme, address in zip(THEMES, addresses, strict=True):
            in_sizes(browser, address, f"selected-{theme}", out, prepare)


def sizes_crowd(browser: Any, out: Path) -> None:
    """Show sixty aircraft in three sizes, dark and light, the most severe one selected."""

    def prepare(one: Any, is_phone: bool) -> None:
        one.get_by_text(f"{CROWD} UAVs").first.wait_for(timeout=60_000)
        one.locator("tr.pick").first.dispatch_event("pointerdown")
        command(one, "show the whole fleet")

    with crowd(CROWD, *THEMES.values()) as addresses:
        for theme, address in zip(THEMES, addresses, strict=True):
            in_sizes(browser, address, f"crowd-{theme}", out, prepare)


SIZE_SCENES = {"selected": sizes_selected, "many": sizes_crowd}
SCENES = {
    "selected": selected,
    "many": many,
    "mismatch": mismatch,
    "proposal": proposal,
    "mixed": mixed,
    "replay": replay,
}


def main() -> int:
    """Take the pictures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--sizes", action="store_true", help="selected and many in three sizes, dark and light")
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--chromium", default=os.environ.get("PARAUAV_CHROMIUM", "/usr/bin/chromium"))
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=args.chromium, headless=True, args=ARGS)
        scenes = SIZE_SCENES if args.sizes else SCENES
        for name in [name for name in args.only if name in scenes]:
            scenes[name](browser, args.out)
        browser.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
