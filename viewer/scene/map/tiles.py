"""Raster tiles from MBTiles and PMTiles archives; nothing is fetched from a network."""

import gzip
import mmap
import sqlite3
import struct
import zlib
from io import BytesIO
from math import ceil, cos, floor, log2, radians
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from PIL import Image

from fleet.process.file_options import check_file
from fleet.terrain.raster import MERCATOR, Raster, to_mercator

EQUATOR_M = 40_075_017.0  # circumference of the earth [m]
LEVELS = ((15_000.0, 24.0), (4_000.0, 6.0), (1_200.0, 2.0))  # reach around the origin [m], pixel size at most [m]
MAX_SIDE = 14  # tiles along one side of a level
TILE_PX, MAX_TILE_PX = 256, 1_024  # side of a tile: of the mosaic, and accepted [pixels]
MAX_TILE_BYTES = 4_000_000  # of one tile or directory, compressed
MAX_DIRECTORY_BYTES = 16_000_000  # of one directory, decompressed
MAX_DEPTH = 4  # directories from the root to a tile. Source: PMTiles specification 3, section 4
MAX_ZOOM = 24
SQL_STEPS, MAX_SQL_STEPS = 100_000, 500  # instructions between two checks of a query, and checks until it is ended
FORMATS = ("PNG", "JPEG", "WEBP")
EXPECTED = "expected raster tiles (PNG, JPEG or WebP) as MBTiles or PMTiles"
DAMAGE = (
    *(OSError, SyntaxError, ValueError, EOFError, IndexError, OverflowError, struct.error, zlib.error),
    *(Image.DecompressionBombError, Image.DecompressionBombWarning),
)


class Archive(Protocol):
    """Tile archive: zoom levels and tiles."""

    zooms: tuple[int, int]

    def tile(self, zoom: int, x: int, y: int) -> bytes | None:
        """Return the image file of a tile, y counted from the north; None without one."""


class MbTiles:
    """MBTiles archive: an SQLite database. Source: MBTiles specification 1.3."""

    def __init__(self, path: Path) -> None:
        self._steps = 0
        self._base = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True, check_same_thread=False)
        self._base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_TILE_BYTES)
        self._base.set_progress_handler(self._is_endless, SQL_STEPS)
        self._base.execute("PRAGMA trusted_schema = OFF")
        metadata = {str(k): str(v) for k, v in self._query("SELECT name, value FROM metadata LIMIT 1000")}
        if metadata.get("format", "png").lower() not in ("png", "jpg", "jpeg", "webp"):
            raise ValueError(f"tiles of the format {metadata['format'][:20]!r}")
        ((least, most),) = self._query("SELECT min(zoom_level), max(zoom_level) FROM tiles")
        if least is None:
            raise ValueError("no tiles")
        self.zooms = int(least), int(most)

    def _is_endless(self) -> int:
        self._steps += 1
        return int(self._steps > MAX_SQL_STEPS)

    def _query(self, sql: str, *values: int) -> list[Any]:
        self._steps = 0
        return self._base.execute(sql, values).fetchall()

    def tile(self, zoom: int, x: int, y: int) -> bytes | None:
        """Return the image file of a tile, y counted from the north; None without one."""
        row = (1 << zoom) - 1 - y  # MBTiles counts from the south
        sql = "SELECT tile_data FROM tiles WHERE zoom_level = ? AND tile_column = ? AND tile_row = ? LIMIT 1"
        rows = self._query(sql, zoom, x, row)
        return rows[0][0] if rows and isinstance(rows[0][0], bytes) else None


