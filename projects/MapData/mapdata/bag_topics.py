"""Which topics of a bag are its cameras: their images, and the camera info that belongs to them."""

import re
from collections import defaultdict
from collections.abc import Mapping, Sequence

from gsmap.utils.errors import InputError

IMAGES = ("sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image")
INFO = "sensor_msgs/msg/CameraInfo"
_KINDS = (IMAGES, (INFO,))
_GENERIC = ("compressed", "raw", "image", "image_raw", "image_color", "image_mono", "image_rect",
            "image_rect_color", "image_rect_raw")  # fmt: skip
# words in a topic that say nothing about which camera it is
_WORDS = {
    "", "camera", "image", "img", "info", "camerainfo", "caminfo", "calibration", "raw", "color",
    "mono", "rect", "compressed",
}  # fmt: skip
_REMEDY = "say it by hand with --topics NAME=IMAGE_TOPIC,INFO_TOPIC for each camera"


def parse_topics(words: Sequence[str]) -> dict[str, tuple[str, str]]:
    """Read ``NAME=IMAGES,INFO`` of each camera; ``INFO`` may be left out and is empty then.

    Raises:
        ValueError: If a word has another form, or two cameras have one name.
    """
    found = {}
    for word in words:
        match = re.fullmatch(r"([^=,/]+)=(/[^=,]+)(?:,(/[^=,]+))?", word)
        if match is None or match[1] in found:
            raise InputError(
                f"--topics takes NAME=/images/topic,/info/topic once for each camera, got {word!r}."
            )
        found[match[1]] = match[2], match[3] or ""
    return found


def chosen_topics(
    kinds: Mapping[str, str],
    topics: Mapping[str, tuple[str, str]],
    listing: str,
    needs_info: bool,
) -> dict[str, tuple[str, str]]:
    """Return topics that were named by hand; ValueError if the bag has no such images or info.

    Args:
        kinds: Type of the messages of each topic.
        topics: Topic of images and of info, which may be empty, by camera.
        listing: What the bag holds.
        needs_info: Whether each camera must have an info.
    """
    lacking = [name for name, (_, info) in topics.items() if needs_info and not info]
    if lacking:
        raise InputError(
            f"--topics names no camera info of {', '.join(lacking)}: NAME=IMAGE_TOPIC,INFO_TOPIC, "
            "or give --calibration calibration.yaml"
        )
    pairs = ((t, w) for pair in topics.values() for t, w in zip(pair, _KINDS, strict=True))
    for topic, wanted in pairs:
        if topic and kinds.get(topic) not in wanted:
            raise InputError(
                f"--topics: {topic} is {kinds.get(topic, 'not there')}, and must be "
                f"{' or '.join(wanted)}; it holds: {listing}"
            )
    return dict(topics)


def image_topics(kinds: Mapping[str, str]) -> dict[str, str]:
    """Return the topic of images of each camera; of both kinds of images, the compressed.

    A camera is named by the last part of its topic, or by all of it where two have the same.

    Raises:
        ValueError: If two cameras get one name.
    """
    found: dict[str, str] = {}
    for kind in IMAGES:
        for topic in sorted(t for t, k in kinds.items() if k == kind):
            parts = topic.split("/")
            if parts[-1] == "compressedDepth":
                continue
            while len(parts) > 2 and parts[-1] in _GENERIC:
                parts.pop()
            found.setdefault("/".join(parts), topic)
    names = [base.rsplit("/", 1)[-1] for base in found]
    if len(set(names)) < len(names):
        names = [base.strip("/").replace("/", "_") for base in found]
    if len(set(names)) < len(names):
        raise InputError(f"the cameras {sorted(found)} get one name: {_REMEDY}")
    return dict(zip(names, found.values(), strict=True))


def camera_topics(kinds: Mapping[str, str], listing: str) -> dict[str, tuple[str, str]]:
    """Pair images and camera info, by namespace or by the words in their names.

    Args:
        kinds: Type of the messages of each topic.
        listing: What the bag holds.

    Returns:
        Topic of images and of info, by camera; images without any info are left out.

    Raises:
        ValueError: If there is no camera, or it is not clear which info belongs to one.
    """
    infos = sorted(topic for topic, kind in kinds.items() if kind == INFO)
    candidates = {topic: _candidates(topic, infos) for topic in kinds}
    cameras = image_topics({t: kind for t, kind in kinds.items() if candidates[t]})
    if not cameras:
        raise InputError(
            "it has no camera with images (sensor_msgs Image or CompressedImage) and a CameraInfo: "
            f"give --calibration calibration.yaml, or --topics; it holds: {listing or 'no topic'}"
        )
    claims = defaultdict(list)
    for name, topic in cameras.items():
        if len(candidates[topic]) > 1:
            raise InputError(f"which CameraInfo is that of {topic}, {candidates[topic]}? {_REMEDY}")
        claims[candidates[topic][0]].append(name)
    for info, names in claims.items():
        own = [n for n in names if _words(cameras[n]) == _words(info)]
        if len(own) == 1:
            claims[info] = own
        elif len(names) > 1 or (info.count("/") == 1 and len(claims) > 1):
            raise InputError(f"is {info} that of {' or '.join(names)}? {_REMEDY}")
    return {names[0]: (cameras[names[0]], info) for info, names in claims.items()}


def _words(topic: str) -> list[str]:
    """Return the words in a topic that tell its camera."""
    return sorted(word for word in re.split(r"[/_]", topic.lower()) if word not in _WORDS)


def _candidates(topic: str, infos: Sequence[str]) -> list[str]:
    """Return the infos that may belong to images: in the nearest namespace, best of equal words."""
    spaces = {info.rsplit("/", 1)[0] for info in infos}
    nearest = max((s for s in spaces if topic.startswith(f"{s}/")), key=len, default=None)
    found = [info for info in infos if info.rsplit("/", 1)[0] == nearest]
    return [info for info in found if len(found) > 1 and _words(info) == _words(topic)] or found
