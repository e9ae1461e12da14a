"""Pictures from files: photographs in eight bits a colour, and class layers as they are stored."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from fusion.errors import SkyfixError

_DEEP = ("I", "F")
"""How the names of Pillow's modes of more than eight bits begin; turned into colours they are cut off at 255."""


def read_photograph(path: Path) -> NDArray[np.uint8]:
    """Colours (rows, cols, 3) of a picture; transparency is left out.

    Raises
    ------
    SkyfixError
        If it cannot be read, is too large, or has more than eight bits a colour.
    """
    return _read(path, is_photograph=True)


def read_indices(path: Path) -> NDArray[Any]:
    """Pixels of a grey or palette image as they are stored; `SkyfixError` when it cannot be read or is too large."""
    return _read(path, is_photograph=False)


def _read(path: Path, *, is_photograph: bool) -> NDArray[Any]:
    try:
        with Image.open(path) as image:
            if is_photograph and image.mode.startswith(_DEEP):
                raise SkyfixError(f"{path}: expected 8 bits a colour, got an image of mode {image.mode}")
            return np.asarray(image.convert("RGB") if is_photograph else image)
    except OSError as error:
        raise SkyfixError(f"{path}: cannot be read: {error.strerror or 'not a readable image'}") from error
    except Image.DecompressionBombError as error:
        raise SkyfixError(f"{path}: {error}") from error