class PmTiles:
    """PMTiles archive of version 3, mapped into memory."""

    def __init__(self, path: Path) -> None:
        from pmtiles import tile as format_  # deferred import: most pages show no tiles

        self._format = format_
        with path.open("rb") as file:
            self._bytes = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        try:
            self._header = format_.deserialize_header(self._bytes[:127])
        except format_.SpecVersionUnsupported:
            raise ValueError(f"PMTiles version {self._bytes[7]} instead of 3") from None
        kind = self._header["tile_type"]
        if kind not in (format_.TileType.PNG, format_.TileType.JPEG, format_.TileType.WEBP):
            raise ValueError(f"tiles of the format {kind.name}")
        if self._header["internal_compression"] is not format_.Compression.GZIP:
            raise ValueError(f"directories compressed with {self._header['internal_compression'].name}, not GZIP")
        self.zooms = self._header["min_zoom"], self._header["max_zoom"]
        self._directories: dict[tuple[int, int], list[Any]] = {}
        self._directory(self._header["root_offset"], self._header["root_length"])

    def _slice(self, offset: int, length: int) -> bytes:
        if length > MAX_TILE_BYTES or offset + length > len(self._bytes):
            raise ValueError(f"{length} bytes at {offset} in a file of {len(self._bytes)} bytes")
        return self._bytes[offset : offset + length]

    def _directory(self, offset: int, length: int) -> list[Any]:
        if (offset, length) not in self._directories:
            data, inflate = self._slice(offset, length), zlib.decompressobj(zlib.MAX_WBITS | 16)
            inflate.decompress(data, MAX_DIRECTORY_BYTES)
            if inflate.unconsumed_tail or inflate.unused_data:
                raise ValueError(f"a directory above {MAX_DIRECTORY_BYTES} bytes")
            self._directories[offset, length] = self._format.deserialize_directory(data)
        return self._directories[offset, length]

    def tile(self, zoom: int, x: int, y: int) -> bytes | None:
        """Return the image file of a tile, y counted from the north; None without one."""
        identifier, header = self._format.zxy_to_tileid(zoom, x, y), self._header
        offset, length = header["root_offset"], header["root_length"]
        for _ in range(MAX_DEPTH):
            entry = self._format.find_tile(self._directory(offset, length), identifier)
            if entry is None:
                return None
            if entry.run_length:
                return self._slice(header["tile_data_offset"] + entry.offset, entry.length)
            offset, length = header["leaf_directory_offset"] + entry.offset, entry.length
        return None


class Mosaic(NamedTuple):
    """Tiles around one place, the coarsest level first."""

    levels: list[Raster]
    tiles: int  # found in the archive
    damaged: int  # of these, not readable

    def sample(self, lat_deg: np.ndarray, lon_deg: np.ndarray) -> np.ndarray:
        """Interpolate colours at positions of any shape: (..., 3), NaN where there is no tile."""
        colours = np.full((*np.shape(lat_deg), 3), np.nan, np.float32)
        for level in self.levels:
            values = level.sample(lat_deg, lon_deg)
            colours = np.where(np.isfinite(values), values, colours)
        return colours


