"""Pictures of the page for the README: simulated flights, their twins, and a browser.

    PARAUAV_RECORDINGS=recordings python -m tests.bench.pictures             all of them
    python -m tests.bench.pictures --only selected mismatch --out pictures   some of them

The flights are simulated into recordings, which twins process offline. All messages are then published on a bus: fast
until the moment of the picture, and slowly from then on, because a browser without a graphics card draws slowly. One
flight has a faulty airspeed sensor, one is a replayed real flight, and the crowd is a synthetic fleet.
"""

import argparse
import os
import sys
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from fleet.bus.session import connect
from fleet.contract import Alert, AlertKind, Cause, DiagnosisOutcome, Mismatch
from tests.bench.viewing.page import ARGS
from tests.bench.viewing.process import free_port, start, tell

from .messages import (
    ROOT,
    Publisher,
    TimedMessages,
    moment,
    named_s,
    proposed,
    recorded_flight,
    twin_messages,
    with_replay_link,
)
from .page import command, page, shoot, turn_to, viewer

OUT = ROOT / "viewer"
REAL = "real/alfa_20180718_155331_1_engine_failure.tlog"
EIGHT = ("--uavs", "0-7", "--for", "232")
FAULTY = ("--uavs", "0-3", "--for", "260", "--fault", "airspeed_bias,bias_mps=-6,at=120", "--fault-uav", "0")
MEETING, PROPOSED_S = ("--uavs", "0-1", "--for", "125", "--story", "conflict"), 80.0
FAULTY_UAV = 1  # its id
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


def trouble(router: str, stop: threading.Event) -> None:
    """Publish alerts and mismatches of some aircraft repeatedly."""
    with connect(router) as bus:
        while not stop.wait(2.0):
            t = time.time()
            for uav in (23, 61, 118, 164):
                cause = Cause(name="thrust_loss", channel="thrust", segments=((t - 30.0, t),))
                bus.publish(
                    Mismatch(uav=uav, t=t, outcome=DiagnosisOutcome.NAMED, causes=(cause,), sentence="thrust is lost")
                )
            for uav, other in ((7, 90), (45, 131), (150, 199)):
                words = f"uav-{uav}: 40 m from uav-{other} in 18 s"
                bus.publish(Alert(uav=uav, t=t, kind=AlertKind.CONFLICT, other=other, sentence=words))


def many(browser: Any, out: Path) -> None:
    """Show two hundred aircraft, those with alerts first."""
    router, stop = f"tcp/127.0.0.1:{free_port()}", threading.Event()
    with ExitStack() as held:
        feeder = start("tests.bench.viewing.feeder", router, "--uavs", "200", "--hz", "5")
        held.callback(feeder.communicate)
        held.callback(feeder.kill)
        address = held.enter_context(viewer(router))
        tell(feeder)
        threading.Thread(target=trouble, args=(router, stop), daemon=True).start()
        held.callback(stop.set)
        stop.wait(TRAILS_S)
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


SCENES = {"selected": selected, "many": many, "mismatch": mismatch, "proposal": proposal, "replay": replay}


def main() -> int:
    """Take the pictures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--chromium", default=os.environ.get("PARAUAV_CHROMIUM", "/usr/bin/chromium"))
    args = parser.parse_args()
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=args.chromium, headless=True, args=ARGS)
        for name in args.only:
            SCENES[name](browser, args.out)
        browser.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
