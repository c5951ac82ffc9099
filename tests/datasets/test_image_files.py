"""Images of the formats and pixels that cameras leave: read, or named with the cause."""

import struct
import zlib
from io import BytesIO

import cv2
import numpy as np
import pytest
from PIL import Image, PngImagePlugin

from gsmap.datasets.errors import BrokenSampleError
from gsmap.datasets.image_files import (
    decode_image,
    encode_jpeg,
    image_content,
    image_size,
    read_image,
)

COLOURS = np.full((24, 32, 3), (200, 30, 10), np.uint8)
RAMP = np.tile(np.linspace(0, 65535, 256).astype(np.uint16), (2, 1))


def saved(pixels: np.ndarray, kind: str, **options: object) -> bytes:
    """The content of an image file. (H, W) or RGB (H, W, 3)"""
    buffer = BytesIO()
    Image.fromarray(pixels).save(buffer, kind, **options)
    return buffer.getvalue()


def turned(orientation: int) -> Image.Exif:
    exif = Image.Exif()
    exif[0x0112] = orientation
    return exif


def decoded(content: bytes) -> np.ndarray:
    return decode_image(content, "a.png", "camera 'front'")


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP", "BMP"])
def test_formats_that_are_read_give_their_pixels(kind, tmp_path):
    content = saved(COLOURS, kind)
    np.testing.assert_allclose(decoded(content), COLOURS[..., ::-1], atol=3)  # some are lossy
    (tmp_path / "a").write_bytes(content)
    assert image_size(tmp_path / "a", "a") == (32, 24)


@pytest.mark.parametrize("kind", ["GIF", "TIFF", "PPM", "EPS"])
def test_no_other_format_is_opened_under_any_name(kind, tmp_path):
    (tmp_path / "a.png").write_bytes(saved(COLOURS, kind))
    message = r"a\.png is not an image \(JPEG, PNG, WebP or BMP\); .*convert"
    with pytest.raises(BrokenSampleError, match=message):
        decoded((tmp_path / "a.png").read_bytes())
    with pytest.raises(ValueError, match=message):
        image_size(tmp_path / "a.png", "camera 'front'")


def test_sixteen_bits_of_grey_become_eight_from_dark_to_bright():
    image, content = decoded(saved(RAMP, "PNG")), np.frombuffer(saved(RAMP, "PNG"), np.uint8)
    np.testing.assert_array_equal(image, cv2.imdecode(content, cv2.IMREAD_COLOR))
    assert (image[0, 0].tolist(), image[0, -1].tolist()) == ([0, 0, 0], [255, 255, 255])
    assert not decoded(saved(RAMP * 0, "PNG")).any()


@pytest.mark.parametrize("bits", [10, 12, 14])
def test_grey_of_fewer_bits_in_sixteen_is_named_in_place_of_a_black_image(bits):
    largest = (1 << bits) - 1
    message = f"a.png cannot be used: its largest value is {largest} of 65535, .* {bits} bits"
    with pytest.raises(BrokenSampleError, match=message):
        decoded(saved(RAMP >> (16 - bits), "PNG"))


@pytest.mark.parametrize("channels", [3, 4])
def test_sixteen_bits_of_colour_are_read_as_those_of_grey_are(channels):
    colours = np.full((*RAMP.shape, channels), 65535, np.uint16)
    colours[..., :3] = RAMP[:, :, None]
    content = cv2.imencode(".png", colours)[1].tobytes()
    assert decoded(content)[0, -1].tolist() == [255, 255, 255]
    colours[..., :3] >>= 4
    message = r"a\.png cannot be used: its largest value is 4095 of 65535, .* 12 bits"
    with pytest.raises(BrokenSampleError, match=message):
        decoded(cv2.imencode(".png", colours)[1].tobytes())


@pytest.mark.parametrize("kind", ["PNG", "WEBP"])
def test_an_animation_is_no_image_of_a_camera(kind):
    first = Image.fromarray(COLOURS)
    second = Image.fromarray(255 - COLOURS)
    stream = BytesIO()
    first.save(stream, kind, save_all=True, append_images=[second])
    with pytest.raises(BrokenSampleError, match="it is an animation of 2 images"):
        decoded(stream.getvalue())


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP"])
def test_an_orientation_of_xmp_counts_in_every_format(kind):
    description = '<rdf:Description xmlns:tiff="http://ns.adobe.com/tiff/1.0/" '
    xmp = f'<x:xmpmeta xmlns:x="adobe:ns:meta/">{description}tiff:Orientation="6"/></x:xmpmeta>'
    if kind == "PNG":
        notes = PngImagePlugin.PngInfo()
        notes.add_itxt("XML:com.adobe.xmp", xmp)
        content = saved(COLOURS, kind, pnginfo=notes)
    else:
        content = saved(COLOURS, kind, xmp=xmp.encode())
    with pytest.raises(BrokenSampleError, match="wants it turned, orientation 6"):
        decoded(content)


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP"])
def test_an_orientation_of_exif_counts_in_every_format(kind):
    for orientation in range(2, 9):
        message = f"EXIF wants it turned, orientation {orientation}: turn its pixels"
        with pytest.raises(BrokenSampleError, match=message):
            decoded(saved(COLOURS, kind, exif=turned(orientation)))
    for orientation in (0, 1, 9):  # not set, upright, without a meaning
        assert decoded(saved(COLOURS, kind, exif=turned(orientation))).shape == (24, 32, 3)


