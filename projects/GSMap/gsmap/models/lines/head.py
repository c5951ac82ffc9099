"""Base class of heads with separate line queries for each map class."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from mmdet3d.structures import Det3DDataSample
from mmengine.structures import InstanceData
from torch import Tensor, nn

from gsmap.models.base.coder import DetectionHead, MapCoder, Samples, Tensors
from gsmap.models.base.layers import resize_map
from gsmap.models.base.parts import PartConfig, build_part
from gsmap.models.lines.front import front_size, turn_raster
from gsmap.models.lines.losses import LINE, Case, LineLosses
from gsmap.structures.grid import BEVGrid
from gsmap.structures.tensors import tensor_versions
from gsmap.utils.errors import InputError

# Weights of the losses of the decoder layers. A decoder with fewer layers uses the last ones.
LAYER_WEIGHTS = (0.4, 0.4, 0.4, 0.8, 1.2, 1.6)


class LinePredictions(NamedTuple):
    """Predictions of the head after one decoder layer.

    Attributes:
        scores: Logits of the classes, -inf except for the class of the query. N is the number of
            line queries of all classes together. (B, N, classes)
        references: Points of each line. The ``reference`` of the head decodes them to metres. They
            are coordinates in [0, 1] over the map (B, N, P, 2), or coordinates and a logit by which
            the decoding selects points (B, N, P, 3).
        lines: Lines of every class, each a NamedTuple of tensors (B, n, ...) with ``logits`` and
            ``masks``. n is the number of queries of the class.
    """

    scores: Tensor
    references: Tensor
    lines: list[Any]


def class_scores(logits: Sequence[Tensor]) -> Tensor:
    """Class logits of all queries, from the logits of the lines of every class.

    A class logit is the logit of a line minus the logit of no line. Its sigmoid is therefore the
    probability of a line in the softmax of the two logits.

    Args:
        logits: Logits of a line and of no line, for every class. (B, n, 2) each

    Returns:
        Differences of the two logits at the class of each query, -inf elsewhere. (B, N, classes)
    """
    scores = []
    no_line = 1 - LINE  # index of the other logit
    for label, class_logits in enumerate(logits):
        score = class_logits[..., LINE, None] - class_logits[..., no_line, None]
        padding = (label, len(logits) - 1 - label)  # classes before and after this one
        scores.append(F.pad(score, padding, value=-torch.inf))
    return torch.cat(scores, dim=1)


class LineHead(DetectionHead):
    """Head of lines with masks, with separate queries for each class.

    Args:
        grid: Extent of the map.
        classes: Names of the classes.
        numbers: Number of line queries of each class. Their sum is the largest number of
            detections. ``decoder`` must contain the queries, too.
        decoder: Settings of `PointLineDecoder`.
        losses: Costs and losses of the lines of one class, and weights of the losses.
        mask_pixel_m: Side of a pixel in metres, in the masks of lines and classes in training and
            in their targets. A class mask is the union of the masks of all lines of a class.
        score_threshold: Detections need a higher score. With 0.5, a line must be more likely than
            no line.
        embed_dims: Channels C.
        hidden_dims: Hidden channels of the network of map coordinates.
        point_dims: Channels D of the feature of a map coordinate (x, y).
        init_cfg: Initialisation config of mmengine.

    Attributes:
        targets: Description of the targets that the transform in the training pipeline makes, for
            error messages. The class attribute ``transforms`` names this transform.
        level_weights: Weights of the class masks of the BEV levels, the BEV features after each
            layer of the encoder. With fewer levels, the last weights are used.

    Raises:
        ValueError: If the decoder has no layer or more than ``LAYER_WEIGHTS``.
    """

    targets: str
    level_weights: Sequence[float]

    def __init__(
        self,
        grid: BEVGrid,
        classes: Sequence[str],
        numbers: Sequence[int],
        decoder: PartConfig,
        losses: LineLosses,
        mask_pixel_m: float = 0.15,
        score_threshold: float = 0.5,
        embed_dims: int = 256,
        hidden_dims: int = 256,
        point_dims: int = 64,
        init_cfg: dict | None = None,
    ) -> None:
        super().__init__(init_cfg)
        self.grid = grid
        self.classes = tuple(classes)
        self.losses = losses
        # Rows (along the direction of travel) and columns of the masks.
        self.mask_size = front_size(grid.rasterized(mask_pixel_m))
        self.point_dims = point_dims
        self.decoder = build_part(decoder, type="PointLineDecoder", embed_dims=embed_dims)
        num_layers = len(self.decoder.layers)
        if not 0 < num_layers <= len(LAYER_WEIGHTS):
            raise InputError(
                f"decoder.num_layers must be 1 to {len(LAYER_WEIGHTS)}, as the losses have weights "
                f"for {len(LAYER_WEIGHTS)} layers, got {num_layers}."
            )
        self.layer_weights = LAYER_WEIGHTS[-num_layers:]
        # The coder selects detections by their scores. With `margin_m=None`, lines are kept however
        # far they reach beyond the map.
        self.coder = MapCoder(
            grid, max_num=sum(numbers), margin_m=None, score_threshold=score_threshold
        )
        self.semantic_branches = nn.ModuleList()  # predict the class masks
        for _ in classes:
            self.semantic_branches.append(nn.Conv2d(embed_dims, 2, kernel_size=1))
        self.coordinates = nn.Sequential(
            nn.Conv2d(2, hidden_dims, kernel_size=1),
            nn.ReLU(),
            nn.Conv2d(hidden_dims, hidden_dims, kernel_size=1),
            nn.ReLU(),
            nn.Conv2d(hidden_dims, point_dims, kernel_size=1),
        )
        # Versions of the weights of `coordinates`, and the result of `coordinate_feature` for them.
        self._cache: tuple[Any, Tensor] | None = None

    @classmethod
    def target_settings(cls, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Settings of the transform of targets that follow from the settings of the head.

        When a config is read, they are copied to the transform, so that the masks of both have one
        size.

        Args:
            settings: Settings of the head.
        """
        return {"pixel_m": settings["mask_pixel_m"]}

    def forward(self, bev_outputs: Tensors) -> list[LinePredictions]:
        """Predict the lines after every decoder layer.

        Args:
            bev_outputs: Outputs of the encoder, with ``bev_feats`` (B, C, H, W).
        """
        outputs = self.decoder(self.front(bev_outputs["bev_feats"]))
        layers = outputs[1:]  # the first output is computed from the queries before all layers
        mean = self.coordinate_feature()
        return [self.predictions(layer, mean) for layer in layers]

    def predictions(self, layer: Sequence[Any], mean: Tensor) -> LinePredictions:
        """Lines and scores of one decoder layer. Subclasses implement this method.

        Args:
            layer: Lines of every class from the decoder (`ClassLines`): states of the points,
                logits and masks.
            mean: Result of `coordinate_feature`. (D,)
        """
        raise NotImplementedError

    @staticmethod
    def coordinates_of(feature: Tensor, mean: Tensor) -> Tensor:
        """Logits of coordinates, in float32 even in mixed precision.

        In half precision, coordinates on an axis of 60 m would be multiples of 0.2 m.

        Args:
            feature: Outputs of a branch for each coordinate. (..., D)
            mean: Result of `coordinate_feature`. (D,)

        Returns:
            Scalar products. (...)
        """
        with torch.autocast(feature.device.type, enabled=False):
            return feature.float() @ mean.float()

    def coordinate_feature(self) -> Tensor:
        """Mean over the map of the features of its coordinates, cached in inference. (D,)

        Differs from the papers of the subclasses, as in their released code: the point
        branches multiply their outputs by this mean instead of the features of single cells.
        """
        # In inference, the cached mean is valid while the versions of the weights do not change.
        # In training, the mean is always computed, and the cache is cleared: fused optimizers
        # change weights without a new version. Compiled code computes it, too.
        if torch.is_grad_enabled() or torch.compiler.is_compiling():
            self._cache = None
            return self._mean_feature()
        versions = tensor_versions(self.coordinates)
        if self._cache is None or self._cache[0] != versions:
            self._cache = (versions, self._mean_feature())
        return self._cache[1]

    def _mean_feature(self) -> Tensor:
        """Mean over the map of the features of its coordinates, always in float32. (D,)"""
        device = self.decoder.query.weight.device
        height, width = self.mask_size
        rows = torch.arange(height, device=device) / height
        cols = torch.arange(width, device=device) / width
        points = torch.stack(torch.meshgrid(cols, rows, indexing="xy"))  # (2, H, W), in [0, 1)
        with torch.autocast(device.type, enabled=False):
            # The last convolution is linear, so it may follow the mean.
            hidden = self.coordinates[:-1](points[None]).mean((2, 3), keepdim=True)
            return self.coordinates[-1](hidden).flatten().float()

    def loss(self, bev_outputs: Tensors, batch_data_samples: Samples) -> Tensors:
        """Losses by name, summed over the layers.

        Args:
            bev_outputs: Outputs of the encoder, with ``bev_feats`` (B, C, H, W), and from some
                encoders ``bev_levels``, the features after each of their layers.
            batch_data_samples: Samples with the targets of the transform.
        """
        outputs = self(bev_outputs)
        feats = bev_outputs["bev_feats"]
        tokens = [str(sample.metainfo.get("token")) for sample in batch_data_samples]
        with torch.autocast(feats.device.type, enabled=False):
            truths = [self.truth(sample) for sample in batch_data_samples]
            line_losses, _ = self.line_losses(outputs, truths, tokens=tokens)
            # Without levels, the BEV features are the only level.
            mask_levels = []
            for level in bev_outputs.get("bev_levels", [feats]):
                mask_levels.append(self.class_masks(level))
            semantic_loss = self.semantic_loss(mask_levels, truths)
        losses = {f"loss_{name}": value for name, value in line_losses.items()}
        losses["loss_semantic"] = semantic_loss
        return losses

    def line_targets(self, sample: Det3DDataSample) -> InstanceData:
        """Targets of a sample.

        Args:
            sample: Sample with the targets of the transform.

        Raises:
            ValueError: If the targets come from another transform, or have another mask size.
        """
        instances = sample.get("gt_instances_3d", InstanceData())
        transform = self.transforms[0]
        if "num_pts" not in instances or "masks" not in instances:
            raise InputError(
                f"sample {sample.metainfo.get('token')!r} has no {self.targets}: replace "
                f"FormatMapTargets in the training pipeline by {transform}."
            )
        mask_size = tuple(instances.masks.shape[1:])
        if mask_size != self.mask_size:
            raise InputError(
                f"masks of {transform} are {mask_size}, the head's {self.mask_size}: set pixel_m "
                "there to the head's mask_pixel_m."
            )
        return instances

    def truth(self, sample: Det3DDataSample) -> list[Any]:
        """Annotated lines of a sample for every class, from its `line_targets`.

        Subclasses implement this method. The lines of a class are an object with ``masks``
        (K, H, W), where K is the number of annotated lines.
        """
        raise NotImplementedError

    def cases(self, lines: Any, truths: Sequence[Any], tokens: Sequence[str]) -> Iterator[Case]:
        """Yield a case, the predicted and annotated lines of a class, for each sample.

        Args:
            lines: Lines of one layer and class, a NamedTuple of tensors (B, n, ...).
            truths: Annotated lines of the class in each sample, K lines.
            tokens: Token of each sample.
        """
        lines = lines._replace(masks=self.resize_masks(lines.masks))
        truth_masks = [truth.masks for truth in truths]
        distances = self.losses.distances(lines.masks, truth_masks)  # (n, K) for each sample
        for index, token in enumerate(tokens):
            # `lines` with the tensors of this sample, (n, ...).
            sample_lines = lines._make(tensor[index] for tensor in lines)
            yield Case(
                sample_lines, truth=truths[index], mask_distances=distances[index], token=token
            )

    def semantic_loss(self, levels: Sequence[Tensor], truths: Sequence[Sequence[Any]]) -> Tensor:
        """Weighted loss of the class masks.

        Args:
            levels: Logits of the class masks of each BEV level. (B, classes, H, W) each
            truths: Annotated lines of each sample, for every class.

        Raises:
            ValueError: If there are more levels than ``level_weights``.
        """
        if len(levels) > len(self.level_weights):
            raise InputError(
                f"the BEV encoder returns a level for each of its {len(levels)} layers, but "
                f"{type(self).__name__} has weights for {len(self.level_weights)} levels: give the "
                "encoder fewer layers."
            )
        targets = []
        for label in range(len(self.classes)):
            masks = []
            for truth in truths:
                masks.append(truth[label].masks.sum(0).clamp(max=1))  # union of all lines
            targets.append(torch.stack(masks))  # (B, H, W)
        terms = []
        level_weights = self.level_weights[-len(levels) :]
        for level_weight, level in zip(level_weights, levels, strict=True):
            for label, target in enumerate(targets):
                losses = self.losses.mask_losses(level[:, label], target)
                terms.append(level_weight * losses.mean())
        semantic_weight = self.losses.semantic
        return semantic_weight * torch.stack(terms).sum() / len(levels)

    def line_losses(
        self,
        outputs: Sequence[LinePredictions],
        truths: Sequence[Sequence[Any]],
        tokens: Sequence[str],
    ) -> tuple[Tensors, list[list[Any]]]:
        """Match all lines, and compute the losses of all layers and classes.

        Losses are summed with the weights of the layers and divided by the number of layers times
        the number of classes.

        Args:
            outputs: Predictions of each layer.
            truths: Annotated lines of each sample, for every class.
            tokens: Token of each sample.

        Returns:
            Losses by name; and the matches of each layer and class, with one entry per sample.
        """
        groups: list[list[Case]] = []  # for each layer and class, its cases of all samples
        cases: list[Case] = []  # the cases of all groups, one group after another
        weights: list[float] = []
        num_groups = len(outputs) * len(self.classes)
        for layer, layer_weight in zip(outputs, self.layer_weights, strict=True):
            for label, lines in enumerate(layer.lines):
                class_truths = [truth[label] for truth in truths]
                group = list(self.cases(lines, class_truths, tokens=tokens))
                groups.append(group)
                cases.extend(group)
                weights.append(layer_weight / num_groups)
        # All cases are matched at once, because each call of `match` waits for the device. The
        # result has the matches of each case, in the order of the cases. The loop below takes the
        # matches of one group after another from its start.
        remaining_matches = self.losses.match(cases)
        totals: Tensors = {}
        matches = []
        for weight, group in zip(weights, groups, strict=True):
            group_matches = remaining_matches[: len(group)]
            remaining_matches = remaining_matches[len(group) :]
            for name, value in self.losses(group, group_matches).items():
                totals[name] = totals.get(name, 0) + weight * value
            matches.append(group_matches)
        return totals, matches

    def class_masks(self, bev_feats: Tensor) -> Tensor:
        """Logits of the class masks. (B, C, H, W) -> (B, classes, rows, columns)"""
        front = self.front(bev_feats)
        # Each class has two channels, as in the released weights. The released code trains only the
        # second one, and the first one is not used.
        logits = [branch(front)[:, 1:] for branch in self.semantic_branches]
        return self.resize_masks(torch.cat(logits, dim=1))

    def front(self, bev_feats: Tensor) -> Tensor:
        """BEV features with row 0 at the front, the input of the decoder. (B, C, H, W)"""
        return turn_raster(bev_feats, self.grid)

    def resize_masks(self, masks: Tensor) -> Tensor:
        """Resize n masks, of lines or classes, to the size of the targets.

        (B, n, h, w) -> (B, n, H, W), where H and W are the rows and columns of ``mask_size``.
        """
        return resize_map(masks.float(), self.mask_size)
