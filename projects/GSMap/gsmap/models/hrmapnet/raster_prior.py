"""Raster prior of a detector: a map of its earlier predictions, which it reads and updates."""

import logging
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import torch
import torch.nn.functional as F
from mmdet.models.layers import LearnedPositionalEncoding
from mmdet3d.registry import MODELS
from mmengine.dist import get_world_size
from mmengine.logging import print_log
from torch import Tensor

from gsmap.checkpoints.class_axes import mark_classes
from gsmap.checkpoints.strict import AddsWeights
from gsmap.models.base.parts import DEFAULTS, build_part
from gsmap.models.encoders.camera_encoder import stack_calibration
from gsmap.models.hrmapnet.bev_fusion import PriorBEVFusion
from gsmap.models.hrmapnet.drawing import draw_elements
from gsmap.models.hrmapnet.query_start import MapKeys, PriorHook, PriorQueries
from gsmap.models.priors.prior_module import PriorModule
from gsmap.prior.map_prior import MapPrior
from gsmap.prior.places import Place, PlaceMaps
from gsmap.prior.rules import RULES, WriteRule
from gsmap.structures.classes import AREA_CLASSES
from gsmap.structures.grid import BEVGrid
from gsmap.structures.tensors import LateValues, cached_constant, exclude_from_compile, upload
from gsmap.utils.errors import InputError

CELLS = "prior_cells"  # map in each BEV cell, (B, M, H, W)
KEYS = "prior_keys"  # row-major indices of the keys among the BEV cells, (B, K)
VALID = "prior_valid"  # False where a key is padding, (B, K)
"""Names of the outputs of `RasterPrior.fuse`. Keys are the cells to which the queries attend."""


class _Pending(NamedTuple):
    """Predictions of a batch that are not written yet.

    Attributes:
        maps: Maps to write to.
        places: Place of each sample, or None where it is unknown.
        scores: Class logits. (B, N, classes)
        points_m: Points in metres. (B, N, P, 2)

    Both tensors are copied to the host in the background (`LateValues`).
    """

    maps: PlaceMaps
    places: list[Place | None]
    scores: LateValues
    points_m: LateValues


