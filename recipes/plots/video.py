"""An episode as a moving picture with the prior weight drawn into it."""

from __future__ import annotations

import io
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from torchrl_priors.atomic import write_atomically

__all__ = ["write_weight_video"]

_BAR, _BACK, _DEGRADED = (84, 39, 143), (232, 232, 232), (200, 16, 46)


def write_weight_video(
    path: str | os.PathLike[str],
    frames: Sequence[Any],
    weight: Any,
    degraded: Any = None,
    *,
    rate: float,
    max_rate: float = 25.0,
) -> Path:
    """Write frames as a GIF, each with its weight as a bar below, and framed in red where the advice is degraded.

    Args:
        path (path-like): the file, written whole or not at all.
        frames (sequence of arrays): uint8, ``[H, W, 3]`` each.
        weight: in [0, 1], ``[T]``.
        degraded: bool ``[T]``. None by default.

    Keyword Args:
        rate (float): frames in a second of the episode.
        max_rate (float): frames to show in a second; where there are more, some are left out. Defaults to 25.

    Returns:
        Path: the file.

    Raises:
        ValueError: no frames, or another number of them than of weights.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = write_weight_video(f"{folder}/a.gif", [np.zeros((64, 64, 3), np.uint8)] * 2, [0.1, 0.9], rate=10)
        ...     Image.open(file).n_frames
        2
    """
    weights = np.asarray(weight, np.float64)
    bad = np.zeros(len(weights), bool) if degraded is None else np.asarray(degraded, bool)
    if not len(frames) == len(weights) == len(bad) or not len(frames):
        raise ValueError(f"Expected one weight a frame, got {len(frames)} frames and {len(weights)} weights.")
    every = max(1, round(rate / max_rate))
    shown = range(0, len(frames), every)
    pictures = [_draw(np.asarray(frames[t], np.uint8), float(weights[t]), bool(bad[t])) for t in shown]
    buffer = io.BytesIO()
    pictures[0].save(
        buffer,
        format="GIF",
        save_all=True,
        append_images=pictures[1:],
        duration=round(1000 * every / rate),
        loop=0,
    )
    file = Path(path)
    file.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(file, buffer.getvalue())
    return file


def _draw(frame: np.ndarray, weight: float, degraded: bool) -> Image.Image:
    height, width = frame.shape[:2]
    strip = max(18, height // 14)
    picture = Image.new("RGB", (width, height + strip), "white")
    picture.paste(Image.fromarray(frame), (0, 0))
    draw = ImageDraw.Draw(picture)
    label = strip * 3
    top, bottom = height + strip // 4, height + strip - strip // 4
    # Pillow's own font has no omega
    font = ImageFont.truetype(f"{mpl.get_data_path()}/fonts/ttf/DejaVuSans.ttf", size=strip * 0.58)
    text = f"\N{GREEK SMALL LETTER OMEGA} {weight:.2f}"
    draw.text((strip // 3, height + strip // 2), text, fill="black", font=font, anchor="lm")
    right = width - strip // 3
    draw.rectangle((label, top, right, bottom), fill=_BACK)
    draw.rectangle((label, top, label + (right - label) * weight, bottom), fill=_BAR)
    if degraded:
        draw.rectangle((0, 0, width - 1, height - 1), outline=_DEGRADED, width=max(3, height // 80))
    return picture
