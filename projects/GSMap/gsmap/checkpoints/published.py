"""Weights that others publish: found by their address, checked, and in our backbones' names.

A config names them by address. The file is looked for under its own name in the folder that the
environment variable ``GSMAP_WEIGHTS`` names, then among those fetched before, then on the network.
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

WEIGHTS = "GSMAP_WEIGHTS"
SILENCE_S = 30.0  # a server that sends nothing for so long is given up
HEADER_S = 60.0  # so is one whose header is not whole by then
LIMIT_S = 3600.0  # so is a download that takes longer
_BLOCK_BYTES = 1 << 20
_DIGEST = re.compile(r"-([0-9a-f]{8,64})(\.\w+)?\Z")  # torch's and OpenMMLab's file names
_EFFICIENTNET = KeyMap("efficientnet", efficientnet_rules("", ""), unused_classifier(""))
_DETECTRON = "backbone.bottom_up."
_SWIN = re.compile(r"backbone\.((layers|patch_embed|norm\d)\..+)")


def load_published(
    address: str, model_dir: object = None, map_location: Any = "cpu", progress: bool = False
) -> Any:
    """Load weights by their address; it takes the place of mmengine's ``load_url``.

    Args:
        address: Where they are published.
        model_dir: Not used: `find_weights` says where a file lies.
        map_location: Device, as torch takes it.
        progress: Not used.

    Returns:
        The checkpoint, in the names of our backbones (`in_our_names`).

    Raises:
        OSError: If it can be neither found nor fetched.
        ValueError: If it cannot be read. A broken file that was fetched is removed.
    """
    path = find_weights(address)
    try:
        with refusing(address):
            checkpoint = load_tensors(path, map_location)
    except ValueError as error:
        if path != cache_file(address):
            raise InputError(f"{error} The file is {path}.") from error
        path.unlink(missing_ok=True)
        raise InputError(f"{error} The fetched file, {path}, was removed.") from error
    return in_our_names(checkpoint)


def load_from_file(path: str, map_location: Any = "cpu") -> Any:
    """Load weights from a file, in the names of our backbones; a scheme of mmengine's.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it cannot be read.
    """
    file = Path(path).expanduser()
    if not file.is_file():
        raise FileNotFoundError(f"there are no weights at {file}: check the path.")
    with refusing(file):
        return in_our_names(load_tensors(file, map_location))


def load_from_torchvision(name: str, map_location: Any = "cpu") -> Any:
    """Load what ``torchvision://NAME`` stands for, without torchvision; a scheme of mmengine's.

    Raises:
        ValueError: If torchvision has no weights of that name.
    """
    table = Path(mmengine.__file__).parent / "hub/torchvision_0.12.json"
    addresses = json.loads(table.read_text())
    address = addresses.get(name.partition("://")[2])
    if address is None:
        raise InputError(f"{name} is not known: give the address of the weights, or a path.")
    return load_published(address, map_location=map_location)


def find_weights(address: str) -> Path:
    """Return the file of published weights, fetched if it is not here.

    A file whose name ends in the first digits of its sha256 must have that digest if it was
    fetched; in one's own folder another digest is a warning.

    Raises:
        OSError: If it can be neither found nor fetched.
    """
    name = _name(address)
    folder = os.environ.get(WEIGHTS)
    if folder and not Path(folder).is_dir():
        raise FileNotFoundError(
            f"{WEIGHTS} names {folder}, which is no folder: put {name} into one."
        )
    if folder and (own := Path(folder, name)).is_file():
        if not _is_published(own, name):
            print_log(
                f"{own} is used, but is not the published file: its sha256 is {digest(own)}.",
                level=logging.WARNING,
            )
        return own
    cached = cache_file(address)
    if cached.is_file() and not _is_published(cached, name):
        print_log(f"{cached} is broken and is fetched again.", level=logging.WARNING)
        cached.unlink()
    if not cached.is_file():
        _fetch(address, cached)
    print_log(f"weights of {address} are in {cached}.")
    return cached


def cache_file(address: str) -> Path:
    """Return where a fetched file lies; a digest in its name keeps addresses apart."""
    name, dot, kind = _name(address).rpartition(".")
    mark = hashlib.sha256(address.encode()).hexdigest()[:16]
    marked = f"{name}={mark}.{kind}" if dot else f"{kind}={mark}"
    return Path(torch.hub.get_dir(), "checkpoints", file_name(marked))


def _name(address: str) -> str:
    """Return the file's name in an address."""
    return file_name(unquote(Path(urlsplit(address).path).name) or "weights.pth")


