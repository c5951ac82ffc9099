"""Published weights of backbones: download, verification, and conversion to mmdet's keys.

A config refers to such weights by their address. The file is searched for by its published name in
the folder of the environment variable ``GSMAP_WEIGHTS``, then in the cache of earlier downloads. If
it is in neither, it is downloaded.
"""

import hashlib
import http.client
import json
import logging
import os
import re
import threading
import time
import urllib.request
from collections.abc import Iterator, Mapping
from http.client import HTTPResponse
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any
from urllib.parse import unquote, urlsplit

import mmengine
import torch
from mmengine.logging import print_log
from torch import Tensor

from gsmap.checkpoints.efficientnet_keys import efficientnet_rules, unused_classifier
from gsmap.checkpoints.key_rules import KeyMap
from gsmap.checkpoints.reading import load_tensors, refusing
from gsmap.utils.errors import InputError
from gsmap.utils.files import atomic_write, file_name
from gsmap.utils.shards import digest

WEIGHTS = "GSMAP_WEIGHTS"  # environment variable with a folder of weights
SILENCE_S = 30.0  # longest time without a byte from the server
HEADER_S = 60.0  # longest time until the header is complete
LIMIT_S = 3600.0  # longest time of a download
_BLOCK_BYTES = 1 << 20
# First digits of the sha256 at the end of a file name, as torch and OpenMMLab publish files.
_DIGEST = re.compile(r"-([0-9a-f]{8,64})(\.\w+)?\Z")
# `to_ours` of the map returns the key of mmdet's backbone, or None for weights of the classifier.
_EFFICIENTNET = KeyMap(
    name="efficientnet",
    rules=efficientnet_rules(theirs="", ours=""),
    unused=unused_classifier(theirs=""),
)
# A key with the prefix identifies a format. The first group of the pattern is the key of mmdet.
_DETECTRON_PREFIX = "backbone.bottom_up."
_DETECTRON = re.compile(re.escape(_DETECTRON_PREFIX) + "(.+)")
_SWIN_PREFIX = "backbone.layers.0.blocks.0.attn."
_SWIN = re.compile(r"backbone\.((layers|patch_embed|norm\d)\..+)")


def load_published(
    address: str, model_dir: object = None, map_location: Any = "cpu", progress: bool = False
) -> Any:
    """Load weights by their address; a replacement for mmengine's ``load_url``.

    The parameters are the parameters of ``load_url``.

    Args:
        address: Address of the published file.
        model_dir: Ignored; `find_weights` determines the folder.
        map_location: Device, as ``torch.load`` takes it.
        progress: Ignored.

    Returns:
        The checkpoint, with the keys of mmdet's backbones (`in_our_names`).

    Raises:
        OSError: If the file is not available and cannot be downloaded.
        ValueError: If the file cannot be read. A downloaded file is removed in this case.
    """
    path = find_weights(address)
    try:
        with refusing(address):  # raises ValueError for a damaged file, with a remedy
            checkpoint = load_tensors(path, map_location=map_location)
    except ValueError as error:
        if path != cache_file(address):  # a file of the user is never removed
            raise InputError(f"{error} The file is {path}.") from error
        path.unlink(missing_ok=True)
        raise InputError(f"{error} The fetched file, {path}, was removed.") from error
    return in_our_names(checkpoint)


def load_from_file(path: str, map_location: Any = "cpu") -> Any:
    """Load weights from a file, with the keys of mmdet's backbones; a loader for mmengine.

    Args:
        path: Path of the file; ``~`` is expanded.
        map_location: Device, as ``torch.load`` takes it.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file cannot be read.
    """
    file = Path(path).expanduser()
    if not file.is_file():
        raise FileNotFoundError(f"there are no weights at {file}: check the path.")
    with refusing(file):
        return in_our_names(load_tensors(file, map_location=map_location))


