"""The real browser: what is on the screen, how old it is, how soon a click is answered."""

import tempfile
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from .feeder import PROBE_M_S

ARGS = [
    "--headless=new",
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-background-networking",
    "--disable-component-update",
    "--no-first-run",
]
FEW_FRAMES = """(() => {  // three a second: a renderer in software takes both cores at full rate
  const next = window.requestAnimationFrame.bind(window), cancelled = new Set();
  window.requestAnimationFrame = draw => {
    const id = setTimeout(() => next(now => { if (!cancelled.delete(id)) draw(now); }), 300);
    return id;
  };
  window.cancelAnimationFrame = id => cancelled.add(id);
})()"""
IN_SCENE = "window.__viserMutable && window.__viserMutable.nodeRefFromName['{}']"
NODES = "Object.keys(window.__viserMutable.nodeRefFromName).length"
WATCH = """([name, began, speed]) => {
  const told = window.__told = {ages: [], frames: [], last: null, then: performance.now()};
  const look = () => {
    const now = performance.now(); told.frames.push(now - told.then); told.then = now;
    const root = window.__viserMutable.nodeRefFromName[name]; let batch = null, east = null;
    if (root) root.traverse(o => { if (!batch && o.getPositionAt) batch = o; });
    if (batch) east = batch.getPositionAt(0).x; else if (root) east = root.position.x;
    if (east !== null && east !== told.last) {
      told.last = east; told.ages.push(performance.timeOrigin + now - 1e3 * (began + 10 * east / speed));
    }
    requestAnimationFrame(look);
  };
  requestAnimationFrame(look);
}"""
CLICK = """uav => new Promise((done, fail) => {
  const row = document.querySelector(`tr[data-uav="${uav}"]`), name = 'UAV-' + String(uav).padStart(3, '0');
  const shown = () => [...document.querySelectorAll('.uav .head h1')].some(e => e.textContent === name);
  if (!row) { done(null); return; }
  const began = performance.now();
  row.dispatchEvent(new PointerEvent('pointerdown', {bubbles: true}));
  const look = () => shown() ? done(performance.now() - began)
    : performance.now() - began > 5000 ? done(5000) : setTimeout(look, 2);
  look();
})"""
ECHO = """() => new Promise(done => {
  const echo = () => document.querySelector('.echo'), before = echo().textContent, began = performance.now();
  echo().dispatchEvent(new PointerEvent('pointerdown', {bubbles: true}));
  const look = () => echo().textContent !== before ? done(performance.now() - began)
    : performance.now() - began > 5000 ? done(5000) : setTimeout(look, 2);
  look();
})"""
PLACES = """seconds => new Promise(done => {
  const text = (root, what) => { const e = root && root.querySelector(what); return e ? e.textContent.trim() : ''; };
  const found = [], until = performance.now() + 1e3 * seconds;
  let frame = 0;
  const count = () => { frame++; if (performance.now() < until) requestAnimationFrame(count); };
  requestAnimationFrame(count);
  const page = window.__viserMutable;
  const ring = () => {  // centre of the ring at the horizon, scene [10 m]
    const node = window.__viserMutable.nodeRefFromName['/selected/horizon']; let starts = null;
    if (node) node.traverse(o => { starts = o.geometry?.attributes.instanceStart || starts; });
    if (!starts || !starts.count) return null;
    const n = starts.count, sum = [0, 0, 0];
    for (let i = 0; i < n; i++)
      ['getX', 'getY', 'getZ'].forEach((axis, k) => { sum[k] += starts[axis](i) / n; });
    return sum;
  };
  const look = () => {
    const row = document.querySelector('.uav.list tr.on'), cards = document.querySelectorAll('.uav .cards .card b');
    const sheet = cards.length && cards[0].closest('.uav'), said = sheet && sheet.textContent;
    const name = text(sheet, 'h1');
    if (sheet && (!row || name === row.cells[1].textContent)) {
      const cards_of = [...document.querySelectorAll('.uav .say.pick')];
      const card = cards_of.find(e => text(e, 'b').endsWith(name)), alert = card ? card.lastChild.textContent : '';
      const short = /^confidence horizon (.*);/.exec(alert), silent = /^no sample for ([\\d.]+ \\w+);/.exec(alert);
      const age = / for ([\\d.]+ \\w+):/.exec(said);
      const lost = row && /link lost ([\\d.]+ \\w+)/.exec(row.cells[2].textContent);
      found.push({
        row: row && [row.cells[3].textContent + ' %', row.cells[4].textContent.trim(), lost ? lost[1] : ''],
        tile: [cards[0].textContent, cards[1].textContent, age ? age[1] : ''],
        alert: [short ? short[1] : '', silent ? silent[1] : ''],
        ring: ring(), name, frame,
        label: Object.values(page.tags || {}).filter(  // noted by NOTE_LABELS
          one => one.visible && one.text && (one.text.startsWith(name) || one.text.startsWith('horizon '))
        ).map(one => one.text),
        state: row && [row.cells[2].textContent.replace(/ [\\d.]+ \\w+$/, ''), text(sheet, '.head b').slice(2)],
      });
    }
    performance.now() < until ? setTimeout(look, 50) : done(found);
  };
  look();
})"""
NOTE_LABELS = """(() => {  // text, anchor, position and visibility of each label, as the page takes them at a frame
  const install = () => {
    const page = window.__viserMutable;
    if (!page || !page.messageQueue) { setTimeout(install, 1); return; }
    const tags = page.tags = {}, queue = page.messageQueue, splice = queue.splice;
    queue.splice = function (...range) {
      const messages = splice.apply(queue, range);
      for (const {name, props, updates, position, visible} of messages)
        if (/labels\\/\\d+$/.test(name || ''))
          Object.assign(tags[name] = tags[name] || {}, props, updates, position && {position},
            visible !== undefined && {visible});
      return messages;
    };
  };
  install();
})()"""
LABEL_OVERLAPS = """([seconds, font, em]) => new Promise(done => {  // pairs of labels that overlap on the screen
  const page = window.__viserMutable, env = page.nodeRefFromName['/env'], Vector = page.camera.position.constructor;
  const pen = document.createElement('canvas').getContext('2d'); pen.font = font;
  const until = performance.now() + 1e3 * seconds, found = {looks: 0, most: 0, pairs: []};
  let before = '';
  const box = ({text, anchor, position}) => {
    const at = env.localToWorld(new Vector(...position)).project(page.camera);
    const canvas = page.canvas.getBoundingClientRect(), [vertical, horizontal] = anchor.split('-');
    const width = pen.measureText(text).width + em, height = 1.8 * em;
    const left = (at.x + 1) / 2 * canvas.width - {left: 0, center: 0.5, right: 1}[horizontal] * width;
    const top = (1 - at.y) / 2 * canvas.height - {top: 0, center: 0.5, bottom: 1}[vertical] * height;
    return {text, left, top, right: left + width, bottom: top + height};
  };
  const look = () => {
    const camera = page.camera.matrixWorld.elements.join();
    const boxes = Object.values(page.tags).filter(one => one.visible && one.position && one.text).map(box);
    if (camera === before) {  // labels follow a moved camera one update later
      found.looks += 1;
      found.most = Math.max(found.most, boxes.length);
      boxes.forEach((a, i) => boxes.slice(i + 1).forEach(b => {
        if (a.left < b.right - 1 && b.left < a.right - 1 && a.top < b.bottom - 1 && b.top < a.bottom - 1)
          found.pairs.push(a.text + ' | ' + b.text);
      }));
    }
    before = camera;
    performance.now() < until ? requestAnimationFrame(look) : done(found);
  };
  look();
})"""
ROWS = "[...document.querySelectorAll('tr.pick')].map(e => Number(e.dataset.uav))"


