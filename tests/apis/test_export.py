"""Exported models in ONNX Runtime: the same map elements as in torch."""

import json
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from export_cases import (
    POINTS_M,
    SCORES,
    SMALL,
    assert_static_frames_are_equal,
    compare,
    export,
    shake,
)
from fuzz.contents import exported_model
from method_cases import cases_of_methods
from model_cases import IMAGE_SHAPE, NUM_CAMS, build_small
from processes import run_python

from benchmarks.model import ring_of_cameras
from gsmap.apis.export import (
    ExportedDetector,
    export_onnx,
    graph_inputs,
    halve_onnx,
    largest_differences,
    quantize_onnx,
    signals_rule,
)
from gsmap.apis.map_inferencer import MapInferencer
from gsmap.apis.onnx_inferencer import OnnxInferencer
from gsmap.datasets.source import open_annotations
from gsmap.engine.launch import read_config
from gsmap.structures.elements import MapElements

for _package in ("onnx", "onnxscript", "onnxruntime"):
    pytest.importorskip(_package, reason=f"{_package} is not installed: pip install -e .[onnx]")

REPO = Path(__file__).resolve().parents[2]
GSMAP = "projects/GSMap/configs/gsmap_maptr_r18_minicity.py"
# Method and encoder: config and overrides. Heads see no more of an encoder than its features, and
# an export takes ten seconds, so that each encoder and each head comes once; the shipped GSMap
# has the encoder GKT.
CASES = {
    "GSMap, heights, unfolded and weighed": (
        GSMAP,
        {
            "model.map_head.reference": {"coords": 3, "z_range": (-5.0, 3.0)},
            "model.map_head.coder.unfold_classes": [0, 2],
            "model.map_head.coder.sigma_power": 1.0,
        },
    ),
}
for _method, _exports in cases_of_methods("EXPORTS").items():
    CASES |= {f"{_method}: {case}": export for case, export in _exports.items()}
# Of cases that another one exports in ONNX, the function of fixed sizes alone
STATIC_CASES = {
    f"{method}: {case}": frame
    for method, cases in cases_of_methods("STATIC_FRAMES").items()
    for case, frame in cases.items()
}
# of heads without MapTR's coder, of other necks; every line is found
SMALL_OF_CASE = {
    f"{method}: {case}": settings
    for method, cases in cases_of_methods("EXPORT_SIZES").items()
    for case, settings in cases.items()
}
CLASS_FACTORS = cases_of_methods("EXPORT_CLASS_FACTOR")


@pytest.fixture(scope="module")
def annotations(minicity_annotations):
    return minicity_annotations["val"]


@pytest.fixture(scope="module")
def shipped(annotations, tmp_path_factory):
    """The shipped GSMap as it predicts: in torch, its data set, and in ONNX Runtime."""
    checkpoint = REPO / "models/gsmap_r18_minicity.pth"
    inferencer = MapInferencer(REPO / GSMAP, checkpoint, "cpu")
    dataset = inferencer.dataset(annotations, annotations.parent)
    path = tmp_path_factory.mktemp("onnx") / "gsmap.onnx"
    return inferencer, dataset, export(inferencer, dataset, path)


@pytest.mark.parametrize("case", CASES)
def test_every_method_and_encoder_predicts_as_in_torch(case, annotations, tmp_path):
    config, overrides = CASES[case]
    small = SMALL_OF_CASE.get(case, SMALL)
    inferencer = MapInferencer(REPO / config, None, "cpu", {**small, **overrides})
    dataset = inferencer.dataset(annotations, annotations.parent)
    shake(inferencer.model)
    method = case.partition(":")[0]
    if method in CLASS_FACTORS:
        inferencer.model.map_head.cls_branch.weight.data *= CLASS_FACTORS[method]
    exported = export(inferencer, dataset, tmp_path / "model.onnx")
    (scores, metres), found, expected = compare(inferencer, dataset, exported)
    assert len(found) == len(expected) > 50
    assert scores < SCORES
    assert metres < POINTS_M
    pairs = zip(found.polylines, expected.polylines, strict=True)
    alike = [np.allclose(a, b, atol=POINTS_M) for a, b in pairs if a.shape == b.shape]
    assert np.mean(alike) > 0.9  # their points are in one order, too
    assert found.has_gaussians == config.startswith("projects/GSMap")
    (_, inputs), *_ = graph_inputs(exported, dataset, [0])
    inputs = looking_away(inputs)
    found = exported.run(inputs)
    with torch.no_grad():
        assert_static_frames_are_equal(inferencer, dataset)
        tensors = map(torch.from_numpy, inputs.values())
        scores, _, points, *_ = ExportedDetector(inferencer.model).eval()(*tensors)
    assert len(scores) > 50
    np.testing.assert_allclose(found["scores"], scores, atol=SCORES)
    np.testing.assert_allclose(found["points"], points, atol=POINTS_M)