def _is_published(path: Path, name: str) -> bool:
    """Whether a file has the digest that its published name ends in, if it ends in one."""
    promised = _DIGEST.search(name)
    return promised is None or digest(path).startswith(promised[1])


def _fetch(address: str, path: Path) -> None:
    """Fetch a file whole, or say what to put where."""
    print_log(f"fetching {address} to {path} ...")
    total = hashlib.sha256()
    with atomic_write(path, "wb") as file:
        for block in _blocks(address):
            total.update(block)
            file.write(block)
        promised = _DIGEST.search(_name(address))
        if promised and not total.hexdigest().startswith(promised[1]):
            raise _unreachable(address, f"it came with sha256 {total.hexdigest()[:16]}...")


def _blocks(address: str) -> Iterator[bytes]:
    """Yield a file of the network in blocks, within `LIMIT_S`."""
    end_s = time.monotonic() + LIMIT_S
    try:
        with _open_address(address) as answer:
            length = answer.headers.get("Content-Length")
            received = 0
            while block := answer.read1(_BLOCK_BYTES):
                received += len(block)
                if time.monotonic() > end_s:
                    raise TimeoutError(f"not whole after {LIMIT_S:.0f} s")
                yield block
            if length is not None and received != int(length):
                raise ConnectionError(f"cut after {received} of {length} bytes")
    except (OSError, http.client.HTTPException, ValueError) as error:
        raise _unreachable(address, str(getattr(error, "reason", None) or error)) from error


def _open_address(address: str) -> HTTPResponse:
    """Connect to a server and read the header of its answer, both within `HEADER_S`.

    The timeout of a socket begins anew with each byte, so another thread waits for the header.
    """
    answers: SimpleQueue[HTTPResponse | Exception] = SimpleQueue()

    def connect() -> None:
        try:
            answers.put(urllib.request.urlopen(address, timeout=SILENCE_S))
        except Exception as error:  # raised again by the thread that waits
            answers.put(error)

    threading.Thread(target=connect, daemon=True).start()
    try:
        answer = answers.get(timeout=HEADER_S)
    except Empty:
        raise TimeoutError(f"no whole header after {HEADER_S:.0f} s") from None
    if isinstance(answer, Exception):
        raise answer
    return answer


def _unreachable(address: str, reason: str) -> OSError:
    """Return the error of a file that did not come, which says what to put where."""
    name = _name(address)
    folder = os.environ.get(WEIGHTS)
    place = f"put {name} into {folder or f'a folder and set {WEIGHTS} to it'}"
    return OSError(
        f"{address} cannot be fetched ({reason}): {place}, or set init_cfg.checkpoint (load_from, "
        "if that names it) to a path; init_cfg=None of the part trains it from scratch."
    )


def in_our_names(checkpoint: Any) -> Any:
    """Rename the weights of a published backbone as mmdet's and our modules have them.

    It knows EfficientNet as ``efficientnet_pytorch`` publishes it, backbones of detectron2, and the
    Swin Transformers in the segmentation models of its authors, told by their keys. Whatever else a
    checkpoint holds is returned as it is.
    """
    if not isinstance(checkpoint, Mapping):
        return checkpoint
    state = checkpoint
    if isinstance(checkpoint.get("state_dict"), Mapping):
        state = checkpoint["state_dict"]
    elif isinstance(checkpoint.get("model"), Mapping):
        checkpoint = state = checkpoint["model"]
    if "_conv_stem.weight" in state:
        renamed = {_EFFICIENTNET.to_ours(key): value for key, value in state.items()}
        return {key: value for key, value in renamed.items() if key is not None}
    if any(str(key).startswith(_DETECTRON) for key in state):
        return _part_of(state, re.compile(re.escape(_DETECTRON) + "(.+)"))
    if any(str(key).startswith("backbone.layers.0.blocks.0.attn.") for key in state):
        return _part_of(state, _SWIN)
    return checkpoint


def _part_of(state: Mapping[str, Tensor], pattern: re.Pattern[str]) -> dict[str, Tensor]:
    """Return the weights whose names fit a pattern, by its first group."""
    found = {pattern.fullmatch(str(key)): value for key, value in state.items()}
    return {match[1]: value for match, value in found.items() if match is not None}
