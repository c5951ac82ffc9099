"""Weights by their address: where they are looked for, what is checked, what is said."""

import hashlib
import io
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
import torch
from mmengine.model import BaseModule
from processes import run_tool

from gsmap.checkpoints import published
from gsmap.checkpoints.published import (
    WEIGHTS,
    cache_file,
    find_weights,
    in_our_names,
    load_from_file,
    load_from_torchvision,
    load_published,
)


def content(value: float) -> bytes:
    """Return a file of weights."""
    stream = io.BytesIO()
    torch.save({"weight": torch.full((1, 1), value)}, stream)
    return stream.getvalue()


class Server:
    """A server of this machine: contents by path, how much of each it sends, what was asked."""

    def __init__(self) -> None:
        self.files: dict[str, bytes] = {}
        self.sent: dict[str, int] = {}
        self.hangs: set[str] = set()
        self.drips: set[str] = set()
        self.asked: list[str] = []
        self.go_on = threading.Event()
        server = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                server.asked.append(self.path)
                if self.path in server.drips:
                    self.wfile.write(b"HTTP/1.0 200 OK\r\n")
                    while not server.go_on.wait(0.05):
                        self.wfile.write(b"X")
                    return
                if self.path not in server.files:
                    self.send_error(404)
                    return
                data = server.files[self.path]
                self.send_response(200)
                self.send_header("Content-Length", str(len(data)))
                self.end_headers()
                self.wfile.write(data[: server.sent.get(self.path, len(data))])
                if self.path in server.hangs:
                    self.wfile.flush()
                    server.go_on.wait()

            def log_message(self, *_: Any) -> None:
                """Say nothing."""

        self.http = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        threading.Thread(target=self.http.serve_forever, daemon=True).start()

    def address(self, path: str) -> str:
        return f"http://127.0.0.1:{self.http.server_port}{path}"


@pytest.fixture
def server(monkeypatch, tmp_path) -> Iterator[Server]:
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY", WEIGHTS):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(torch.hub, "_hub_dir", str(tmp_path / "hub"))
    made = Server()
    yield made
    made.go_on.set()
    made.http.shutdown()
    made.http.server_close()


def test_two_addresses_with_one_last_name_are_two_files(server):
    server.files = {"/a/best.pth": content(1.0), "/b/best.pth": content(2.0)}
    first, second = (load_published(server.address(path)) for path in server.files)
    assert (first["weight"].item(), second["weight"].item()) == (1.0, 2.0)
    again = load_published(server.address("/a/best.pth"))
    assert again["weight"].item() == 1.0
    assert server.asked == ["/a/best.pth", "/b/best.pth"]  # fetched once each


def test_it_is_said_where_a_fetched_file_lies(server, monkeypatch):
    said: list[str] = []
    monkeypatch.setattr(published, "print_log", lambda text, **_: said.append(text))
    server.files = {"/x.pth": content(1.0)}
    address = server.address("/x.pth")
    path = find_weights(address)
    assert said == [f"fetching {address} to {path} ...", f"weights of {address} are in {path}."]
    assert path.parent == Path(torch.hub.get_dir(), "checkpoints")


def test_a_cut_download_leaves_nothing(server):
    server.files, server.sent = {"/x.pth": content(1.0)}, {"/x.pth": 100}
    address = server.address("/x.pth")
    with pytest.raises(OSError, match=r"cut after 100 of \d+ bytes"):
        find_weights(address)
    assert not list(cache_file(address).parent.iterdir())
    server.sent = {}
    assert load_published(address)["weight"].item() == 1.0


def test_a_server_that_falls_silent_is_given_up(server, monkeypatch):
    monkeypatch.setattr(published, "SILENCE_S", 0.2)
    server.files, server.sent, server.hangs = {"/x.pth": content(1.0)}, {"/x.pth": 9}, {"/x.pth"}
    with pytest.raises(OSError, match="timed out"):
        find_weights(server.address("/x.pth"))


def test_a_server_whose_header_never_ends_is_given_up(server, monkeypatch):
    monkeypatch.setattr(published, "HEADER_S", 0.3)
    server.drips = {"/x.pth"}
    with pytest.raises(OSError, match="no whole header after"):
        find_weights(server.address("/x.pth"))


def test_a_download_has_a_limit(server, monkeypatch):
    monkeypatch.setattr(published, "LIMIT_S", -1.0)
    server.files = {"/x.pth": content(1.0)}
    with pytest.raises(OSError, match=r"not whole after"):
        find_weights(server.address("/x.pth"))


def test_the_digest_in_a_name_is_checked(server):
    good, other = content(1.0), content(2.0)
    name = f"/net-{hashlib.sha256(good).hexdigest()[:8]}.pth"
    server.files = {name: other}
    with pytest.raises(OSError, match="came with sha256 " + hashlib.sha256(other).hexdigest()[:16]):
        find_weights(server.address(name))
    server.files = {name: good}
    path = find_weights(server.address(name))
    path.write_bytes(good[:-1])  # the disk lost a byte
    assert find_weights(server.address(name)).read_bytes() == good
    assert server.asked == [name] * 3


def test_a_broken_file_that_was_fetched_is_removed(server):
    server.files = {"/x.pth": b"an error page"}
    address = server.address("/x.pth")
    with pytest.raises(ValueError, match=r"x\.pth is not a whole.*The fetched file, .*was removed"):
        load_published(address)
    assert not cache_file(address).exists()