@pytest.mark.parametrize("case", STATIC_CASES)
@torch.no_grad()
def test_static_frames_predict_as_the_model(case, annotations):
    config, overrides = STATIC_CASES[case]
    inferencer = MapInferencer(REPO / config, None, "cpu", {**SMALL, **overrides})
    shake(inferencer.model)
    dataset = inferencer.dataset(annotations, annotations.parent)
    assert_static_frames_are_equal(inferencer, dataset)


def looking_away(inputs):
    """Return the inputs of cameras that see no cell of the map."""
    far = np.eye(4, dtype=np.float32)
    far[:3, 3] = 1e4
    away = {
        "img_from_frame": np.zeros_like,  # no point is before the camera
        "frame_from_img": lambda matrices: far @ matrices,
        "ego_from_cam": lambda matrices: far @ matrices,
    }
    return {name: away.get(name, np.array)(array) for name, array in inputs.items()}


def test_the_shipped_model_predicts_as_in_torch(shipped):
    (scores, metres), found, expected = compare(*shipped)
    assert scores < SCORES
    assert metres < POINTS_M
    np.testing.assert_allclose(found.scales, expected.scales, atol=1e-3)
    np.testing.assert_allclose(found.rotations, expected.rotations, atol=1e-3)
    names = ("CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_FRONT_LEFT")
    assert shipped[2].cameras[:3] == names
    assert shipped[2].metadata["score_threshold"] is None


def test_cameras_of_other_names_are_assigned_by_direction(shipped, annotations):
    inferencer, dataset, exported = shipped
    source = open_annotations(annotations, annotations.parent)

    def inputs_of(cameras):
        samples = [replace(source.samples[0], cameras=cameras)]
        renamed = inferencer.dataset(replace(source, samples=samples))
        ((_, inputs),) = graph_inputs(exported, renamed, [0])
        return inputs

    cameras = [replace(c, name=f"my_{c.name}") for c in source.samples[0].cameras]
    ((_, expected),) = graph_inputs(exported, dataset, [0])
    for order in (cameras, cameras[::-1], cameras[3:] + cameras[:3]):
        for name, values in inputs_of(order).items():
            np.testing.assert_array_equal(values, expected[name])
    twice = [replace(cameras[0], name="twin"), *cameras[1:-1], cameras[0]]
    for rig in (twice, cameras[1:]):  # two of one direction, and one that is absent
        with pytest.raises(ValueError, match=r"takes the cameras CAM_FRONT, .*, my_CAM_.*: name"):
            inputs_of(rig)


def test_vehicle_signals_follow_one_rule(shipped):
    """A record's own values give what the data set's give, in the runner and in the bare graph."""
    _, dataset, exported = shipped
    ((_, wanted),) = graph_inputs(exported, dataset, [0])
    record = dataset.sample(0).can_bus
    assert record[:3].any()  # where the vehicle is, which the model must not see
    packed = dataset[0]
    images = packed["inputs"]["img"].permute(0, 2, 3, 1).numpy()
    meta = {**packed["data_samples"].metainfo, "can_bus": record}
    inputs = exported.prepare(images, meta)
    np.testing.assert_array_equal(inputs["can_bus"], wanted["can_bus"])
    scores = exported.run(wanted)["scores"]
    whole = {**wanted, "can_bus": record.astype(np.float32)}
    np.testing.assert_array_equal(exported.run(whole)["scores"], scores)
    without = {**wanted, "can_bus": np.zeros(18, np.float32)}
    assert not np.array_equal(exported.run(without)["scores"], scores)
    assert "entries 0 to 2 and 17 to zero" in exported.metadata["can_bus"]
    with pytest.raises(ValueError, match=r"needs can_bus, the 18 values .* From poses: motion_sig"):
        exported.prepare(images, {**meta, "can_bus": None})


def test_a_model_of_argoverse_2_says_that_its_signals_are_made_of_the_pose(shipped, monkeypatch):
    cfg = read_config("configs/maptr/maptr_r50_av2_6e.py")
    rule = signals_rule(SimpleNamespace(cfg=cfg))
    assert "pose_only_signals of gsmap.structures.vehicle_signals" in rule
    _, dataset, exported = shipped
    monkeypatch.setitem(exported.metadata, "can_bus", rule)
    packed = dataset[0]
    images = packed["inputs"]["img"].permute(0, 2, 3, 1).numpy()
    meta = {**packed["data_samples"].metainfo, "can_bus": None}
    with pytest.raises(ValueError, match=r"needs can_bus, .* pose_only_signals"):
        exported.prepare(images, meta)


