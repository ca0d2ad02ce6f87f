"""Build `viewer/scene/map/world.xz`, the coast and borders that the viewer shows without any file of the operator.

    python -m tests.bench.world_map countries-10m.json

The input is `countries-10m.json` of the package world-atlas 2.0.2 (Natural Earth 4.1, 1:10 million), as TopoJSON. Lines
are simplified with the Douglas-Peucker algorithm and rounded; see `viewer/scene/map/world.txt`.
"""

import argparse
import json
import lzma
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from viewer.scene.map.world import FILE, STEPS_PER_DEG

TOLERANCE_DEG = 0.01  # of the simplification, of latitude
EDGE_DEG = 1e-2  # lines so close to 180 degrees or the south pole only close the polygons of the source
JUMP_DEG = 60.0  # a longer step leads across 180 degrees


def simplified(points: np.ndarray, tolerance: float) -> np.ndarray:
    """Drop the points (n, 2) of a line that lie within the tolerance of the line without them."""
    stays = np.zeros(len(points), bool)
    stays[[0, -1]], stack = True, [(0, len(points) - 1)]
    while stack:
        a, b = stack.pop()
        if b - a < 2:
            continue
        way, offsets = points[b] - points[a], points[a + 1 : b] - points[a]
        length2 = float(way @ way)
        share = np.clip(offsets @ way / length2, 0, 1) if length2 else np.zeros(len(offsets))
        distances = np.linalg.norm(offsets - share[:, None] * way, axis=1)
        k = int(distances.argmax())
        if distances[k] > tolerance:
            stays[a + 1 + k] = True
            stack += [(a, a + 1 + k), (a + 1 + k, b)]
    return points[stays]


def arcs_of(nested: Any) -> Iterator[int]:
    """Walk through the nested arc numbers of a geometry."""
    for one in nested:
        if isinstance(one, list):
            yield from arcs_of(one)
        else:
            yield one if one >= 0 else ~one


def parts(points: np.ndarray) -> Iterator[np.ndarray]:
    """Cut a line (n, 2) [deg] where it follows the edge of the source's map."""
    edge = (np.abs(points[:, 0]) > 180 - EDGE_DEG) | (points[:, 1] < -90 + EDGE_DEG)
    jump = np.abs(np.diff(points[:, 0])) > JUMP_DEG
    cuts = np.flatnonzero(edge[1:] & edge[:-1] | jump) + 1
    yield from (part for part in np.split(points, cuts) if len(part) > 1)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path)
    topology = json.loads(parser.parse_args().file.read_text())
    scale, shift = (np.array(topology["transform"][name]) for name in ("scale", "translate"))
    geometries = topology["objects"]["countries"]["geometries"]
    users = Counter(arc for geometry in geometries for arc in arcs_of(geometry.get("arcs", [])))
    lines, is_border = [], []
    for k, arc in enumerate(topology["arcs"]):
        for part in parts(np.cumsum(arc, axis=0) * scale + shift):
            shrink = np.array([max(np.cos(np.radians(part[:, 1].mean())), 0.05), 1.0])
            line = np.rint(simplified(part * shrink, TOLERANCE_DEG) / shrink * STEPS_PER_DEG).astype(np.int32)
            line = line[np.concatenate([[True], (np.diff(line, axis=0) != 0).any(axis=1)])]
            if len(line) > 1:
                lines.append(line)
                is_border.append(users[k] > 1)
    steps = np.concatenate([np.diff(line, axis=0) for line in lines])
    assert np.abs(steps).max() < 2**15
    folded = ((steps << 1) ^ (steps >> 31)).astype("<u2")  # small numbers of either sign have a small high byte
    content = [
        np.array([len(lines)], "<u4").tobytes(),
        np.array([len(line) for line in lines], "<u2").tobytes(),
        np.array(is_border, np.uint8).tobytes(),
        np.array([line[0] for line in lines], "<i4").tobytes(),
        *(np.ascontiguousarray(folded[:, i]).view(np.uint8)[j::2].tobytes() for i in (0, 1) for j in (0, 1)),
    ]
    FILE.write_bytes(lzma.compress(b"".join(content), preset=9 | lzma.PRESET_EXTREME))
    print(f"{FILE.name}: {len(lines)} lines, {sum(map(len, lines))} points, {FILE.stat().st_size / 1e3:.0f} kB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
