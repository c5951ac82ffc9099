"""A head of lines whose classes have queries of their own: scores, masks, losses."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from mmdet3d.registry import MODELS
from mmdet3d.structures import Det3DDataSample
from mmengine.structures import InstanceData
from torch import Tensor, nn

from gsmap.models.base.coder import DetectionHead, MapCoder, Samples, Tensors
from gsmap.models.base.layers import enlarged
from gsmap.models.base.parts import PARTS
from gsmap.models.lines.front import front_size, turned
from gsmap.models.lines.losses import LINE, Case, LineLosses
from gsmap.structures.grid import BEVGrid
from gsmap.structures.tensors import tensor_versions
from gsmap.utils.errors import InputError

# of the losses of decoder layers; of fewer, the last ones
LAYER_WEIGHTS = (0.4, 0.4, 0.4, 0.8, 1.2, 1.6)


class LinePredictions(NamedTuple):
    """What the head says after a layer."""

    scores: Tensor  # logits, -inf but for a query's own class (B, N, classes)
    references: Tensor  # points of each line (B, N, P, D)
    lines: list[Any]  # by class, a tuple of (B, n, ...), among them ``logits`` and ``masks``


def class_scores(logits: Sequence[Tensor]) -> Tensor:
    """Join what is said of each class's lines (B, n, 2): logits, -inf but for their own class.

    (B, N, classes)
    """
    scores = [
        F.pad(
            own[..., LINE, None] - own[..., 1 - LINE, None],
            (label, len(logits) - 1 - label),
            value=-torch.inf,
        )
        for label, own in enumerate(logits)
    ]
    return torch.cat(scores, 1)


class LineHead(DetectionHead):
    """A head of lines by class, with masks.

    Args:
        grid: The map's extent.
        classes: Names of the classes.
        numbers: Lines of each class.
        decoder: Settings of `PointLineDecoder`; ValueError if there are more layers than weights.
        losses: The losses of one class.
        mask_pixel_m: Side of a pixel of the losses' masks in metres; the targets take it.
        score_threshold: Lines of at most this score are dropped: 0.5 as long as there are just
            lines and none.
        embed_dims: Channels C.
        hidden_dims: Hidden channels of the map's coordinates.
        point_dims: Channels of each coordinate of a point.
    """

    targets: str  # what the transform adds, in words
    level_weights: Sequence[float]  # of the class masks of BEV levels; of fewer, the last ones

    def __init__(
        self,
        grid: BEVGrid,
        classes: Sequence[str],
        numbers: Sequence[int],
        decoder: PARTS,
        losses: LineLosses,
        mask_pixel_m: float = 0.15,
        score_threshold: float = 0.5,
        embed_dims: int = 256,
        hidden_dims: int = 256,
        point_dims: int = 64,
        init_cfg: dict | None = None,
    ) -> None:
        super().__init__(init_cfg)
        self.grid, self.classes, self.losses = grid, tuple(classes), losses
        self.mask_size, self.point_dims = front_size(grid.rasterized(mask_pixel_m)), point_dims
        settings = {"type": "PointLineDecoder", "embed_dims": embed_dims}
        self.decoder = MODELS.build(settings | decoder)
        num_layers = len(self.decoder.layers)
        if not 0 < num_layers <= len(LAYER_WEIGHTS):
            raise InputError(
                f"decoder.num_layers must be 1 to {len(LAYER_WEIGHTS)}, which have weights in the "
                f"losses, got {num_layers}."
            )
        self.layer_weights = LAYER_WEIGHTS[-num_layers:]
        self.coder = MapCoder(grid, sum(numbers), None, score_threshold)
        self.semantic_branches = nn.ModuleList(nn.Conv2d(embed_dims, 2, 1) for _ in classes)
        dims = (2, hidden_dims), (hidden_dims, hidden_dims), (hidden_dims, point_dims)
        convs = [nn.Conv2d(*pair, 1) for pair in dims]
        self.coordinates = nn.Sequential(convs[0], nn.ReLU(), convs[1], nn.ReLU(), convs[2])
        self._kept: tuple[Any, Tensor] | None = None  # state of the weights, their feature

    @classmethod
    def target_settings(cls, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Return the settings of the transform that follow from those of the head."""
        return {"pixel_m": settings["mask_pixel_m"]}

    def forward(self, bev_outputs: Tensors) -> list[LinePredictions]:
        """Predict the lines after every decoder layer, from ``bev_feats`` (B, C, H, W)."""
        layers = self.decoder(self.front(bev_outputs["bev_feats"]))[1:]
        mean = self.coordinate_feature()
        return [self.predictions(layer, mean) for layer in layers]

    def predictions(self, layer: Sequence[Any], mean: Tensor) -> LinePredictions:
        """Return the lines and scores of what the decoder says after a layer."""
        raise NotImplementedError

    def coordinate_feature(self) -> Tensor:
        """Return the mean of the coordinates' features over the map, kept in inference. (D,)

        Differs from the paper, as released: points see the map's coordinates through this mean.
        """
        if torch.is_grad_enabled() or torch.compiler.is_compiling():
            self._kept = None  # fused optimizers change weights without a new version
            return self._mean_feature()
        state = tensor_versions(self.coordinates)
        if self._kept is None or self._kept[0] != state:
            self._kept = state, self._mean_feature()
        return self._kept[1]

    def _mean_feature(self) -> Tensor:
        """Return the mean of the coordinates' features over the map. (D,)"""
        device = self.decoder.query.weight.device
        rows, cols = (torch.arange(n, device=device) / n for n in self.mask_size)
        places = torch.stack(torch.meshgrid(cols, rows, indexing="xy"))  # (2, H, W)
        hidden = self.coordinates[:-1](places[None]).mean((2, 3), keepdim=True)
        return self.coordinates[-1](hidden).flatten().float()

    def loss(self, bev_outputs: Tensors, batch_data_samples: Samples) -> Tensors:
        """Run the head and return its losses, sums of all layers."""
        outputs, feats = self(bev_outputs), bev_outputs["bev_feats"]
        tokens = [str(sample.metainfo.get("token")) for sample in batch_data_samples]
        with torch.autocast(feats.device.type, enabled=False):
            truths = [self.truth(sample) for sample in batch_data_samples]
            losses, _ = self.line_losses(outputs, truths, tokens)
            levels = [self.class_masks(level) for level in bev_outputs.get("bev_levels", [feats])]
            losses["semantic"] = self.semantic_loss(levels, truths)
        return {f"loss_{name}": value for name, value in losses.items()}

    def annotated(self, sample: Det3DDataSample) -> InstanceData:
        """Return a sample's annotated lines; ValueError if they are not of this head."""
        instances, transform = sample.get("gt_instances_3d", InstanceData()), self.transforms[0]
        if "num_pts" not in instances or "masks" not in instances:
            raise InputError(
                f"sample {sample.metainfo.get('token')!r} has no {self.targets}: put {transform} "
                "in place of FormatMapTargets into the training pipeline."
            )
        found = tuple(instances.masks.shape[1:])
        if found != self.mask_size:
            raise InputError(
                f"masks of {transform} are {found}, the head's {self.mask_size}: set pixel_m there "
                "to the head's mask_pixel_m."
            )
        return instances

    def truth(self, sample: Det3DDataSample) -> list[Any]:
        """Return a sample's annotated lines, by class; ValueError if they are not of this head."""
        raise NotImplementedError

    def cases(self, lines: Any, truths: Sequence[Any], tokens: Sequence[str]) -> Iterator[Case]:
        """Yield a layer's lines of a class by sample, with what is annotated."""
        lines = lines._replace(masks=self.enlarged(lines.masks))
        apart = self.losses.distances(lines.masks, [truth.masks for truth in truths])
        for own, *further in zip(zip(*lines, strict=True), truths, apart, tokens, strict=True):
            yield Case(type(lines)(*own), *further)

    def semantic_loss(self, levels: Sequence[Tensor], truths: Sequence[Sequence[Any]]) -> Tensor:
        """Return the loss of the class masks of all BEV levels (B, classes, H, W).

        ValueError if there are more levels than weights.
        """
        if len(levels) > len(self.level_weights):
            raise InputError(
                f"the BEV encoder returns {len(levels)} levels, but {type(self).__name__} has "
                f"weights for the class masks of {len(self.level_weights)}: give the encoder fewer "
                "layers."
            )
        drawn = [torch.stack([own.masks.sum(0).clamp(max=1) for own in truth]) for truth in truths]
        by_class = torch.stack(drawn, 1)  # (classes, B, H, W)
        terms = [
            weight * self.losses.mask_losses(masks, own).mean()
            for weight, level in zip(self.level_weights[-len(levels) :], levels, strict=True)
            for masks, own in zip(level.transpose(0, 1), by_class, strict=True)
        ]
        return self.losses.semantic * torch.stack(terms).sum() / len(levels)

    def line_losses(
        self,
        outputs: Sequence[LinePredictions],
        truths: Sequence[Sequence[Any]],
        tokens: Sequence[str],
    ) -> tuple[Tensors, list[list[Any]]]:
        """Return the losses of all layers and classes, and the pairs of each and every sample."""
        groups = [
            list(self.cases(lines, [truth[label] for truth in truths], tokens))
            for layer in outputs
            for label, lines in enumerate(layer.lines)
        ]
        pairs = iter(self.losses.match([case for group in groups for case in group]))
        matches = [[next(pairs) for _ in group] for group in groups]
        totals: Tensors = {}
        weights = [w / len(groups) for w in self.layer_weights for _ in self.classes]
        for weight, group, matched in zip(weights, groups, matches, strict=True):
            for name, value in self.losses(group, matched).items():
                totals[name] = totals.get(name, 0) + weight * value
        return totals, matches

    def class_masks(self, bev_feats: Tensor) -> Tensor:
        """Return the logits of the classes' masks. (B, C, H, W) -> (B, classes, rows, columns)"""
        front = self.front(bev_feats)
        # of the two channels of each class, the release trains the second alone
        return self.enlarged(torch.cat([conv(front)[:, 1:] for conv in self.semantic_branches], 1))

    def front(self, bev_feats: Tensor) -> Tensor:
        """Return BEV features from the front, as the decoder reads them. (B, C, H, W)"""
        return turned(bev_feats, self.grid)

    def enlarged(self, masks: Tensor) -> Tensor:
        """Enlarge masks to the size of the targets. (B, n, h, w) -> (B, n, H, W)"""
        return enlarged(masks.float(), self.mask_size)
