"""Commands on tiny data, in forks of a process that has imported everything."""

import faulthandler
import os
import pty
import runpy
import shutil
import signal
import sys
import tempfile
import traceback
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch
from mmdet3d.registry import MODELS
from processes import REPO, free_port

import gsmap.registered  # noqa: F401
import tools.build_map
import tools.create_data
import tools.evaluate
import tools.infer
import tools.train  # noqa: F401
from gsmap.datasets.annotations.file import AnnotationFile, write_annotations
from gsmap.datasets.elements import elements_of_instances
from gsmap.engine.launch import read_config
from gsmap.evaluation.core.results_json import vectors_of, write_results

Work = Callable[[], None]


def start(work: Work) -> tuple[int, int]:
    """Do some work in a forked process with a terminal of its own.

    Ctrl-C and ``kill`` are blocked, as in processes that some programs fork.

    Returns its number and the other end of its terminal.
    """
    sys.stdout.flush()
    pid, terminal = pty.fork()
    if pid:
        return pid, terminal
    code = 1
    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
        faulthandler.enable(sys.__stderr__)
        work()
        code = 0
    except SystemExit as end:
        code = end.code or 0
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(code)


def command(name: str, *words: object) -> Work:
    """Return a call of ``tools/NAME.py``, or of a module."""

    def call() -> None:
        sys.argv = [f"tools/{name}.py", *map(str, words)]
        os.chdir(REPO)
        if "." in name:
            runpy.run_module(name, run_name="__main__", alter_sys=True)
        else:
            runpy.run_path(sys.argv[0], run_name="__main__")

    return call


class Data:
    """Files for the commands.

    Args:
        root: A MiniCity with its annotation files.
        config: Config of a tiny model that reads them.
        samples: Samples of ``annotations``; they share their images.
    """

    def __init__(self, root: Path, config: Path, samples: int) -> None:
        self.root, self.config = root, config
        self.folder = Path(tempfile.mkdtemp())
        self.annotations = self.folder / "annotations.arrow"
        self.results = self.folder / "results.json"
        self.checkpoint = self.folder / "model.pth"
        file = AnnotationFile(root / "gsmap_minicity_val.arrow")
        every = [
            replace(
                file[i % len(file)],
                token=f"{i:05}",
                timestamp_ns=10**18 + i * 5 * 10**8,
            )
            for i in range(samples)
        ]
        write_annotations(self.annotations, file.meta, every)
        classes = file.meta.classes
        vectors = [vectors_of(elements_of_instances(s.instances), classes) for s in every]
        tokens = [sample.token for sample in every]
        write_results(self.results, zip(tokens, vectors, strict=True), {"classes": list(classes)})
        torch.manual_seed(0)
        model = MODELS.build(read_config(config).model)
        torch.save({"state_dict": model.state_dict()}, self.checkpoint)

    def empty_folder(self) -> Path:
        """Return a folder for what a command writes, the same each time, as files name it."""
        shutil.rmtree(out := self.folder / "out", ignore_errors=True)
        out.mkdir()
        return out

    def commands(self, out: Path) -> dict[str, Work]:
        """Return the commands of one process; they write to a folder."""
        model = "--model", self.config, self.checkpoint, "--data-root", self.root
        return {
            "create_data": command(
                "create_data", "nuscenes", "--root", self.root, "--version", "v1.0-trainval",
                "--dataset", "minicity", "--out-dir", out, "--workers", 2,
            ),
            "infer": command(
                "infer", self.annotations, *model, "--out", out / "map.json", "--workers", 2
            ),
            "build_map": command(
                "build_map", self.results, "--ann", self.annotations, "--out", out,
                "--formats", "geojson", "png",
            ),
            "train": command(
                "train", self.config, "--work-dir", out, "--resume", "--cfg-options",
                "randomness.seed=0",
            ),
            "evaluate": command(
                "evaluate", self.results, self.annotations, "--workers", 2,
                "--out", out / "figures.json",
            ),
            "check": command(
                "create_data", "check", self.annotations, "--data-root", self.root, "--workers", 2
            ),
            "train, two ranks": command(
                "gsmap.engine.torchrun", "--nproc_per_node=2", f"--master_port={free_port()}",
                "tools/train.py", self.config, "--launcher", "pytorch", "--work-dir", out,
                "--cfg-options", "train_dataloader.num_workers=2", "train_cfg.max_epochs=5000",
                "train_dataloader.persistent_workers=True", "train_cfg.val_interval=5000",
            ),
        }  # fmt: skip