def test_files_hold_standard_operators_and_no_word_of_the_machine(shipped):
    import onnx

    model = onnx.load(shipped[2].path)
    assert {node.domain for node in model.graph.node} == {""}
    assert not model.functions
    assert str(REPO).encode() not in Path(shipped[2].path).read_bytes()


def test_the_runner_needs_numpy_and_onnxruntime_alone(shipped, tmp_path):
    """A process without torch and OpenMMLab writes the records that torch's way writes."""
    inferencer, dataset, exported = shipped
    packed = dataset[0]
    images = packed["inputs"]["img"].permute(0, 2, 3, 1).numpy()
    meta = {key: packed["data_samples"].metainfo[key] for key in ("lidar2img", "can_bus")}
    np.savez(tmp_path / "in.npz", images=images, **meta)
    script = """
import sys
import numpy as np
from gsmap.apis.onnx_inferencer import OnnxInferencer
data = np.load("in.npz")
model = OnnxInferencer(sys.argv[1])
elements = model(list(data["images"]), data)
model.write("out.json", [("a", elements)])
others = {"torch", "mmengine", "mmcv", "mmdet", "mmdet3d", "cv2", "onnx", "pyarrow", "shapely"}
print(sorted(others & set(sys.modules)))
"""
    done = run_python("-c", script, exported.path, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[]"
    (expected,) = inferencer.predict(dataset, [0])
    vectors = inferencer.vectors(expected)
    (found,) = json.loads((tmp_path / "out.json").read_text())["results"]
    assert found["sample_token"] == "a"
    assert len(found["vectors"]) == len(vectors) > 0
    for mine, theirs in zip(found["vectors"], vectors, strict=True):
        assert mine.keys() == theirs.keys()
        assert mine["cls_name"] == theirs["cls_name"]
        np.testing.assert_allclose(mine["pts"], theirs["pts"], atol=POINTS_M)


def test_wrong_images_and_matrices_are_named(shipped):
    exported = shipped[2]
    rows, columns = exported.image_size
    images, matrices = [np.zeros((rows, columns, 3), np.uint8)] * 6, np.stack([np.eye(4)] * 6)
    with pytest.raises(ValueError, match=r"takes 6 cameras, CAM_FRONT, .* got 5 images: give one"):
        exported(images[:5], {"lidar2img": matrices})
    with pytest.raises(ValueError, match=r"of CAM_FRONT_RIGHT has shape \(4, 8, 3\): scale it"):
        exported([images[0], np.zeros((4, 8, 3)), *images[2:]], {"lidar2img": matrices})
    wide = np.full((rows, columns, 3), 40_000, np.uint16)
    for wrong, values in ((wide, "40000 to 40000"), (images[0] - 1.5, "-1.5 to -1.5")):
        with pytest.raises(ValueError, match=f"0 to 255, the image of CAM_FRONT has {values}: con"):
            exported([wrong, *images[1:]], {"lidar2img": matrices})
    calibration = {"lidar2img": matrices, "can_bus": np.zeros(18)}
    shares = [np.full((rows, columns, 3), level, np.float32) for level in (0.5, 1, 0, 0, 0.2, 0)]
    with pytest.raises(ValueError, match="have values up to 1: multiply them by 255"):
        exported.prepare(shares, calibration)
    exported.prepare([np.zeros_like(shares[0])] * 6, calibration)  # black images
    exported.prepare([*shares[:5], shares[0] * 200], calibration)
    white = np.full((900, 1600, 3), 255, np.float32)
    largest = cv2.resize(white, (704, 256), interpolation=cv2.INTER_AREA).max()
    assert largest > 255  # by rounding
    white = np.full((rows, columns, 3), largest)
    exported.prepare([white, torch.zeros(white.shape), *images[2:]], calibration)
    with pytest.raises(ValueError, match=r"img_from_frame .* each of its 6 cameras .*\(5, 4, 4\)"):
        exported(images, {"lidar2img": matrices[:5], "can_bus": np.zeros(18)})
    with pytest.raises(ValueError, match="has no 'lidar2img'"):
        exported(images, {"can_bus": np.zeros(18)})


def test_elements_beyond_the_margin_are_left_out(tmp_path):
    """The map ends at x = -15 and 15, y = -30 and 30 m; the margin is 5 m."""
    path = tmp_path / "model.onnx"
    path.write_bytes(exported_model())
    ends = [[0, 0], [-20, 0], [20, 0], [0, -35], [0, 35]]
    ends += [[-20.1, 0], [20.1, 0], [0, -35.1], [0, 35.1]]
    points = np.stack([np.zeros((9, 2)), ends], 1)
    outputs = {"points": points, "labels": np.zeros(9, int), "scores": np.linspace(0.9, 0.1, 9)}
    found = OnnxInferencer(path).elements(outputs)
    np.testing.assert_array_equal([line[1] for line in found.polylines], ends[:5])


def test_other_files_and_an_absent_package_are_named(small, tmp_path, monkeypatch):
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    with pytest.raises(FileNotFoundError, match=r"no ONNX file .*gone.onnx"):
        OnnxInferencer(tmp_path / "gone.onnx")
    value = helper.make_tensor_value_info("x", TensorProto.FLOAT, [1])
    graph = helper.make_graph([helper.make_node("Relu", ["x"], ["y"])], "other", [value], [value])
    graph.output[0].name = "y"
    path = tmp_path / "other.onnx"
    opset = [helper.make_opsetid("", 18)]
    onnx.save(helper.make_model(graph, ir_version=8, opset_imports=opset), path)
    with pytest.raises(ValueError, match=r"other.onnx does not say .* export the model again"):
        OnnxInferencer(path)
    path.write_bytes(b"no model")
    with pytest.raises(ValueError, match=r"other.onnx cannot be run by ONNX Runtime"):
        OnnxInferencer(path)
    model = onnx.load_from_string(exported_model())
    for text, message in (
        ("{", "JSONDecodeError"),
        ("[]", "TypeError"),
        (json.dumps({"format": 1}), "KeyError"),
        (model.metadata_props[0].value.replace('"left"', "7"), "cameras must be names"),
        (
            model.metadata_props[0].value.replace('["left", "right"]', '["left"]'),
            "its graph does not fit",
        ),
        (model.metadata_props[0].value.replace("-15.0", "15.0"), "x_range must be"),
        (model.metadata_props[0].value.replace(" 5.0,", ' "5",'), "TypeError"),
    ):
        model.metadata_props[0].value = text
        onnx.save(model, path)
        with pytest.raises(ValueError, match=f"other.onnx does not say .*{message}"):
            OnnxInferencer(path)
        model = onnx.load_from_string(exported_model())
    with pytest.raises(ValueError, match=r"small.onnx cannot be run \(.*export it again"):
        small.run({})
    cameras = np.zeros((2, 4, 6, 3), np.uint8), {"lidar2img": np.stack([np.eye(4)] * 2)}
    labels = numpy_helper.from_array(np.full(10, 3), "classes")
    model.graph.initializer[4].CopyFrom(labels)
    onnx.save(model, path)
    with pytest.raises(ValueError, match=r"other.onnx gave no map elements \(a label is none"):
        OnnxInferencer(path)(*cameras)
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(RuntimeError, match=r"onnxruntime is not installed: .*\[onnx\]"):
        OnnxInferencer(path)
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(RuntimeError, match=r"onnx is not installed: .*\[onnx\]"):
        export_onnx(build_small(), path, ["a"], (32, 32))


def test_an_operator_that_onnx_lacks_is_named(tmp_path):
    model = build_small()

    class Unknown(torch.nn.Module):
        def forward(self, feats):
            return [torch.special.bessel_j0(feats[0])]

    model.img_neck = Unknown()
    with pytest.raises(ValueError, match=r"cannot be written .*bessel_j0.*add a translation"):
        export_onnx(model, tmp_path / "model.onnx", ["a"] * 6, (64, 96))
    assert not list(tmp_path.iterdir())


def test_another_number_of_cameras_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"^the encoder is built for 6 cameras, got 5: set num_c"):
        export_onnx(build_small(), tmp_path / "model.onnx", ["a"] * 5, (64, 96))


