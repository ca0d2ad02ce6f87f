"""The view of one page as a PNG: what the browser drew, before the sky of the page."""

import io
from typing import Any

import numpy as np
from PIL import Image

from viewer.theme.palette import Palette, rgb

WIDEST = 2_560  # of a picture: a browser gives up on more [pixels]
PATIENCE_S = 20.0  # a browser that draws in software takes its time [s]


def picture(client: Any, palette: Palette) -> bytes:
    """Ask a page for its view.

    Args:
        client: whose page it is
        palette: its colours
    Raises:
        TimeoutError: when the page does not answer; keep it in the foreground.
    """
    camera = client.camera
    width, height = max(camera.image_width, 16), max(camera.image_height, 16)
    share = min(1.0, WIDEST / max(width, height))
    drawn = client.get_render(int(height * share), int(width * share), transport_format="png", timeout=PATIENCE_S)
    return png(drawn, palette)


def png(drawn: np.ndarray, palette: Palette) -> bytes:
    """Lay a drawn view (h, w, 3 or 4) upon the sky and pack it."""
    top, bottom = rgb(palette.sky[0]), rgb(palette.sky[1])
    w = (np.linspace(0, 1, len(drawn)) ** 1.2)[:, None, None]
    sky = np.broadcast_to(top * (1 - w) + bottom * w, (*drawn.shape[:2], 3))
    alpha = drawn[..., 3:4] / 255.0 if drawn.shape[2] == 4 else np.ones((1, 1, 1))
    mixed = np.rint(drawn[..., :3] * alpha + sky * (1 - alpha)).astype(np.uint8)
    out = io.BytesIO()
    Image.fromarray(mixed).save(out, "PNG", optimize=True)
    return out.getvalue()
