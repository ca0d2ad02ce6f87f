"""Pictures of the page for the README, of aircraft that fly, twins that judge, and a browser that draws.

    PARAUAV_RECORDINGS=recordings python -m tests.bench.pictures             all of them
    python -m tests.bench.pictures --only selected mismatch --out pictures   some of them

Eight aircraft fly a recording, which twins judge that need not hurry; all of it is then said on the bus again, in haste
until the moment of the picture and slowly from then on: a browser without a graphics card takes its time. So is the
flight whose airspeed sensor fails. The flight played again is a real one. The crowd is a synthetic fleet that speaks on
the bus.
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

from .page import command, page, shoot, turn_to, viewer
from .said import ROOT, Said, Speaker, flown, judged, moment, named_s, offered, played

OUT = ROOT / "viewer"
REAL = "real/alfa_20180718_155331_1_engine_failure.tlog"
EIGHT = ("--uavs", "0-7", "--for", "232")
FAULTY = ("--uavs", "0-3", "--for", "260", "--fault", "airspeed_bias,bias_mps=-6,at=120", "--fault-uav", "0")
MEETING, OFFERED_S = ("--uavs", "0-1", "--for", "125", "--story", "conflict"), 80.0
FAULTY_UAV = 1  # as MAVLink has it
TRAILS_S = 45.0  # until a crowd has trails [s]
SHARE = 0.62  # of the real flight, where it is looked at


def told(browser: Any, said: Said, when: tuple[int, float], file: Path, *options: str) -> None:
    """Say it all again and take the picture of a UAV at a moment."""
    uav, t = when
    with Speaker(said, t) as speaker, viewer(speaker.router, *options) as address, page(browser, address) as one:
        speaker.begin()
        speaker.there.wait()
        turn_to(one, uav)
        shoot(one, file)


def selected(browser: Any, out: Path) -> None:
    """Show eight aircraft, one of them selected, dark and light."""
    said = judged(flown("eight", *EIGHT))
    when = moment(said)
    told(browser, said, when, out / "screenshot.png")
    told(browser, said, when, out / "light.png", "--light")


def mismatch(browser: Any, out: Path) -> None:
    """Show a fault that was concealed, found and named."""
    said = judged(flown("faulty", *FAULTY), FAULTY_UAV)
    told(browser, said, moment(said, named_s(said), FAULTY_UAV), out / "mismatch.png")


def proposal(browser: Any, out: Path) -> None:
    """Show two aircraft that will meet, and what is proposed against it, ready to be approved."""
    said = judged(flown("conflict", *MEETING), proposes=True)
    told(browser, said, offered(said, OFFERED_S), out / "proposal.png", "--allow", "approvals")


def trouble(router: str, stop: threading.Event) -> None:
    """Say of some of the crowd, again and again, that they need an eye."""
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
    """Show two hundred by exception."""
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
    """Show a real flight played again, at a time before its end: what was claimed then, and what happened."""
    flight = Path(os.environ["PARAUAV_RECORDINGS"]) / REAL
    said = played(judged(flight), flight.name)
    with Speaker(said, said[-1][0]) as speaker, viewer(speaker.router) as address, page(browser, address) as one:
        speaker.begin()
        one.get_by_text("recording ended").first.wait_for(timeout=240_000)
        bar = one.locator(".strip").bounding_box()
        one.mouse.click(bar["x"] + SHARE * bar["width"], bar["y"] + 0.5 * bar["height"])
        one.get_by_text("Not live").wait_for(timeout=60_000)
        turn_to(one, said[0][1].uav)
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