def load_from_torchvision(name: str, map_location: Any = "cpu") -> Any:
    """Load the weights of ``torchvision://NAME`` without torchvision; a loader for mmengine.

    Args:
        name: Name of the weights with its scheme, ``torchvision://NAME`` or ``modelzoo://NAME``.
        map_location: Device, as ``torch.load`` takes it.

    Raises:
        OSError: If the file is not available and cannot be downloaded.
        ValueError: If torchvision has no weights of this name, or the file cannot be read.
    """
    # mmengine comes with a table of the addresses of torchvision's weights, by their names.
    table = Path(mmengine.__file__).parent / "hub/torchvision_0.12.json"
    addresses = json.loads(table.read_text())
    address = addresses.get(name.partition("://")[2])
    if address is None:
        raise InputError(f"{name} is not known: give the address of the weights, or a path.")
    return load_published(address, map_location=map_location)


def find_weights(address: str) -> Path:
    """Find the file of published weights, and download it if it is not available.

    A published file name may end in the first digits of the file's sha256. If a file in the cache
    does not have these digits, it is downloaded again. If a file in the folder of ``GSMAP_WEIGHTS``
    does not have them, it is used with a warning.

    Args:
        address: Address of the published file.

    Raises:
        OSError: If the file is not available and cannot be downloaded, or if ``GSMAP_WEIGHTS`` does
            not name a folder.
    """
    name = _published_name(address)
    folder = os.environ.get(WEIGHTS)
    if folder and not Path(folder).is_dir():
        raise FileNotFoundError(
            f"{WEIGHTS} names {folder}, which is no folder: put {name} into one."
        )
    if folder:
        user_file = Path(folder, name)
        if user_file.is_file():
            if not _has_published_digest(user_file, name=name):
                print_log(
                    f"{user_file} is used, but is not the published file: its sha256 is "
                    f"{digest(user_file)}.",
                    level=logging.WARNING,
                )
            return user_file
    cached = cache_file(address)
    if cached.is_file() and not _has_published_digest(cached, name=name):
        print_log(f"{cached} is broken and is fetched again.", level=logging.WARNING)
        cached.unlink()
    if not cached.is_file():
        _download(address, path=cached)
    print_log(f"weights of {address} are in {cached}.")
    return cached


def cache_file(address: str) -> Path:
    """Path of a downloaded file.

    The file name contains a digest of the address, so that each address has a different file.
    """
    name = _published_name(address)
    stem, dot, suffix = name.rpartition(".")
    mark = hashlib.sha256(address.encode()).hexdigest()[:16]
    marked_name = f"{stem}={mark}.{suffix}" if dot else f"{name}={mark}"
    return Path(torch.hub.get_dir(), "checkpoints", file_name(marked_name))


def _published_name(address: str) -> str:
    """File name in an address."""
    path = Path(urlsplit(address).path)
    return file_name(unquote(path.name) or "weights.pth")


def _has_published_digest(path: Path, name: str) -> bool:
    """Whether a file has the digest in its published name; True if the name has none."""
    published_digest = _DIGEST.search(name)
    return published_digest is None or digest(path).startswith(published_digest[1])


def _download(address: str, path: Path) -> None:
    """Download a file and check its digest, or raise an error with a remedy."""
    print_log(f"fetching {address} to {path} ...")
    sha256 = hashlib.sha256()
    with atomic_write(path, "wb") as file:
        for block in _read_blocks(address):
            sha256.update(block)
            file.write(block)
        published_digest = _DIGEST.search(_published_name(address))
        if published_digest and not sha256.hexdigest().startswith(published_digest[1]):
            # The exception leaves the block of `atomic_write`, so no file is created.
            reason = f"it came with sha256 {sha256.hexdigest()[:16]}..."
            raise _download_error(address, reason=reason)


