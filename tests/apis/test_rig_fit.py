"""Which of a model's cameras looks as one of another rig does."""

import copy
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from mmdet3d.registry import MODELS
from mmengine.registry import init_default_scope
from model_cases import build_small, small_config

from gsmap.apis.rig_fit import RigFitHook, fit_start, similar_cameras, training_facts
from gsmap.checkpoints.named_models import find_checkpoint
from gsmap.datasets.annotations.record import CameraRecord, MapSample
from gsmap.structures.grid import BEVGrid

NUSCENES = (
    "CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_FRONT_LEFT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_BACK_RIGHT",
)  # fmt: skip
# rows: the camera's right, down and forward in the vehicle's frame (x forward, y left, z up)
LOOKS_LEFT = [[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]]
LOOKS_RIGHT = [[-1, 0, 0, 0], [0, 0, -1, 0], [0, -1, 0, 0], [0, 0, 0, 1]]


def similar(trained: tuple[str, ...]) -> list[str]:
    """Return what looks most as a camera to the left, one to the right, and one that is absent."""
    matrices = {"west": LOOKS_LEFT, "east": LOOKS_RIGHT}
    cameras = [
        CameraRecord(name, "a.jpg", 1600, 900, np.diag([1000.0, 1000.0, 1.0]), np.array(m, float))
        for name, m in matrices.items()
    ]
    sample = MapSample("a", "scene", "town", 0, cameras, np.eye(4))
    found = similar_cameras(sample, "ego", ["west", "east", "gone"], trained)
    return [trained[index] for index in found]


def test_left_is_left_and_right_is_right():
    """90 degrees lie nearer to 109 and 111 than to 55; what is absent looks ahead."""
    assert similar(NUSCENES) == ["CAM_BACK_LEFT", "CAM_BACK_RIGHT", "CAM_FRONT"]
    assert similar(("ring_side_right", "ring_side_left")) == [
        "ring_side_left",
        "ring_side_right",
        "ring_side_right",  # both are as far from ahead: the first
    ]


def test_a_model_of_unknown_cameras_is_named():
    with pytest.raises(ValueError, match=r"is for the cameras \['a'\], the input has \['west'"):
        similar(("a",))


METAINFO = {
    "classes": ("boundary", "divider", "kerb"),
    "frame": "ego",
    "x_range": (-30.0, 30.0),
    "y_range": (-15.0, 15.0),
}


class Drive:
    """A data set whose two cameras look left and right, as training knows it."""

    cameras = ("west", "east")
    metainfo = METAINFO

    def __len__(self) -> int:
        return 1

    def sample(self, _: int) -> MapSample:
        cameras = [
            CameraRecord(name, "a.jpg", 16, 9, np.diag([9.0, 9, 1]), np.array(matrix, float))
            for name, matrix in zip(self.cameras, (LOOKS_LEFT, LOOKS_RIGHT), strict=True)
        ]
        return MapSample("a", "scene", "town", 0, cameras, np.eye(4))


ORIGIN = {"cameras": NUSCENES, "classes": ["divider", "ped_crossing", "boundary"], "frame": "lidar"}
ORIGIN |= {"x_range": [-15.0, 15.0], "y_range": [-30.0, 30.0]}


def another_rig() -> torch.nn.Module:
    """Return a small model for `Drive`."""
    grid = {"x_range": [-30.0, 30.0], "y_range": [-15.0, 15.0]}
    encoder = {**small_config()["bev_encoder"], "num_cams": 2}
    return build_small(1, bev_encoder=encoder, grid=grid, classes=list(METAINFO["classes"]))


def test_a_start_is_fitted_to_cameras_cells_and_classes():
    trained, model, origin = build_small(0).state_dict(), another_rig(), dict(ORIGIN)
    state = dict(trained)
    lines = fit_start(state, model, Drive(), origin)
    model.load_state_dict(state)  # it is strict
    found = model.state_dict()
    embeds = "bev_encoder.cams_embeds"
    torch.testing.assert_close(found[embeds], trained[embeds][[4, 5]])  # back left, back right
    cells = "bev_encoder.bev_embedding.weight"
    assert trained[cells].shape == found[cells].shape == (72, 16)  # 12 x 6, 6 x 12
    old = trained[cells].unflatten(0, (12, 6))
    new = found[cells].unflatten(0, (6, 12))
    torch.testing.assert_close(new[0, 0], old[:2, 0].mean(0))  # half as many rows
    torch.testing.assert_close(new.mean((0, 1)), old.mean((0, 1)))
    for name, count in (("row", 6), ("col", 12)):
        key = f"bev_encoder.positional_encoding.{name}_embed.weight"
        assert len(found[key]) == count
        torch.testing.assert_close(found[key].mean(0), trained[key].mean(0))
    last = next(key for key in found if ".cls_branches.0." in key and len(found[key]) == 3)
    torch.testing.assert_close(found[last][0], trained[last][2])  # boundary
    torch.testing.assert_close(found[last][1], trained[last][0])  # divider
    torch.testing.assert_close(found[last][2], another_rig().state_dict()[last][2])  # kerb: new
    assert [line.partition(":")[0] for line in lines] == [
        "embeddings of cameras",
        "queries of 12 x 6 BEV cells interpolated to 6 x 12.",
        "classes keep their weights",
        "x_range was [-15.0, 15.0], is (-30.0, 30.0)",
        "y_range was [-30.0, 30.0], is (-15.0, 15.0)",
        "frame was lidar, is ego",
    ]