class TileMap:
    """Map of an operator: an archive of raster tiles."""

    def __init__(self, name: str, archive: Archive) -> None:
        self.name, self._archive = name, archive

    def around(self, lat_deg: float, lon_deg: float) -> Mosaic:
        """Compose the tiles around a place, in more detail near it.

        Raises:
            ValueError: when the archive is damaged; the message contains the remedy.
        """
        levels: list[Raster] = []
        tiles = damaged = 0
        zooms: set[int] = set()
        for reach, pixel in LEVELS:
            zoom = self._zoom(lat_deg, pixel)
            if zoom in zooms:
                continue
            zooms.add(zoom)
            try:
                level, n, bad = self._level(lat_deg, lon_deg, reach, zoom)
            except (*DAMAGE, sqlite3.Error) as error:
                raise ValueError(_damage_text(self.name, error)) from None
            tiles, damaged = tiles + n, damaged + bad
            levels += [level] if n > bad else []
        return Mosaic(levels, tiles, damaged)

    def _zoom(self, lat_deg: float, pixel: float) -> int:
        wanted = ceil(log2(EQUATOR_M * max(cos(radians(lat_deg)), 0.05) / (TILE_PX * pixel)))
        return min(max(wanted, self._archive.zooms[0]), self._archive.zooms[1])

    def _level(self, lat_deg: float, lon_deg: float, reach: float, zoom: int) -> tuple[Raster, int, int]:
        """Compose one zoom level: raster, number of tiles and of damaged ones."""
        n = 1 << zoom
        x, y = (float(v) * n for v in to_mercator(np.array(lat_deg), np.array(lon_deg)))
        half = min(reach * n / (EQUATOR_M * max(cos(radians(lat_deg)), 0.05)), MAX_SIDE / 2 - 0.5)
        west, east = floor(x - half), floor(x + half)
        north, south = max(floor(y - half), 0), min(floor(y + half), n - 1)
        rows, columns = south - north + 1, east - west + 1
        canvas = np.full((rows * TILE_PX, columns * TILE_PX, 3), np.nan, np.float32)
        tiles = damaged = 0
        for i in range(rows):
            for j in range(columns):
                data = self._archive.tile(zoom, (west + j) % n, north + i)
                if data is None:
                    continue
                tiles += 1
                try:
                    pixels = _decode(data)
                except DAMAGE:
                    damaged += 1
                    continue
                canvas[i * TILE_PX : (i + 1) * TILE_PX, j * TILE_PX : (j + 1) * TILE_PX] = pixels
        step = 1 / (n * TILE_PX)  # of the unit square
        affine = np.array([[step, 0.0, west / n + step / 2], [0.0, step, north / n + step / 2]])
        return Raster(self.name, canvas, affine, MERCATOR), tiles, damaged


def open_tiles(text: str) -> TileMap:
    """Open a tile archive, MBTiles or PMTiles.

    Args:
        text: path of the file
    Raises:
        ValueError: when it is missing, damaged or has no raster tiles; the message contains the remedy.
        OSError: when it cannot be opened.
    """
    path = Path(text)
    check_file("--map", path, "an MBTiles or PMTiles file")
    with path.open("rb") as file:
        magic = file.read(16)
    kind = MbTiles if magic.startswith(b"SQLite format 3\0") else PmTiles if magic.startswith(b"PMTiles") else None
    if kind is None:
        raise ValueError(f"{path.name}: found no tile archive, {EXPECTED}; convert it (gdal_translate -of MBTiles)")
    try:
        archive: Archive = kind(path)
        if not 0 <= archive.zooms[0] <= archive.zooms[1] <= MAX_ZOOM:
            raise ValueError(f"zoom levels {archive.zooms[0]} to {archive.zooms[1]}")
    except (*DAMAGE, sqlite3.Error) as error:
        raise ValueError(_damage_text(path.name, error)) from None
    return TileMap(path.name, archive)


def _damage_text(name: str, error: Exception) -> str:
    defect = " ".join(str(error).split())[:120] or type(error).__name__
    return f"{name}: found {defect}, {EXPECTED}; download it again or convert it"


def _decode(data: bytes) -> np.ndarray:
    """Decode a tile to (TILE_PX, TILE_PX, 3), NaN where it is transparent.

    Raises:
        ValueError: when it is too large, or any of `DAMAGE` when it is no image.
    """
    if data[:2] == b"\x1f\x8b":
        data = gzip.GzipFile(fileobj=BytesIO(data)).read(MAX_TILE_BYTES)
    with Image.open(BytesIO(data), formats=FORMATS) as image:
        if max(image.size) > MAX_TILE_PX:
            raise ValueError(f"tile of {image.size} pixels")
        whole = image.convert("RGBA").resize((TILE_PX, TILE_PX), Image.Resampling.BILINEAR)
    pixels = np.asarray(whole).astype(np.float32)
    return np.where(pixels[..., 3:] < 128, np.nan, pixels[..., :3])