def differing(samples: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the samples of `PLACES` in which row, tiles and alert of the selected aircraft differ.

    The row is absent where another tab than the list is open, and the alert where it is not that of the alerts.
    """
    return [
        one
        for one in samples
        if (one["row"] and (one["row"] != one["tile"] or one["state"][0] != one["state"][1]))
        or any(stated not in ("", shown) for stated, shown in zip(one["alert"], one["tile"][1:], strict=True))
    ]


def labels_differing(samples: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the samples of `drawn` whose labels state another fit, horizon or age than the row."""
    return [one for one in samples if any(not _agrees(text, *one["row"]) for text in one["label"] if one["row"])]


def _agrees(label: str, fit: str, horizon: str, age: str) -> bool:
    if label.startswith("horizon "):
        return label.startswith(f"horizon {horizon}:")
    claim = "no horizon" if horizon == "–" else f"  horizon {horizon}"
    return f"link lost {age}" in label if age else f"  fit {fit}" in label and claim in label


def drawn(samples: list[dict[str, Any]], *, with_ring: bool = True) -> list[dict[str, Any]]:
    """Return the samples of `PLACES` whose row is as old as three frames: by then the scene is drawn as well.

    `with_ring`: only those with a ring at the horizon.
    """
    found, since = [], samples[0] if samples else {}
    for one in samples:
        if (one["name"], one["row"]) != (since["name"], since["row"]):
            since = one
        if one["frame"] >= since["frame"] + 3 and not (with_ring and one["ring"] is None):
            found.append(one)
    return found


class Page:
    """A browser with the page in it."""

    def __init__(self, chromium: str, script: str = "") -> None:
        from playwright.sync_api import sync_playwright

        self._playwright = sync_playwright().start()
        self._folder = tempfile.TemporaryDirectory()
        self._context = self._playwright.chromium.launch_persistent_context(
            self._folder.name,
            executable_path=chromium,
            headless=True,
            args=ARGS,
            viewport={"width": 1280, "height": 720},
        )
        self.page = self._context.pages[0]
        self.page.add_init_script(script)
        self.errors: list[str] = []
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))

    def __enter__(self) -> "Page":
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._context.close()
        self._playwright.stop()
        self._folder.cleanup()

    def open(self, port: int) -> None:
        """Go to the page."""
        self.page.goto(f"http://127.0.0.1:{port}/?fixedDpr=0.5")
        self.page.wait_for_function("window.__viserMutable && window.__viserMutable.canvas", timeout=60_000)

    def await_node(self, name: str, timeout_s: float = 60.0) -> None:
        """Wait until a node is in the scene."""
        self.page.wait_for_function(IN_SCENE.format(name), timeout=1e3 * timeout_s, polling=10)

    def watch(self, name: str, began: float) -> None:
        """Begin to note how old the probe's place is whenever it changes on the screen."""
        self.page.evaluate(WATCH, [name, began, PROBE_M_S])

    def seen(self) -> dict[str, Any]:
        """Give what was noted since `watch`: ages of poses and times between frames [ms]."""
        told = self.page.evaluate(
            "() => { const t = window.__told; const s = {ages: t.ages, frames: t.frames};"
            " t.ages = []; t.frames = []; return s; }"
        )
        ages, frames = np.array(told["ages"] or [np.nan]), np.array(told["frames"] or [np.nan])
        return {
            "poses": len(told["ages"]),
            "pose_to_screen_ms_median": round(float(np.median(ages)), 1),
            "pose_to_screen_ms_p95": round(float(np.quantile(ages, 0.95)), 1),
            "frame_ms_median": round(float(np.median(frames)), 1),
            "nodes": self.page.evaluate(NODES),
            "page_errors": len(self.errors),
        }

    def await_pose(self) -> None:
        """Wait until a new place of the probe is on the screen, as after a restart of the server."""
        self.page.bring_to_front()
        self.page.wait_for_function("window.__told.ages.length > 0", timeout=60_000, polling=10)

    def clicks(self, n: int) -> dict[str, float]:
        """Select by row clicks; give how long until the panel shows the new one, and a press of the echo its answer."""
        took, least = [], []
        for k in range(n):
            rows = self.page.evaluate(ROWS)
            ms = self.page.evaluate(CLICK, rows[(7 * k + 3) % len(rows)]) if rows else None
            took += [ms] if ms is not None and ms > 1.0 else []  # one that was selected already is no answer
            least.append(self.page.evaluate(ECHO))
        found = np.array(took or [np.nan])
        return {
            "n": len(took),
            "ms_median": round(float(np.median(found)), 1),
            "ms_worst": round(float(found.max()), 1),
            "floor_ms_median": round(float(np.median(least)), 1),
        }

    def picture(self, file: Path) -> None:
        """Keep what is on the screen."""
        self.page.screenshot(path=str(file), timeout=120_000)

    def consistency(self, seconds: float) -> dict[str, int]:
        """Compare fit, horizon, state and age in the list with those in the tiles; give samples and differences."""
        samples = self.page.evaluate(PLACES, seconds)
        return {"samples": len(samples), "different": len(differing(samples))}
