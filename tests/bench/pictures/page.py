"""A viewer of its own, the browser on its page, and the picture of it."""

import contextlib
import io
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from playwright.sync_api import TimeoutError

from tests.bench.viewing.process import free_port

from .messages import ROOT

SIZE = (1600, 900)
MOST_BYTES = 300_000
TRIES = 4  # a page that is still being built hears no key
VIVID = 36  # so far lie the parts of a vivid colour apart [of 255]
FRAMES = 20  # drawn before the picture: it stands still


@contextlib.contextmanager
def running(*module: str) -> Iterator[subprocess.Popen[str]]:
    """Run a module of this checkout until the end of the block."""
    command = [sys.executable, "-m", *module]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        process.terminate()
        process.wait(timeout=30)


@contextlib.contextmanager
def viewer(router: str, *options: str) -> Iterator[str]:
    """Run a viewer; give its address once it serves."""
    with running("viewer", "--router", router, "--port", str(free_port()), *options) as process:
        lines = process.stdout or ()
        yield next(found[0] for line in lines if (found := re.search(r"http://\S+", line)))


@contextlib.contextmanager
def page(browser: Any, address: str, size: tuple[int, int] = SIZE) -> Iterator[Any]:
    """Open a page of a size [CSS px]."""
    one = browser.new_page(viewport={"width": size[0], "height": size[1]})
    one.goto(address, timeout=60_000)
    one.add_style_tag(content=".mantine-Notification-root { display: none }")  # that it is drawn in software
    one.wait_for_function("window.__viserMutable && window.__viserMutable.canvas", timeout=60_000)
    yield one
    one.close()


def command(one: Any, words: str) -> None:
    """Do what the command palette offers under these words."""
    search = one.get_by_placeholder("Search commands...")
    for _ in range(TRIES):
        one.keyboard.press("Control+k")
        with contextlib.suppress(TimeoutError):
            search.wait_for(timeout=10_000)
            break
    search.fill(words)
    one.locator(".mantine-Spotlight-action[data-selected]", has_text=words).wait_for(timeout=60_000)
    one.keyboard.press("Enter")
    search.wait_for(state="hidden", timeout=60_000)


def turn_to(one: Any, uav: int) -> None:
    """Select a UAV with the command palette, which turns the camera to it."""
    command(one, f"UAV-{uav:03d}")
    one.locator(".uav .head h1", has_text=f"UAV-{uav:03d}").wait_for(state="attached", timeout=60_000)


def settled(one: Any, frames: int = FRAMES) -> bytes:
    """Return the screen as PNG once it stands still."""
    one.evaluate(
        "n => new Promise(done => { const step = () => n-- ? requestAnimationFrame(step) : done(); step(); })", frames
    )
    return bytes(one.screenshot(timeout=120_000))


def shoot(one: Any, file: Path) -> None:
    """Take the picture and pack it."""
    image = Image.open(io.BytesIO(settled(one))).convert("RGB")
    packed = packed_png(image)
    if len(packed) > MOST_BYTES:
        packed = packed_png(image.resize((1280, 720), Image.Resampling.LANCZOS))
    file.write_bytes(packed)
    print(f"{file.name}: {len(packed) / 1e3:.0f} kB", flush=True)


def packed_png(image: Image.Image) -> bytes:
    """Pack it in 256 colours, many of them for the vivid ones, which are few and mean something."""
    pixels = np.asarray(image).reshape(1, -1, 3)
    vivid = np.ptp(pixels.astype(int), axis=2) > VIVID
    colours: list[int] = []
    for which, n in ((vivid, 152), (~vivid, 104)):
        part = Image.fromarray(pixels[which][None]).quantize(n, method=Image.Quantize.MEDIANCUT)
        colours += (part.getpalette() or [])[: 3 * n]
    palette, packed = Image.new("P", (1, 1)), io.BytesIO()
    palette.putpalette(colours)
    image.quantize(palette=palette, dither=Image.Dither.NONE).save(packed, "PNG", optimize=True)
    return packed.getvalue()