def two_stages(detector: str) -> dict[str, Any]:
    return {"type": "VectorMapNetHead", "detector": {"type": detector}}


@pytest.mark.parametrize(
    ("head", "keys"),
    [
        (
            two_stages("KeyPointHead"),
            {
                "detector.cls_branch.weight": 0,
                "detector.cls_branch.bias": 0,
                "generator.label.weight": 0,
            },
        ),
        ({"type": "KeyPointHead"}, {"cls_branch.weight": 0, "cls_branch.bias": 0}),
        (
            {"type": "HDMapNetHead", "decoder": {"base_channels": 4}},
            {"decoder.maps.0.3.weight": 1, "decoder.maps.0.3.bias": 1},
        ),
        (two_stages("BezierHead"), {}),  # its classes have modules of their own
    ],
)
def test_rows_of_classes_of_other_heads_are_found_by_name(head, keys):
    init_default_scope("mmdet3d")
    grid = BEVGrid((-30.0, 30.0), (-15.0, 15.0))
    model = torch.nn.Module()
    model.map_head = MODELS.build({**head, "grid": grid, "classes": METAINFO["classes"]})
    for value in model.state_dict().values():
        value.fill_(-1)
    state = {key: value.clone() for key, value in model.state_dict().items()}
    for name, first in keys.items():
        rows = state[f"map_head.{name}"]
        assert len(rows) == first + 3
        rows += torch.arange(1.0, 1 + len(rows)).view(-1, *[1] * (rows.dim() - 1))  # 0, 1, 2, ..
    before = {key: value.clone() for key, value in state.items()}
    (line,) = fit_start(state, model, Drive(), METAINFO | {"classes": ORIGIN["classes"]})
    for name, first in keys.items():
        found = state.pop(f"map_head.{name}")
        found = found.reshape(len(found), -1)
        # what is no class, boundary, divider, and kerb, which is new
        wanted = torch.tensor([*range(first), first + 2.0, first, -1.0])
        torch.testing.assert_close(found, wanted[:, None].expand_as(found))
    assert all(torch.equal(value, before[key]) for key, value in state.items())
    kept = "classes keep their weights: boundary, divider; begin as new: kerb; are left out: ped_cr"
    assert line.startswith(kept if keys else "classes were divider")


def fit_classes(model: torch.nn.Module, names: list[str], trained: torch.nn.Module) -> str:
    """Load a trained model into one of other classes, and return the line about them."""
    state = dict(trained.state_dict())
    drive = SimpleNamespace(metainfo=METAINFO | {"classes": names}, cameras=NUSCENES)
    origin = METAINFO | {"classes": ORIGIN["classes"], "cameras": NUSCENES}
    (line,) = fit_start(state, model, drive, origin)
    model.load_state_dict(state)  # it is strict
    return line


@pytest.mark.parametrize(
    "names",
    [
        ["boundary", "divider", "ped_crossing"],
        ["stop_line", "divider", "ped_crossing", "boundary"],
        ["kerb", "divider"],
    ],
    ids=["other order", "one more", "fewer"],
)
def test_masks_of_classes_keep_their_weights_by_name(names):
    def with_masks(classes: list[str], seed: int) -> torch.nn.Module:
        masks = {"num_masks": len(classes)}
        aux_heads = [
            {"type": "BEVMaskHead", **masks},
            {"type": "PVMaskHead", **masks},
            {"type": "BEVMaskHead", "name": "union"},  # one mask for all classes
        ]
        head = {**small_config()["map_head"], "aux_heads": aux_heads}
        return build_small(seed, classes=classes, map_head=head).eval()

    trained, model = with_masks(ORIGIN["classes"], 0), with_masks(names, 1)
    new = {name: copy.deepcopy(head) for name, head in model.map_head.aux_heads.items()}
    fit_classes(model, names, trained)
    feats = torch.randn(2, 16, 3, 4)
    for name, head in model.map_head.aux_heads.items():
        trained_head = trained.map_head.aux_heads[name]
        if name == "union":
            torch.testing.assert_close(head(feats), trained_head(feats))
            continue
        for index, of_class in enumerate(names):
            if of_class in ORIGIN["classes"]:
                expected = trained_head(feats)[:, ORIGIN["classes"].index(of_class)]
                torch.testing.assert_close(head(feats)[:, index], expected)
            else:
                assert torch.equal(head[-1].weight[index], new[name][-1].weight[index])