def test_ones_own_folder_comes_first_and_another_digest_is_said(server, monkeypatch, tmp_path):
    said: list[str] = []
    monkeypatch.setattr(published, "print_log", lambda text, **_: said.append(text))
    folder = tmp_path / "own"
    folder.mkdir()
    monkeypatch.setenv(WEIGHTS, str(folder))
    own, name = content(3.0), f"net-{hashlib.sha256(content(1.0)).hexdigest()[:8]}.pth"
    (folder / name).write_bytes(own)
    assert load_published(server.address(f"/{name}?dl=1"))["weight"].item() == 3.0
    assert server.asked == []
    assert said == [
        f"{folder / name} is used, but is not the published file: its sha256 is "
        f"{hashlib.sha256(own).hexdigest()}."
    ]
    (folder / name).write_bytes(b"broken")
    with pytest.raises(ValueError, match="The file is "):
        load_published(server.address(f"/{name}"))
    assert (folder / name).exists()  # one's own is never removed
    monkeypatch.setenv(WEIGHTS, str(folder / "nowhere"))
    with pytest.raises(FileNotFoundError, match="which is no folder"):
        find_weights(server.address(f"/{name}"))


def test_without_a_network_one_line_says_what_to_put_where(server, monkeypatch, tmp_path):
    address = server.address("/resnet50-19c8e357.pth")
    with pytest.raises(OSError, match=r"Not Found") as told:
        find_weights(address)
    text = str(told.value)
    assert f"put resnet50-19c8e357.pth into a folder and set {WEIGHTS} to it" in text
    assert "init_cfg.checkpoint" in text
    assert "\n" not in text
    monkeypatch.setenv(WEIGHTS, str(tmp_path))
    with pytest.raises(OSError, match=f"put resnet50-19c8e357.pth into {tmp_path}, or"):
        find_weights(address)


def test_torchvisions_names_need_no_torchvision(server, monkeypatch, tmp_path):
    monkeypatch.setenv(WEIGHTS, str(tmp_path))
    (tmp_path / "resnet18-f37072fd.pth").write_bytes(content(5.0))
    assert load_from_torchvision("torchvision://resnet18")["weight"].item() == 5.0
    with pytest.raises(ValueError, match="torchvision://nonsense is not known"):
        load_from_torchvision("torchvision://nonsense")
    with pytest.raises(FileNotFoundError, match="there are no weights at"):
        load_from_file(str(tmp_path / "nowhere.pth"))


def test_weights_of_others_keep_their_values_in_our_names():
    value = torch.rand(3)
    renamed = in_our_names({"_conv_stem.weight": value, "_fc.bias": value, "_bn0.bias": value})
    assert renamed == {"layers.0.conv.weight": value, "layers.0.bn.bias": value}
    assert in_our_names({"model": {"backbone.bottom_up.stem.x": value, "head.y": value}}) == {
        "stem.x": value
    }
    swin = {"backbone.layers.0.blocks.0.attn.qkv.bias": value, "backbone.norm2.bias": value}
    assert in_our_names({"state_dict": {**swin, "decode_head.bias": value}}) == {
        "layers.0.blocks.0.attn.qkv.bias": value,
        "norm2.bias": value,
    }
    for whole in ({"state_dict": {"img_backbone.conv1.weight": value}, "meta": {}}, {"x": 1}, 3):
        assert in_our_names(whole) is whole


def test_readmes_first_training_command_ends_in_one_line_without_a_network(
    minicity_annotations, minicity_root, tmp_path, monkeypatch
):
    """A fresh machine: no torchvision, nothing fetched before, and no network."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "home"))
    monkeypatch.setenv("https_proxy", "http://127.0.0.1:9")  # nobody answers there
    monkeypatch.setenv("GSMAP_WEIGHTS", "")
    done = run_tool(
        "tools/train.py", "projects/GSMap/configs/gsmap_maptr_r50_24e.py",
        "--data-root", minicity_root, "--work-dir", tmp_path / "work",
        "--cfg-options",
        *(f"{part}_dataloader.dataset.ann_file={minicity_annotations[name]}"
          for part, name in (("train", "train"), ("val", "val"), ("test", "val"))),
        "train_dataloader.num_workers=0", "train_dataloader.persistent_workers=False",
        "val_dataloader.num_workers=0", "val_dataloader.persistent_workers=False",
    )  # fmt: skip
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    last = done.stderr.splitlines()[-1]
    assert last.startswith(
        "error: https://download.pytorch.org/models/resnet50-19c8e357.pth cannot be fetched ("
    )
    assert "put resnet50-19c8e357.pth into a folder and set GSMAP_WEIGHTS to it" in last


def test_the_loader_serves_mmengines_own_pretrained_start(tmp_path, monkeypatch):
    """A module's ``init_cfg`` reads through the scheme for files, in a run of its own."""
    path = tmp_path / "w.pth"
    torch.save({"model": {"backbone.bottom_up.inner.weight": torch.full((1, 1), 7.0)}}, path)

    class Backbone(BaseModule):
        def __init__(self) -> None:
            super().__init__({"type": "Pretrained", "checkpoint": str(path)})
            self.inner = torch.nn.Linear(1, 1, bias=False)

    from mmengine.runner import CheckpointLoader

    schemes = dict(CheckpointLoader._schemes)
    monkeypatch.setattr(CheckpointLoader, "_schemes", schemes)
    CheckpointLoader.register_scheme("", load_from_file, force=True)
    module = Backbone()
    module.init_weights()
    assert module.inner.weight.item() == 7.0
