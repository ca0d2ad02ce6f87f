"""View of one page as PNG: browser rendering over the sky background."""

import io
from typing import Any

import numpy as np
from PIL import Image

from viewer.theme.palette import Palette, rgb

MAX_SIDE_PX = 2_560  # longest side of an image that browsers render [pixels]
TIMEOUT_S = 20.0  # software rendering is slow [s]


def picture(client: Any, palette: Palette) -> bytes:
    """Request the rendered view of a page.

    Args:
        client: client of the page
        palette: its colours
    Raises:
        TimeoutError: when the page does not answer; keep it in the foreground.
    """
    camera = client.camera
    width, height = max(camera.image_width, 16), max(camera.image_height, 16)
    share = min(1.0, MAX_SIDE_PX / max(width, height))
    rendered = client.get_render(int(height * share), int(width * share), transport_format="png", timeout=TIMEOUT_S)
    return png(rendered, palette)


def png(rendered: np.ndarray, palette: Palette) -> bytes:
    """Blend a rendered view (h, w, 3 or 4) with the sky and encode it as PNG."""
    top, bottom = rgb(palette.sky[0]), rgb(palette.sky[1])
    w = (np.linspace(0, 1, len(rendered)) ** 1.2)[:, None, None]
    sky = np.broadcast_to(top * (1 - w) + bottom * w, (*rendered.shape[:2], 3))
    alpha = rendered[..., 3:4] / 255.0 if rendered.shape[2] == 4 else np.ones((1, 1, 1))
    mixed = np.rint(rendered[..., :3] * alpha + sky * (1 - alpha)).astype(np.uint8)
    out = io.BytesIO()
    Image.fromarray(mixed).save(out, "PNG", optimize=True)
    return out.getvalue()
