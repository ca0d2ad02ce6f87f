"""Coast and borders of the world, bundled: lines on the ground, and an overview of the region as SVG."""

import lzma
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from viewer.store.place import REACH_M, SceneFrame
from viewer.theme.palette import Palette

FILE = Path(__file__).with_name("world.xz")  # see world.txt
STEPS_PER_DEG = 400  # resolution of the file [1/deg]
DEGREE_M = 111_195.0  # one degree of latitude [m]
DRAWN_M = 95_000.0  # lines on the ground up to this distance; the scene frame ends at `REACH_M` [m]
OVERVIEW_M = 400_000.0  # half height of the overview [m]
OVERVIEW_PX = (300, 200)


class World(NamedTuple):
    """Line segments of the world, coast and borders."""

    segments: np.ndarray  # (n, 2, 2) longitude, latitude [deg]
    is_border: np.ndarray  # (n,) border between countries, else coast


@cache
def world() -> World:
    """Read the bundled lines; the format is that of `tests.bench.world_map`."""
    content = lzma.decompress(FILE.read_bytes())
    n = int(np.frombuffer(content, "<u4", 1)[0])
    lengths = np.frombuffer(content, "<u2", n, 4).astype(int)
    borders = np.frombuffer(content, np.uint8, n, 4 + 2 * n).astype(bool)
    first = np.frombuffer(content, "<i4", 2 * n, 4 + 3 * n).reshape(n, 2)
    steps_n = int(lengths.sum()) - n
    low_high = np.frombuffer(content, np.uint8, 4 * steps_n, 4 + 11 * n).reshape(2, 2, steps_n).astype(int)
    folded = low_high[:, 0] + 256 * low_high[:, 1]
    steps = ((folded >> 1) ^ -(folded & 1)).T  # (steps_n, 2)
    segment_line = np.repeat(np.arange(n), lengths - 1)
    starts = np.concatenate([[0], np.cumsum(lengths - 1)[:-1]])
    travelled = np.cumsum(steps, axis=0)
    before = np.where(starts[:, None] > 0, travelled[starts - 1], 0)
    ends = first[segment_line] + travelled - before[segment_line]
    return World(np.stack([ends - steps, ends], axis=1) / STEPS_PER_DEG, borders[segment_line])


def _near(lat_deg: float, lon_deg: float, reach_m: np.ndarray) -> World:
    """Clip the world to a box of half sizes east and north, (2,) [m]; longitudes are continuous around its centre."""
    segments, is_border = world()
    reach = reach_m / DEGREE_M / [max(np.cos(np.radians(lat_deg)), 0.02), 1.0]
    start = segments[:, 0] - [lon_deg, lat_deg]
    start[:, 0] = (start[:, 0] + 180) % 360 - 180
    step = segments[:, 1] - segments[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):  # where a segment is parallel to an edge
        crossings = np.stack([(-reach - start) / step, (reach - start) / step])
    crossings = np.where(step == 0, np.where(np.abs(start) < reach, [[[-np.inf]], [[np.inf]]], np.nan), crossings)
    first = crossings.min(axis=0).max(axis=1).clip(0, None)
    last = crossings.max(axis=0).min(axis=1).clip(None, 1)
    inside = first < last  # false with NaN
    shares = np.stack([first[inside], last[inside]], axis=1)[..., None]
    centre = np.array([lon_deg, lat_deg])
    return World(centre + start[inside, None] + shares * step[inside, None], is_border[inside])


def ground_lines(scene_frame: SceneFrame) -> tuple[np.ndarray, np.ndarray]:
    """Return coast and borders around the scene origin: two of segments at height 0, (n, 2, 3) ENU [10 m]."""
    lat, lon = scene_frame.origin.lat_e7 * 1e-7, scene_frame.origin.lon_e7 * 1e-7
    assert DRAWN_M < REACH_M
    near = _near(lat, lon, np.array([DRAWN_M, DRAWN_M]))
    points = near.segments.reshape(-1, 2) * 1e7
    alt_mm = np.full(len(points), float(scene_frame.origin.alt_mm))
    scene = scene_frame.from_geodetic(points[:, 1], points[:, 0], alt_mm) * [1.0, 1.0, 0.0]
    lines = scene.reshape(-1, 2, 3)
    return lines[~near.is_border], lines[near.is_border]


def overview_html(scene_frame: SceneFrame, palette: Palette) -> str:
    """Return a map of the region as SVG: coast, borders, the position of the fleet, north up."""
    lat, lon = scene_frame.origin.lat_e7 * 1e-7, scene_frame.origin.lon_e7 * 1e-7
    width, height = OVERVIEW_PX
    reach = OVERVIEW_M * np.array([width / height, 1.0])
    near = _near(lat, lon, reach)
    shrink = max(np.cos(np.radians(lat)), 0.02)
    x = width / 2 + (near.segments[..., 0] - lon) * DEGREE_M * shrink / reach[0] * width / 2
    y = height / 2 - (near.segments[..., 1] - lat) * DEGREE_M / reach[1] * height / 2
    paths = "".join(
        f'<path d="{_path(x[chosen], y[chosen])}" fill="none" stroke="{colour}" stroke-width="1"{dashes}/>'
        for chosen, colour, dashes in (
            (~near.is_border, palette.coast, ""),
            (near.is_border, palette.border, ' stroke-dasharray="3 2"'),
        )
    )
    bar = 100_000.0 / reach[0] * width / 2
    position = f"{abs(lat):.2f}° {'N' if lat >= 0 else 'S'}, {abs(lon):.2f}° {'E' if lon >= 0 else 'W'}"
    empty = "" if len(x) else " No coast or border within this range."
    return (
        f'<div class="uav overview"><b>Region</b> <span class="soft">{position}</span>'
        f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="Coast and borders around {position}.{empty}">'
        f'{paths}<circle cx="{width / 2}" cy="{height / 2}" r="4" fill="none" stroke="{palette.horizon}" '
        f'stroke-width="2"/><path d="M8 {height - 8}h{bar:.1f}" stroke="{palette.ink}" stroke-width="2"/>'
        f'<text x="{12 + bar:.1f}" y="{height - 4}" font-size="11" fill="{palette.muted}">100 km</text></svg>'
        f'<span class="soft">Natural Earth, 1:10 million, simplified to 1 km.{empty} Not for navigation.</span></div>'
    )


def _path(x: np.ndarray, y: np.ndarray) -> str:
    """Return SVG path data of segments (n, 2); connected ones are joined."""
    text, last = [], None
    for (x0, x1), (y0, y1) in zip(x.tolist(), y.tolist(), strict=True):
        if last is None or abs(last[0] - x0) + abs(last[1] - y0) > 1e-6:
            text.append(f"M{x0:.1f} {y0:.1f}")
        text.append(f"L{x1:.1f} {y1:.1f}")
        last = x1, y1
    return "".join(text)