def test_an_orientation_counts_behind_other_segments_of_a_jpeg():
    content, filler = (
        saved(COLOURS, "JPEG", exif=turned(6)),
        struct.pack(">H", 65535) + bytes(65533),
    )
    with pytest.raises(BrokenSampleError, match="orientation 6"):
        decoded(content[:2] + 3 * (b"\xff\xe2" + filler) + content[2:])


@pytest.mark.parametrize(
    ("content", "remedy"),
    [
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:00\n", "git lfs pull"),
        (b"<!DOCTYPE html><html>not found</html>", "it is a web page: download"),
        (b"", "copy it again"),
    ],
)
def test_what_stands_in_place_of_an_image_is_named(content, remedy):
    with pytest.raises(BrokenSampleError, match=rf"a\.png is not an image .*{remedy}"):
        decoded(content)


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("a.jpg", "the folder exists, but not this file: fetch the file again"),
        ("B.jpg", "but 'b.JPG' is there: rename it"),
        ("link.jpg", "it is a link to 'gone.jpg', which is not there"),
        ("none/a.jpg", "there is no folder .*none: paths are relative to data_root"),
        (".", "a folder or a device is there"),
    ],
)
def test_why_an_image_is_not_there_is_said(name, reason, tmp_path):
    (tmp_path / "b.JPG").write_bytes(saved(COLOURS, "JPEG"))
    (tmp_path / "link.jpg").symlink_to("gone.jpg")
    with pytest.raises(FileNotFoundError, match=f"camera 'a': no image at .*; {reason}"):
        image_size(tmp_path / name, "camera 'a'")
    with pytest.raises(BrokenSampleError, match=f"camera 'a': no image at .*; {reason}"):
        read_image(str(tmp_path / name), "camera 'a'")


def test_content_to_be_copied_is_that_of_an_image(tmp_path):
    for kind in ("JPEG", "PNG", "WEBP"):
        (tmp_path / "a.jpg").write_bytes(saved(COLOURS, kind))
        content, found = image_content(tmp_path / "a.jpg", "a", (32, 24))
        assert (content, found) == (saved(COLOURS, kind), kind.lower())
    (tmp_path / "a.jpg").write_bytes(saved(COLOURS, "BMP"))
    content, found = image_content(tmp_path / "a.jpg", "a", (32, 24))
    assert (content[:2], found) == (b"\xff\xd8", "jpeg")


def png_of_zeros(width: int, height: int) -> bytes:
    """A black PNG of one bit a pixel: a thousandth of its pixels, in bytes."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        check = struct.pack(">I", zlib.crc32(kind + content))
        return struct.pack(">I", len(content)) + kind + content + check

    head = struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0)
    pixels = zlib.compress(bytes(1 + (width + 7) // 8) * height, 9)
    parts = (b"IHDR", head), (b"IDAT", pixels), (b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*part) for part in parts)


def jpeg_of_size(width: int, height: int) -> bytes:
    content = encode_jpeg(np.zeros((8, 8, 3), np.uint8), 50)
    at = content.index(b"\xff\xc0") + 5
    return content[:at] + struct.pack(">HH", height, width) + content[at + 4 :]


@pytest.mark.parametrize(
    ("name", "content"),
    [("a.png", png_of_zeros(10_001, 10_000)), ("a.jpg", jpeg_of_size(20_000, 5_001))],
)
def test_an_image_of_more_than_a_hundred_million_pixels_is_refused(name, content, tmp_path):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=r"cannot be used: it has .* more than 100 million"):
        image_size(tmp_path / name, "here")
    with pytest.raises(BrokenSampleError, match=r"cannot be used: it has .* more than 100 million"):
        decode_image(content, name, "here")
    assert decode_image(png_of_zeros(1000, 100), name, "here").shape == (100, 1000, 3)


def test_a_jpeg_of_many_scans_is_refused():
    buffer = BytesIO()
    Image.fromarray(np.zeros((16, 16, 3), np.uint8)).save(buffer, "JPEG", progressive=True)
    content = buffer.getvalue()
    assert decode_image(content, "a.jpg", "here").shape == (16, 16, 3)
    last = content.rindex(b"\xff\xda")
    bomb = content[:last] + content[last:-2] * 100 + content[-2:]
    with pytest.raises(BrokenSampleError, match=r"it has 1.. scans, more than 100"):
        decode_image(bomb, "a.jpg", "here")