def _read_blocks(address: str) -> Iterator[bytes]:
    """Download a file in blocks, for at most `LIMIT_S`.

    Raises:
        OSError: If the download fails, is too slow or is incomplete.
    """
    end_s = time.monotonic() + LIMIT_S
    try:
        with _open_address(address) as response:
            length = response.headers.get("Content-Length")
            received = 0
            # `read1` returns as soon as some bytes arrive, so that the time is checked often.
            while block := response.read1(_BLOCK_BYTES):
                received += len(block)
                if time.monotonic() > end_s:
                    raise TimeoutError(f"not whole after {LIMIT_S:.0f} s")
                yield block
            if length is not None and received != int(length):
                raise ConnectionError(f"cut after {received} of {length} bytes")
    except (OSError, http.client.HTTPException, ValueError) as error:
        # A ValueError means a malformed address or length. A URLError has its cause in `reason`.
        reason = str(getattr(error, "reason", None) or error)
        raise _download_error(address, reason=reason) from error


def _open_address(address: str) -> HTTPResponse:
    """Connect to a server and read the header of its response, both within `HEADER_S`.

    The timeout of a socket restarts with each byte, so it cannot limit the total time. Therefore a
    second thread opens the connection, and this thread waits for at most `HEADER_S`.
    """
    responses: SimpleQueue[HTTPResponse | Exception] = SimpleQueue()

    def connect() -> None:
        try:
            responses.put(urllib.request.urlopen(address, timeout=SILENCE_S))
        except Exception as error:  # raised again in the waiting thread
            responses.put(error)

    threading.Thread(target=connect, daemon=True).start()
    try:
        response = responses.get(timeout=HEADER_S)
    except Empty:
        raise TimeoutError(f"no whole header after {HEADER_S:.0f} s") from None
    if isinstance(response, Exception):
        raise response
    return response


def _download_error(address: str, reason: str) -> OSError:
    """Error of a failed download, with the folder in which to put the file."""
    name = _published_name(address)
    place = os.environ.get(WEIGHTS) or f"a folder and set {WEIGHTS} to it"
    return OSError(
        f"{address} cannot be fetched ({reason}): put {name} into {place}, or replace the address "
        "in the config (init_cfg.checkpoint or load_from) by a path; with init_cfg=None, the part "
        "is trained from scratch."
    )


def in_our_names(checkpoint: Any) -> Any:
    """Rename the weights of a published backbone to the keys of mmdet and of this project.

    The format is recognised by the keys. Supported are EfficientNet of ``efficientnet_pytorch``,
    backbones of detectron2, and the Swin Transformers in the segmentation models of their authors.

    Args:
        checkpoint: Contents of the published file.

    Returns:
        The weights by their new keys. Contents in another format are returned unchanged, except
        that contents with ``model`` and without ``state_dict`` are replaced by their ``model``.
    """
    if not isinstance(checkpoint, Mapping):
        return checkpoint
    state = checkpoint  # the mapping with the weights
    if isinstance(checkpoint.get("state_dict"), Mapping):
        state = checkpoint["state_dict"]
    elif isinstance(checkpoint.get("model"), Mapping):
        state = checkpoint["model"]
        # mmengine finds weights in ``state_dict``, but not in ``model``. Weights in another format
        # are therefore returned without ``model`` around them.
        checkpoint = state
    if "_conv_stem.weight" in state:
        renamed: dict[str, Tensor] = {}
        for key, value in state.items():
            name = _EFFICIENTNET.to_ours(key)
            if name is not None:
                renamed[name] = value
        return renamed
    keys = list(map(str, state))  # a foreign file may have keys that are not strings
    if any(key.startswith(_DETECTRON_PREFIX) for key in keys):
        return _select_weights(state, pattern=_DETECTRON)
    if any(key.startswith(_SWIN_PREFIX) for key in keys):
        return _select_weights(state, pattern=_SWIN)
    return checkpoint  # another format


def _select_weights(state: Mapping[str, Tensor], pattern: re.Pattern[str]) -> dict[str, Tensor]:
    """Select the weights whose keys match a pattern, and rename them to its first group."""
    weights: dict[str, Tensor] = {}
    for key, value in state.items():
        match = pattern.fullmatch(str(key))
        if match is not None:
            weights[match[1]] = value
    return weights