def test_models_of_lidar_are_refused():
    model = build_small()
    model.lidar_encoder = torch.nn.Identity()
    with pytest.raises(ValueError, match="only models of cameras"):
        ExportedDetector(model)


@pytest.fixture(scope="module")
def small(small_onnx):
    """A tiny model in single precision."""
    return OnnxInferencer(small_onnx)


def small_inputs(exported, count=2):
    """Return random images of a ring of cameras."""
    generator = np.random.default_rng(0)
    images = generator.integers(0, 255, (count, 6, 64, 96, 3), dtype=np.uint8)
    lidar2img = ring_of_cameras(NUM_CAMS, *IMAGE_SHAPE)
    meta = {"lidar2img": lidar2img, "can_bus": np.zeros(18)}
    return [exported.prepare(each, meta) for each in images]


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_arrays_that_are_not_finite_are_named(small, value):
    images = np.zeros((6, 64, 96, 3))
    meta = {"lidar2img": ring_of_cameras(NUM_CAMS, *IMAGE_SHAPE), "can_bus": np.zeros(18)}
    small.prepare(images, meta)
    fields = {"img_from_frame": "lidar2img", "can_bus": "can_bus"}
    for name, field in fields.items():
        broken = meta[field].copy()
        broken[5] = value
        with pytest.raises(ValueError, match=f"^{name} of .* must be finite"):
            small.prepare(images, {**meta, field: broken})
    images[1, 2, 3] = value
    with pytest.raises(ValueError, match=r"^images of .* must be finite"):
        small.prepare(images, meta)