def test_masks_that_are_not_as_many_as_the_classes_stay_as_they_are():
    """A head of three masks has no mask for each of four classes: its weights are loaded."""
    names = ["stop_line", "divider", "ped_crossing", "boundary"]
    head = {**small_config()["map_head"], "aux_heads": [{"type": "BEVMaskHead", "num_masks": 3}]}
    trained = build_small(0, map_head=head)
    model = build_small(1, classes=names, map_head=head)
    fit_classes(model, names, trained)
    weights = [built.map_head.aux_heads["seg"][-1].weight for built in (model, trained)]
    assert torch.equal(*weights)


def test_a_layer_at_several_places_is_reordered_at_each():
    """Decoder layers may share a branch, as here."""
    names = ["boundary", "divider", "ped_crossing"]
    trained, model = build_small(0), build_small(1, classes=names)
    for built in (trained, model):
        built.map_head.cls_branches[1] = built.map_head.cls_branches[0]
    fit_classes(model, names, trained)
    rows = trained.map_head.cls_branches[0][-1].weight[[2, 0, 1]]
    torch.testing.assert_close(model.map_head.cls_branches[1][-1].weight, rows)


def test_classes_of_a_head_of_another_form_are_said_to_stay():
    model = another_rig()
    state = {key: v for key, v in model.state_dict().items() if ".cls_branches." not in key}
    origin = METAINFO | {"classes": ("kerb", "divider", "boundary"), "cameras": Drive.cameras}
    (line,) = fit_start(state, model, Drive(), origin)
    assert line.startswith(
        "classes were kerb, divider, boundary, are boundary, divider, kerb: this"
    )


def test_a_start_that_fits_stays_as_it_is():
    model = another_rig()
    state = dict(model.state_dict())
    before = dict(state)
    assert fit_start(state, model, Drive(), METAINFO | {"cameras": Drive.cameras}) == []
    assert fit_start(state, model, Drive(), {}) == []  # nothing is known of it
    assert all(torch.equal(state[key], before[key]) for key in before)


def test_unknown_cameras_start_from_the_mean():
    state, model = dict(build_small(0).state_dict()), another_rig()
    embeds = state["bev_encoder.cams_embeds"]
    for cameras in (None, ["a", "b", "c", "d", "e", "f"]):
        fitted = dict(state)
        lines = fit_start(fitted, model, Drive(), {"cameras": cameras})
        assert lines[0].startswith("its cameras are not known")
        mean = embeds.mean(0).expand(2, -1)
        torch.testing.assert_close(fitted["bev_encoder.cams_embeds"], mean)


def test_what_a_checkpoint_says_of_its_origin_is_checked():
    assert training_facts("a.pth", None) == {}
    assert training_facts("a.pth", 3) == {}
    said = {"cameras": ["front", 3], "classes": 7, "frame": "ego", "x_range": ("a", 1.0)}
    assert training_facts("a.pth", said) == {"frame": "ego"}
    known = training_facts(find_checkpoint("gsmap_r18_minicity"), {})
    assert (known["frame"], known["x_range"]) == ("lidar", [-15.0, 15.0])
    assert known["cameras"] == list(NUSCENES)


def test_a_resumed_training_and_a_test_take_checkpoints_as_they_are():
    for resume, loop in ((True, object()), (False, None), (False, {})):
        runner = SimpleNamespace(_resume=resume, _train_loop=loop)
        RigFitHook().after_load_checkpoint(runner, {})  # else it would ask for the data


def test_queries_beyond_those_of_the_start_begin_as_new():
    model = build_small()
    key = "map_head.instance_embedding.weight"
    own = model.state_dict()[key].clone()
    state = {**model.state_dict(), key: own[:-2] + 5.0}
    lines = fit_start(state, model, Drive(), METAINFO | {"cameras": Drive.cameras})
    assert lines == [f"{len(own) - 2} queries keep their weights, 2 begin as new."]
    torch.testing.assert_close(state[key], torch.cat([own[:-2] + 5.0, own[-2:]]))
