"""Width and height of an image file."""

from pathlib import Path

from PIL import Image, UnidentifiedImageError


def image_size(file: Path, where: str) -> tuple[int, int]:
    """Return an image's width and height in pixels; its pixels are not read.

    Messages begin with ``where``: FileNotFoundError without the file, ValueError if it is no image.
    """
    if not file.is_file():
        raise FileNotFoundError(f"{where}: no image at {file}; paths are relative to data_root.")
    try:
        with Image.open(file) as image:
            return image.size
    except UnidentifiedImageError as error:
        raise ValueError(f"{where}: {file} is not an image; fetch it again.") from error
