"""Topics of the cameras of a bag: images, and the camera info that belongs to them."""

import re
from collections import defaultdict
from collections.abc import Mapping, Sequence

from gsmap.utils.errors import InputError

# Message types of images, the preferred one first.
IMAGES = ("sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image")
INFO = "sensor_msgs/msg/CameraInfo"  # message type of the calibration of a camera
# Last parts of a topic of images that do not name a camera.
_GENERIC_ENDINGS = (
    "compressed", "raw", "image", "image_raw", "image_color", "image_mono", "image_rect",
    "image_rect_color", "image_rect_raw",
)  # fmt: skip
# Words in a topic that do not distinguish cameras.
_COMMON_WORDS = {
    "", "camera", "image", "img", "info", "camerainfo", "caminfo", "calibration", "raw", "color",
    "mono", "rect", "compressed",
}  # fmt: skip
_REMEDY = "say it by hand with --topics NAME=IMAGE_TOPIC,INFO_TOPIC for each camera"


def parse_topics(words: Sequence[str]) -> dict[str, tuple[str, str]]:
    """Parse one word ``NAME=IMAGES,INFO`` for each camera. ``,INFO`` may be absent.

    Returns:
        Topic of the images and topic of the camera info of each camera, by its name. The second is
        empty if ``,INFO`` is absent.

    Raises:
        ValueError: If a word has another form, or the name of a camera repeats.
    """
    topics: dict[str, tuple[str, str]] = {}
    for word in words:
        match = re.fullmatch(r"([^=,/]+)=(/[^=,]+)(?:,(/[^=,]+))?", word)
        if match is None or match[1] in topics:
            raise InputError(
                f"--topics takes NAME=/images/topic,/info/topic once for each camera, got {word!r}."
            )
        name, images, info = match.groups()
        topics[name] = (images, info or "")
    return topics


def check_topics(
    kinds: Mapping[str, str],
    topics: Mapping[str, tuple[str, str]],
    listing: str,
    needs_info: bool,
) -> None:
    """Check topics that the user named.

    Args:
        kinds: Message type of each topic of the bag.
        topics: Topic of the images and topic of the camera info of each camera, by its name. The
            second may be empty.
        listing: Topics of the bag as text, for error messages.
        needs_info: Whether each camera must have a topic of camera info.

    Raises:
        ValueError: If a camera lacks camera info, or a topic is missing or of another type.
    """
    lacking = []
    for name, (_, info) in topics.items():
        if needs_info and not info:
            lacking.append(name)
    if lacking:
        raise InputError(
            f"--topics names no camera info of {', '.join(lacking)}: NAME=IMAGE_TOPIC,INFO_TOPIC, "
            "or give --calibration calibration.yaml"
        )
    for images, info in topics.values():
        for topic, valid_kinds in ((images, IMAGES), (info, (INFO,))):
            if topic and kinds.get(topic) not in valid_kinds:
                raise InputError(
                    f"--topics: {topic} is {kinds.get(topic, 'not there')}, and must be "
                    f"{' or '.join(valid_kinds)}; the bag holds: {listing}"
                )


def image_topics(kinds: Mapping[str, str]) -> dict[str, str]:
    """Topic of the images of each camera, by its name; compressed images are preferred to raw ones.

    A camera is named by the last part of its topic that is not generic (such as ``image_raw``), or
    by all parts up to it if names would repeat.

    Args:
        kinds: Message type of each topic of the bag.

    Raises:
        ValueError: If two cameras would get one name.
    """
    topic_of: dict[str, str] = {}  # keys are the topics without generic last parts
    for image_kind in IMAGES:
        for topic in sorted(kinds):
            parts = topic.split("/")
            # Depth images have the message type of compressed images, but show no colours.
            if kinds[topic] != image_kind or parts[-1] == "compressedDepth":
                continue
            # The first part is empty, since a topic starts with "/". One other part is kept.
            while len(parts) > 2 and parts[-1] in _GENERIC_ENDINGS:
                parts.pop()
            topic_of.setdefault("/".join(parts), topic)  # keeps the compressed images, found first
    names = [base.rsplit("/", maxsplit=1)[-1] for base in topic_of]
    if len(set(names)) < len(names):
        names = [base.strip("/").replace("/", "_") for base in topic_of]
    if len(set(names)) < len(names):
        raise InputError(f"some of the cameras {sorted(topic_of)} get one name: {_REMEDY}")
    return dict(zip(names, topic_of.values(), strict=True))