@MODELS.register_module()
class RasterPrior(PriorModule, AddsWeights):
    """Raster of earlier predictions at a place, as an input of a `MapDetector` (HRMapNet).

    Before a frame, a window of the map is read at the pose of the frame. The BEV features are fused
    with the window, and the queries start from it. After the frame, the predictions are drawn and
    written to the map. Samples need
    ``lidar2global``, their pose, and ``map_name``. A sample without a pose reads an empty map.

    The maps are emptied whenever the mode of the module is set to training or test (`train`).
    mmengine sets it at the start of each epoch and of each test.

    Args:
        head: Head of the detector, a `MapHead`.
        encoder: BEV encoder of the detector, with its cells as ``grid``.
        bev: Settings of `PriorBEVFusion`; None to leave the BEV features unchanged.
        queries: Settings of `PriorQueries`; None to leave the queries unchanged.
        cell_m: Side of a cell of the map in metres. The side of a BEV cell is a multiple of it.
        score_threshold: Predictions with a higher score are written.
        softness: Softness of drawn predictions in squared cells (`draw_elements`).
        released_pixels: Draw predictions half a cell off, as the release does.
        train_rule: Rule by which predictions are written in training: its name as ``name``
            (``keep_maximum`` by default), and its settings.
        test_rule: Rule in tests, given like ``train_rule``; ``last_seen`` by default.
        test_memory: Frames of a test that share a map: all frames of a place (``"kept"``) or of a
            scene (``"scene"``), or none (``"none"``).
        train_drop: Probability that a sample reads an empty map in training, so that the model also
            works without a map; 0 as published.
        neutral_start: Initialise the weights so that the prior has no effect (``residual`` of
            ``bev``, ``zero_init`` of ``queries``). Then it can be trained from the checkpoint of a
            model without a prior. False initialises random weights, as published.
        init_cfg: Settings of mmengine for the initialisation.

    Attributes:
        window: Grid of the map around the vehicle that a frame reads and writes, h x w cells.
        cells: Grid of the BEV features, H x W cells.
        scale: Number of cells of the map along the side of a BEV cell.
        num_channels: Channels M of the map in each BEV cell: one for each class in each map cell.

    Raises:
        ValueError: If head, encoder or a setting does not fit.
    """

    reads_window: ClassVar[bool] = True  # an exported model has a window of the map as input

    def __init__(
        self,
        head: Any,
        encoder: Any,
        bev: Mapping[str, Any] | None = DEFAULTS,
        queries: Mapping[str, Any] | None = DEFAULTS,
        cell_m: float = 0.3,
        score_threshold: float = 0.4,
        softness: float = 2.0,
        released_pixels: bool = False,
        train_rule: Mapping[str, Any] | None = None,
        test_rule: Mapping[str, Any] | None = None,
        test_memory: str = "kept",
        train_drop: float = 0.0,
        neutral_start: bool = False,
        init_cfg: dict | None = None,
    ) -> None:
        super().__init__(head, cell_m=cell_m, init_cfg=init_cfg)
        bev_grid = getattr(encoder, "grid", None)
        if not isinstance(bev_grid, BEVGrid) or encoder.num_levels != 1:
            raise InputError(
                f"{type(encoder).__name__} can have no prior, which needs a BEV encoder of one "
                "level of images with cells of a fixed size."
            )
        if head.bev_dims != head.embed_dims:
            raise InputError(
                f"{type(head).__name__} can have no RasterPrior, whose layers have one number of "
                f"channels: its queries have {head.embed_dims}, the BEV features {head.bev_dims}."
            )
        if bev is None and queries is None:
            raise InputError("prior needs bev, queries or both, such as bev=dict().")
        if not 0 <= train_drop < 1:
            raise InputError(f"prior.train_drop must be in [0, 1), got {train_drop}.")
        self.train_drop = train_drop
        # `window` is a grid of the base class, with cells of `cell_m` metres.
        self.scale = self.window.height // bev_grid.height
        size = (self.scale * bev_grid.height, self.scale * bev_grid.width)
        # The scale is 0 if the cells of the map are larger than the BEV cells.
        if not self.scale or size != (self.window.height, self.window.width):
            raise InputError(
                f"prior.cell_m is {cell_m:g}: the side of BEV cells, {bev_grid.pixel_size_m[0]:g} "
                "m, must be a multiple of it."
            )
        self.coder = head.coder
        self.num_channels = len(self.classes) * self.scale**2
        self.score_threshold = score_threshold
        self.softness = softness
        self.released_pixels = released_pixels
        self.train_rule = _build_rule(train_rule, default="keep_maximum")
        self.test_rule = _build_rule(test_rule, default="last_seen")
        self.test_memory = test_memory
        self.cells = bev_grid
        embed_dims = head.embed_dims
        shared = {"embed_dims": embed_dims, "num_channels": self.num_channels}
        self.bev: PriorBEVFusion | None = None
        if bev is not None:
            # The layer of the fusion samples images at heights, in the range of the encoder if it
            # has one.
            heights = {"z_range": encoder.z_range} if hasattr(encoder, "z_range") else {}
            self.bev = build_part(
                bev,
                type="PriorBEVFusion",
                grid=bev_grid,
                residual=neutral_start,
                **heights,
                **shared,
            )
            # The inputs of the convolution are the BEV features, then the channels of the map.
            mark_classes(self.bev.conv[0], dim=1, first=embed_dims, size=self.scale**2)
        self.queries: PriorQueries | None = None
        # Positional encoding of BEV cells for the queries, if the layer of ``bev`` has none.
        self.positions: LearnedPositionalEncoding | None = None
        if queries is not None:
            self.queries = build_part(
                queries, type="PriorQueries", zero_init=neutral_start, **shared
            )
            mark_classes(self.queries.label_encoder, dim=1, size=self.scale**2)
            if self.bev is None or self.bev.layer is None:
                # mmdet's encoding joins two halves, one for the column and one for the row.
                self.positions = LearnedPositionalEncoding(
                    embed_dims // 2, bev_grid.height, bev_grid.width
                )
        # A fusion with an output convolution adds its result to the features through this
        # convolution, whose weights start at 0.
        bev_is_neutral = self.bev is None or self.bev.output_conv is not None
        queries_are_neutral = self.queries is None or self.queries.zero_init
        if bev_is_neutral and queries_are_neutral:
            # A checkpoint may lack all weights of the prior: "" is the prefix of all keys.
            self.neutral_keys = ("",)
        self._pending: list[_Pending] = []
        self._maps = self.new_maps()

    def __getstate__(self) -> dict[str, Any]:
        """Attributes of a copy or pickle, which begins with empty maps."""
        return {**vars(self), "_pending": [], "_maps": self.new_maps()}

    @property
    def calibration(self) -> tuple[str, ...]:
        """Names of the calibration arrays that the fusion uses."""
        return () if self.bev is None else self.bev.calibration

    @property
    def maps(self) -> PlaceMaps:
        """Maps that are read and written: the maps given by a user, or the maps of the model."""
        return self._maps if self._given is None else self._given

    def new_maps(self) -> PlaceMaps:
        """Create empty maps, for training or test."""
        rule = self.train_rule if self.training else self.test_rule
        memory = "kept" if self.training else self.test_memory
        return PlaceMaps(self.classes, self.window, rule=rule, memory=memory)

    def new_prior(self, place: str) -> MapPrior:
        """Create the empty prior of a place, with ``test_rule``."""
        return MapPrior(self.maps.settings_of(place), rule=self.test_rule)

    def train(self, mode: bool = True) -> "RasterPrior":
        """Set the mode, and empty the maps of the model."""
        super().train(mode)
        if not mode and self.test_memory == "kept" and get_world_size() > 1:
            print_log(
                "each process keeps its own map of the samples that it tests: test in one process, "
                "or set model.prior.test_memory='none'.",
                logger="current",
                level=logging.WARNING,
            )
        self._pending.clear()
        self._maps = self.new_maps()
        return self

    @exclude_from_compile
    def fuse(
        self,
        outputs: Mapping[str, Any],
        metas: Sequence[dict[str, Any]],
        img_shape: tuple[int, int],
    ) -> dict[str, Any]:
        """Read the map at each sample of a batch, and fuse the outputs of the encoder with it.

        Args:
            outputs: Outputs of the encoder: ``bev_feats`` (B, C, H, W), ``img_feats``.
            metas: Metainfo of each sample.
            img_shape: Rows and columns of the padded images.

        Returns:
            The outputs with fused ``bev_feats``, and the cells of the map for `hook`.
        """
        # The predictions of the previous batch are written first, so that they can be read.
        self.flush()
        windows = []
        for meta in metas:
            place = None if self._is_dropped() else Place.of(meta)
            windows.append(self.maps.read(place))
        cells = F.pixel_unshuffle(torch.stack(windows), self.scale)  # (B, M, H, W), on the CPU
        device = outputs["bev_feats"].device
        calibration = stack_calibration(metas, self.calibration, device)
        # All tensors are copied to the device together.
        host_tensors = [cells]
        if self.queries is not None:
            host_tensors += self._select_keys(cells)
        cells, *keys = upload(host_tensors, device)
        fused = self.fuse_cells(outputs, cells, calibration, img_shape=img_shape)
        if self.queries is not None:
            cell_indices, is_valid = keys
            fused[KEYS] = cell_indices
            fused[VALID] = is_valid
        return fused

    def fuse_window(
        self,
        outputs: Mapping[str, Any],
        window: Tensor,
        calibration: Mapping[str, Tensor],
        img_shape: tuple[int, int],
    ) -> dict[str, Any]:
        """Fuse the outputs of the encoder with a window of the map, in a form for export.

        The sizes of all tensors are fixed. They do not depend on values.

        Args:
            outputs: Outputs of the encoder.
            window: Values of the map, [0, 1]. (B, classes, h, w)
            calibration: A tensor for each name in ``self.calibration``. (B, ...)
            img_shape: Rows and columns of the padded images.

        Returns:
            The outputs with fused ``bev_feats``, and the cells of the map for `hook`.
        """
        cells = F.pixel_unshuffle(window, self.scale)
        fused = self.fuse_cells(outputs, cells, calibration, img_shape=img_shape)
        if self.queries is not None:
            stride = self.queries.stride  # every `stride`-th cell along both axes is a key
            num_cells = self.cells.height * self.cells.width
            all_indices = torch.arange(num_cells, device=window.device)
            all_indices = all_indices.view(self.cells.height, self.cells.width)
            cell_indices = all_indices[::stride, ::stride]
            largest = cells[:, :, ::stride, ::stride].amax(1).flatten(1)  # (B, K)
            fused[KEYS] = cell_indices.reshape(1, -1).expand(len(window), -1)
            fused[VALID] = largest > self.queries.threshold
        return fused

    def fuse_cells(
        self,
        outputs: Mapping[str, Any],
        cells: Tensor,
        calibration: Mapping[str, Tensor],
        img_shape: tuple[int, int],
    ) -> dict[str, Any]:
        """Fuse the outputs of the encoder with the map in each BEV cell.

        Args:
            outputs: Outputs of the encoder.
            cells: Map in each cell. (B, M, H, W)
            calibration: A tensor for each name in ``self.calibration``. (B, ...)
            img_shape: Rows and columns of the padded images.

        Returns:
            The outputs with fused ``bev_feats``, and ``cells``.
        """
        fused = {**outputs, CELLS: cells}
        if self.bev is not None:
            fused["bev_feats"] = self.bev(
                outputs["bev_feats"],
                cells=cells,
                img_feats=outputs["img_feats"],
                calibration=calibration,
                img_shape=img_shape,
            )
        return fused

    def hook(self, outputs: Mapping[str, Any]) -> PriorHook:
        """Create the hook that applies the prior to the queries of the head for one batch.

        Args:
            outputs: Outputs of `fuse` or `fuse_window`.

        Returns:
            The hook. The head calls it, and it then has the predictions of the last layer.
        """
        if self.queries is None:
            return PriorHook(None, None)  # it only keeps the predictions
        cells = outputs[CELLS].flatten(2).transpose(1, 2)  # (B, H * W, M)
        cell_indices = outputs[KEYS]  # row-major indices of the cells, (B, K)
        values = cells.gather(1, cell_indices[..., None].expand(-1, -1, cells.shape[-1]))
        positions = self._cell_positions(cells)[cell_indices]  # (B, K, C)
        return PriorHook(self.queries, MapKeys(values, positions, is_valid=outputs[VALID]))

    def keep(self, hook: PriorHook, metas: Sequence[Mapping[str, Any]]) -> None:
        """Keep the predictions of a batch, to be written before the next batch (`flush`).

        Args:
            hook: Hook of the batch, after the head has run.
            metas: Metainfo of each sample.
        """
        # The hook has no predictions before the head has run. `writes` is False for maps that
        # are only read.
        if hook.scores is None or hook.points_m is None or not self.maps.writes:
            return
        places = [Place.of(meta) for meta in metas]
        self._pending.append(_Pending(self.maps, places, hook.scores, hook.points_m))

    def flush(self) -> None:
        """Write the predictions of the previous batch to its maps."""
        pending = list(self._pending)
        self._pending.clear()
        for batch in pending:
            all_scores = batch.scores.read()  # waits for the copy to the host
            all_points_m = batch.points_m.read()
            for index, place in enumerate(batch.places):
                raster = self.draw(all_scores[index], all_points_m[index])
                batch.maps.write(place, raster)

    @torch.no_grad()
    def draw(self, scores: Tensor, points_m: Tensor) -> Tensor:
        """Draw the predictions of a frame whose scores are high enough.

        Args:
            scores: Class logits, as the coder weighs them. (N, classes)
            points_m: Points in metres. (N, P, 2)

        Returns:
            Values in [0, 1]. (classes, h, w)
        """
        # Best pairs of query and class: a query may occur with several classes.
        best = self.coder.decode(scores, points_m)
        is_sure = best.scores > self.score_threshold
        return draw_elements(
            points_m[best.query_inds[is_sure]],
            labels=best.labels[is_sure],
            grid=self.window,
            classes=self.classes,
            areas=AREA_CLASSES,
            softness=self.softness,
            released_pixels=self.released_pixels,
        )

    def _is_dropped(self) -> bool:
        """Decide at random whether a sample reads an empty map (``train_drop``)."""
        if not self.training or self.train_drop == 0:
            return False  # no number is drawn, as it would change all later random numbers
        return bool(torch.rand(()) < self.train_drop)

    def _select_keys(self, cells: Tensor) -> list[Tensor]:
        """Select the cells of each sample in which the map has a value above the threshold.

        Returns:
            Row-major indices of the cells (B, K), and False where an index is padding (B, K).
        """
        assert self.queries is not None
        stride = self.queries.stride
        is_known = torch.zeros(len(cells), self.cells.height, self.cells.width, dtype=torch.bool)
        largest = cells[:, :, ::stride, ::stride].amax(1)
        is_known[:, ::stride, ::stride] = largest > self.queries.threshold
        known_indices = [known.flatten().nonzero()[:, 0] for known in is_known]
        # All samples are padded to the length of the longest one. Attention needs one key at least.
        length = max(1, *(len(indices) for indices in known_indices))
        padded = torch.zeros(len(cells), length, dtype=torch.long)
        is_valid = torch.zeros(len(cells), length, dtype=torch.bool)
        for row, indices in enumerate(known_indices):
            padded[row, : len(indices)] = indices
            is_valid[row, : len(indices)] = True
        return [padded, is_valid]

    def _cell_positions(self, like: Tensor) -> Tensor:
        """Positional encoding of all cells, on the device of a tensor. (H * W, C)"""
        encoding = self.positions
        if encoding is None:
            assert self.bev is not None
            encoding = self.bev.layer.positional_encoding
        shape = (1, self.cells.height, self.cells.width)
        # A mask of zeros: mmdet's encodings take 0 for a valid cell.
        mask = cached_constant(like, ("prior cells", *shape), lambda: like.new_zeros(shape))
        return encoding(mask)[0].flatten(1).T


def _build_rule(settings: Mapping[str, Any] | None, default: str) -> WriteRule:
    """Build a rule of writing.

    Args:
        settings: Name of the rule as ``name``, and settings of the rule; or None.
        default: Name of the rule if ``settings`` has none.

    Raises:
        ValueError: If the rule is unknown, or does not have one of the settings.
    """
    arguments = {"name": default, **(settings or {})}
    name = arguments.pop("name")
    if name not in RULES:
        raise InputError(f"the rule of a prior must be one of {sorted(RULES)}, got {name!r}.")
    try:
        return RULES[name](**arguments)
    except TypeError as error:
        raise InputError(f"the rule {name} of a prior takes other settings: {error}.") from error
