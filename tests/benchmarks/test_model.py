import argparse
import shutil
from pathlib import Path
from types import ModuleType
from unittest.mock import create_autospec

import pytest
import torch
from method_cases import cases_of_methods
from model_cases import IMAGE_SHAPE, NUM_CAMS
from test_configs import load, small

from benchmarks import export, fps, live, profile, step
from benchmarks.model import advance_samples, image_shape, model_and_batch
from gsmap.apis.export import export_onnx

REPO = Path(__file__).resolve().parents[2]


def run(command: ModuleType, *arguments: str, size: tuple[str, str] = ("64", "96")) -> None:
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    args = parser.parse_args([*arguments, "--size", *size, "--repeats", "1"])
    args.threads = torch.get_num_threads()
    command.run(args)


def cells(printed: str) -> list[list[str]]:
    """Return the cells of the table's rows."""
    lines = [line for line in printed.splitlines() if line.startswith("| ")][2:]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


@pytest.mark.parametrize(
    ("config", "shape"),
    [
        ("maptr/maptr_r50_24e", (6, 480, 800)),
        ("maptr/maptr_r18_nano_110e", (6, 192, 320)),
        ("maptr/maptr_r18_minicity", (6, 192, 320)),
        ("maptr/maptr_r18_av2_rendered", (7, 128, 128)),
        ("my_data", (2, 96, 160)),
    ],
)
def test_images_are_as_large_as_the_configs(config, shape):
    path = str(REPO / f"configs/{config}.py")
    assert image_shape(path, argparse.Namespace(size=None)) == shape
    assert image_shape(path, argparse.Namespace(size=[64, 96])) == (shape[0], 64, 96)


def test_overrides_of_images_and_cameras_are_measured():
    args = argparse.Namespace(size=None, cfg_options={"image_scale": 0.25})
    path = str(REPO / "configs/maptr/maptr_r50_24e.py")
    assert image_shape(path, args) == (6, 256, 416)  # 225 x 400, padded to multiples of 32
    args.cfg_options = {"test_dataloader.dataset.cameras": ["CAM_FRONT"]}
    assert image_shape(path, args) == (1, 480, 800)


LOSSES = cases_of_methods("LOSSES")


@pytest.mark.parametrize("method", LOSSES)
def test_heads_with_targets_of_their_own_have_losses(method):
    field, may_be_zero = LOSSES[method]
    args = argparse.Namespace(threads=torch.get_num_threads(), device="cpu", size=(64, 96))
    cfg = small(load(REPO / f"configs/{method}/{method}_r18_minicity.py"))
    model, inputs, (sample,) = model_and_batch(cfg, args)
    assert len(sample.gt_instances_3d[field]) >= 15
    losses = model.loss(inputs, [sample])
    assert all(torch.isfinite(loss) for loss in losses.values())
    assert all(loss > 0 for name, loss in losses.items() if name not in may_be_zero)


def test_frames_per_second_are_those_of_the_time(capsys):
    run(fps, str(REPO / "configs/maptr/maptr_r18_nano_110e.py"))
    ((name, seconds, ratio, wall, per_second, peak),) = cells(capsys.readouterr().out)
    assert name == "maptr_r18_nano_110e"
    assert float(per_second) == pytest.approx(1 / float(wall), rel=0.1)
    assert float(seconds) > 0
    assert float(peak) > 0
    assert ratio == "1.000"


def test_an_exported_model_is_measured_beside_torch(small_onnx, monkeypatch, capsys):
    """In this process: the frames per second above come from processes of their own.

    The exported file is of a model of the same inputs. `test_export.py` exports models.
    """
    pytest.importorskip("onnxruntime")

    def copy_file(model, out, cameras, image_size):
        assert not model.training
        assert (len(cameras), image_size) == (NUM_CAMS, IMAGE_SHAPE)
        shutil.copy(small_onnx, out)

    monkeypatch.setattr(export, "export_onnx", create_autospec(export_onnx, side_effect=copy_file))
    monkeypatch.setattr(export, "in_own_process", lambda function, *given: function(*given))
    run(export, str(REPO / "configs/maptr/maptr_r18_minicity.py"))
    rows = cells(capsys.readouterr().out)
    assert [row[1] for row in rows] == ["torch", "ONNX Runtime", "ONNX Runtime, 8 bits"]
    assert all(float(row[2]) > 0 for row in rows)
    assert rows[0][4:] == ["1.00", "1.00"]