def test_a_file_of_a_model_that_was_trained_without_signals_uses_none(small_onnx, caplog):
    exported = OnnxInferencer(small_onnx, num_threads=1)
    images = np.zeros((6, 64, 96, 3), np.uint8)
    meta = {"lidar2img": ring_of_cameras(NUM_CAMS, *IMAGE_SHAPE), "can_bus": np.arange(18.0)}
    assert exported.prepare(images, meta)["can_bus"].any()
    exported.metadata["can_bus"] = signals_rule(SimpleNamespace(without_signals=True))
    for given in (meta["can_bus"], None, meta["can_bus"]):
        assert not exported.prepare(images, {**meta, "can_bus": given})["can_bus"].any()
    assert caplog.text.count("trained without vehicle signals; zeros are taken") == 1


def test_half_precision_and_8_bits_stay_close(small, tmp_path):
    import onnx

    exported = small
    inputs = small_inputs(exported)
    halve_onnx(exported.path, tmp_path / "fp16.onnx")
    quantize_onnx(exported.path, tmp_path / "int8.onnx", inputs)
    expected = exported.elements(exported.run(inputs[0]))
    plain = [node.op_type for node in onnx.load(exported.path).graph.node]
    for name, operator, tolerance in (("fp16", "Cast", 0.01), ("int8", "QuantizeLinear", 0.1)):
        other = OnnxInferencer(tmp_path / f"{name}.onnx")
        assert other.metadata == exported.metadata
        found = other.elements(other.run(inputs[0]))
        assert np.abs(np.sort(found.scores) - np.sort(expected.scores)).max() < tolerance
        graph = onnx.load(other.path).graph
        assert [node.op_type for node in graph.node].count(operator) > plain.count(operator)
        assert {node.domain for node in graph.node} == {""}


def test_elements_beyond_the_margin_or_below_the_threshold_are_dropped(small):
    exported = OnnxInferencer(small.path)
    points = np.zeros((3, 4, 2))
    points[1, 0] = 15.0 + 5.1, 0  # the map ends at 15 m, its margin at 20
    outputs = {
        "scores": np.array([0.9, 0.8, 0.2]),
        "labels": np.array([0, 1, 2]),
        "points": points,
    }
    assert exported.elements(outputs).labels.tolist() == [0, 2]
    exported.metadata["score_threshold"] = 0.5
    assert exported.elements(outputs).labels.tolist() == [0]
    exported.metadata["margin_m"] = None
    assert exported.elements(outputs).labels.tolist() == [0, 1]


def test_differences_are_of_the_nearest_element_of_a_class():
    def elements(xs, labels, scores):
        return MapElements.from_polylines([[(x, 0), (x, 1)] for x in xs], labels, scores)

    a = elements([0, 5, 9], [0, 0, 1], [0.5, 0.5, 0.4])
    b = elements([5.25, 0, 9], [0, 0, 1], [0.5, 0.5, 0.375])
    assert largest_differences(a, b) == pytest.approx((0.025, 0.25))
    assert largest_differences(a, elements([0], [0], [0.5])) == (np.inf, np.inf)
    turned = MapElements.from_polylines(
        [line[::-1] for line in a.polylines], a.labels, a.confidence
    )
    assert largest_differences(a, turned) == (0, 1)
    assert largest_differences(a, turned, unfolded=[0]) == (0, 1)  # that of class 1
    assert largest_differences(a, turned, unfolded=[0, 1]) == (0, 0)


def test_a_file_without_memory_takes_no_stream(small):
    with pytest.raises(ValueError, match="has no memory: leave the stream out"):
        small.new_stream()