def camera_topics(kinds: Mapping[str, str], listing: str) -> dict[str, tuple[str, str]]:
    """Pair images and camera info, by namespace or by the words in their names.

    Args:
        kinds: Message type of each topic of the bag.
        listing: Topics of the bag as text, for error messages.

    Returns:
        Topic of the images and topic of the camera info of each camera, by its name. Images without
        camera info are left out.

    Raises:
        ValueError: If there is no camera, or the camera info of a camera is ambiguous.
    """
    infos = sorted(topic for topic, kind in kinds.items() if kind == INFO)
    candidates = {}  # topics of camera info that may belong to each topic
    kinds_with_info = {}  # message types of the topics that have candidates
    for topic, kind in kinds.items():
        candidates[topic] = _candidate_infos(topic, infos=infos)
        if candidates[topic]:
            kinds_with_info[topic] = kind
    cameras = image_topics(kinds_with_info)
    if not cameras:
        raise InputError(
            "it has no camera with images (sensor_msgs Image or CompressedImage) and a CameraInfo: "
            f"give --calibration calibration.yaml, or --topics; it holds: {listing or 'no topic'}"
        )
    claims = defaultdict(list)  # cameras by the topic of their camera info
    for name, topic in cameras.items():
        if len(candidates[topic]) > 1:
            raise InputError(
                f"which CameraInfo belongs to {topic}: {' or '.join(candidates[topic])}? {_REMEDY}"
            )
        claims[candidates[topic][0]].append(name)
    topics = {}
    # A camera info belongs to one camera: to the one whose topic has the same words, or else to the
    # only one that it may belong to. Other cameras that could have it are left out.
    for info, names in claims.items():
        info_words = _words(info)
        matching_names = [name for name in names if _words(cameras[name]) == info_words]
        # A camera info in the root namespace could belong to any camera. Without equal words, it is
        # accepted only if no camera has another camera info.
        is_in_root = info.count("/") == 1
        has_other_infos = len(claims) > 1
        if len(matching_names) == 1:
            name = matching_names[0]
        elif len(names) > 1 or (is_in_root and has_other_infos):
            raise InputError(f"does {info} belong to {' or '.join(names)}? {_REMEDY}")
        else:
            name = names[0]
        topics[name] = (cameras[name], info)
    return topics


def _words(topic: str) -> list[str]:
    """Sorted words of a topic that distinguish cameras."""
    all_words = re.split(r"[/_]", topic.lower())
    return sorted(word for word in all_words if word not in _COMMON_WORDS)


def _candidate_infos(topic: str, infos: Sequence[str]) -> list[str]:
    """Topics of camera info that may belong to a topic of images.

    These are the topics of camera info in the nearest namespace above the images. If some of them
    contain the distinguishing words of the images' topic (`_words`), only these are returned.
    """
    nearest = None  # longest namespace of a camera info that contains the images
    for info in infos:
        namespace = info.rsplit("/", maxsplit=1)[0]
        is_above = topic.startswith(f"{namespace}/")
        if is_above and (nearest is None or len(namespace) > len(nearest)):
            nearest = namespace
    neighbours = []
    matching_infos = []
    for info in infos:
        if info.rsplit("/", maxsplit=1)[0] == nearest:
            neighbours.append(info)
            if _words(info) == _words(topic):
                matching_infos.append(info)
    return matching_infos or neighbours