def test_a_frame_of_a_known_rig_is_measured_beside_one_of_a_new_rig(capsys):
    run(live, "maptr_r18_minicity")
    printed = capsys.readouterr().out
    assert printed.startswith("maptr_r18_minicity, 6 images of 64 x 96, cpu, ")
    known, new = cells(printed)
    assert (known[0], new[0]) == ("live(images)", "predict_images(images, ...)")
    assert min(float(known[1]), float(new[1])) > 0


def test_a_step_is_measured_for_every_raster_of_gsmap(monkeypatch, capsys):
    """In this process, as above."""
    name = "benchmarks.model.in_own_process"
    monkeypatch.setattr(name, lambda function, *given: function(*given))
    run(
        step, str(REPO / "projects/GSMap/configs/gsmap_maptr_r18_minicity.py"),
        "--rasters", "64x32", "80x40",
    )  # fmt: skip
    rows = cells(capsys.readouterr().out)
    assert [row[1] for row in rows] == ["64x32", "80x40"]
    assert all(float(row[2]) > 0 for row in rows)


def test_a_step_in_mixed_precision_is_that_of_a_training(monkeypatch, capsys):
    monkeypatch.setattr(
        "benchmarks.model.in_own_process", lambda function, *given: function(*given)
    )
    made = create_autospec(step.build_optim_wrapper, side_effect=step.build_optim_wrapper)
    monkeypatch.setattr(step, "build_optim_wrapper", made)
    run(step, str(REPO / "configs/maptr/maptr_r18_minicity.py"), "--fp16")
    assert made.call_args.args[1]["type"] == "CPUAutocastOptimWrapper"
    assert ", bfloat16, cpu, " in capsys.readouterr().out


def test_a_model_with_memory_continues_its_streams_from_call_to_call():
    args = argparse.Namespace(threads=torch.get_num_threads(), device="cpu", size=[64, 96])
    path = str(REPO / "projects/GSMap/configs/gsmap_stream_r18_minicity.py")
    model, inputs, samples = model_and_batch(path, args, batch=2)
    shares = []
    for _ in range(2):
        advance_samples(samples)
        shares.append(float(model.loss(inputs, samples)["loss_trans"].detach()))
    assert shares[0] == 0 < shares[1]  # only what continues is told how the vehicle has moved
    model.eval()
    with torch.no_grad():
        for _ in range(2):
            advance_samples(samples)
            model.predict(inputs, samples)
    assert list(model.temporal.streams.states) == ["scene 0", "scene 1"]


@pytest.mark.parametrize(
    ("config", "necks", "size"),
    [
        ("maptr/maptr_r18_nano_110e", ["image neck"], ("64", "96")),
        *((case, [], size) for case, size in cases_of_methods("PROFILES").values()),
    ],
)
def test_the_parts_of_a_forward_pass_add_up(config, necks, size, capsys):
    run(profile, str(REPO / f"configs/{config}.py"), size=size)
    lines = [line.rsplit(" s ", 1) for line in capsys.readouterr().out.splitlines()[1:]]
    seconds = {line[0].rsplit(None, 1)[0].strip(): float(line[0].split()[-1]) for line in lines}
    assert list(seconds) == ["image backbone", *necks, "BEV encoder", "map head", "total"]
    total = seconds.pop("total")
    assert sum(seconds.values()) == pytest.approx(total, abs=0.003)  # printed to a millisecond
