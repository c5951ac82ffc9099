"""BeMapNet: the whole model, from images to lines."""

from collections.abc import Iterator

import numpy as np
import torch
from methods.bemapnet.reference import CONFIG, GRID, IMAGE, KEYS, BezierParts, ground_matrices
from mmdet3d.registry import MODELS
from mmengine.config import Config
from reference.golden import Golden
from reference.registry import check
from reference.report import Row, largest_difference
from scipy.ndimage import binary_dilation
from torch import nn

from gsmap.models.bemapnet.head import BezierHead
from gsmap.models.lines.head import LinePredictions
from gsmap.models.lines.targets import draw_lines

IMAGE_SIZE, FRAME = (128, 256), (171, 256)  # of the images, and before they were cropped
ENDS = [0, -1]  # the layers that the file has
LOGITS, CURVES = 2e-3, 1e-3


def released_model(parts: BezierParts) -> nn.Module:
    """Return the released model for the file's images; its map is in the frame of the vehicle."""
    path = parts.golden.configs / CONFIG
    cfg = Config.fromfile(path, import_custom_modules=False).model
    cfg.img_backbone.init_cfg = None
    cfg.img_neck.size = (7, 14)
    cfg.bev_encoder.position_size = FRAME
    cfg.grid = {"x_range": GRID.x_range, "y_range": GRID.y_range}
    return parts.load(MODELS.build(cfg), "")


@check("bemapnet_forward_reduced_{variant}.npz")
@torch.no_grad()
def check_forward(golden: Golden, name: str) -> Iterator[Row]:
    """Compare the way from images to the lines."""
    data = golden.read_arrays(name)
    parts = BezierParts(golden)
    model = released_model(parts)
    head = model.map_head
    images = torch.from_numpy(parts.recipe.images(*IMAGE_SIZE, 6, golden.seed))
    feats = model.img_backbone(images)
    (neck,) = model.img_neck(feats)
    calibration = {"ground_from_img": ground_matrices(golden, IMAGE)}
    bev = model.bev_encoder.encode(neck[None], calibration, FRAME)
    front = torch.cat([head.front(level) for level in bev["bev_levels"]])
    states = head.decoder(front[-1:])[1:]
    semantic = head.class_masks(bev["bev_feats"])[0]
    lines_of_layers = [lines for (lines,) in states]  # of all classes together
    last_lines = [lines_of_layers[i] for i in ENDS]
    subsets = {
        "bkb3": (feats[2][:, ::128], 5e-4),
        "neck_sub": (neck[:, ::40], 5e-4),
        "bev_sub": (front[:, ::64, ::8, ::4], 1e-4),
        "obj": (torch.cat([lines.logits for lines in lines_of_layers]), LOGITS),
        "dec_sub": (torch.cat([lines.states for lines in lines_of_layers])[:, ::5, 0, ::8], LOGITS),
        "masks_sub": (torch.cat([lines.masks for lines in last_lines])[:, ::10, ::10, ::5], LOGITS),
    }
    for key, (value, tolerance) in subsets.items():
        yield Row(name, key, largest_difference(value, data[key]), tolerance)
    mean = head.coordinate_feature()
    states_by_class = []  # for each layer, the states of each class
    for lines in last_lines:
        states_by_class.append(lines.states[:, :, 0].split(list(head.queries), 1))
    last = head.predictions(states[-1], mean)
    for label, lines in enumerate(last.lines):
        raw = [head.curve_logits(label, own[label], mean) for own in states_by_class]
        for index, key in enumerate(KEYS):
            value = torch.cat([logits[index] for logits in raw])
            off = largest_difference(value, data[f"{key}{label}"])
            yield Row(name, f"{key}{label}", off, LOGITS)
        ours = {
            "ctr": (lines.controls[0], CURVES),
            "curve": (lines.curves[0, :, ::11], CURVES),
        }
        for key, (value, tolerance) in ours.items():
            off = largest_difference(value, data[f"{key}{label}"])
            yield Row(name, f"{key}{label}", off, tolerance)
        off = largest_difference(semantic[label, ::20, ::10], data[f"sem{label}"][1])
        yield Row(name, f"sem{label}, the channel that is used", off, LOGITS)
    yield from kept_rows(name, head, last, data)


def kept_rows(
    name: str, head: BezierHead, output: LinePredictions, data: dict[str, np.ndarray]
) -> Iterator[Row]:
    """Compare the lines that are kept, in the file's order: by class and query."""
    (result,) = head.predict_by_feat([output], [{}])
    best = head.coder.decode(output.scores[0], result.pts)
    order = best.query_inds.argsort().numpy()
    labels = result.labels_3d.numpy()[order]
    # the file begins with a placeholder
    yield Row(name, "kept classes", largest_difference(labels + 1, data["keep_labels"][1:]), 0)
    scores = result.scores_3d.numpy()[order]
    yield Row(name, "kept scores", largest_difference(scores, data["keep_scores"][1:]), LOGITS)
    lines = head.grid.front_from_metres(result.pts).numpy()[order]
    masks = draw_lines(lines, head.mask_size, 1)
    found = np.stack([masks[labels == label].any(0) for label in range(3)])
    wanted = np.unpackbits(data["drawn"]).reshape(found.shape).astype(bool)
    # versions of OpenCV draw lines of one pixel differently
    near_found = binary_dilation(found, np.ones((1, 3, 3)))
    near_wanted = binary_dilation(wanted, np.ones((1, 3, 3)))
    far = (found & ~near_wanted).sum() + (wanted & ~near_found).sum()
    yield Row(name, "drawn pixels that are more than one off", far, 0)
