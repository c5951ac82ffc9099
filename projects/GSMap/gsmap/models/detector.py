"""Detector of map elements in images and LiDAR points."""

import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import Any, ClassVar

import torch
from mmcv.ops import ModulatedDeformConv2d
from mmdet3d.models.detectors import Base3DDetector
from mmdet3d.registry import MODELS
from mmdet3d.structures import Det3DDataSample
from mmengine.logging import MMLogger
from torch import Tensor
from torch.utils._pytree import tree_map_only

from gsmap.checkpoints.strict import adapt_state, neutral_keys
from gsmap.models.encoders.camera_encoder import stack_calibration
from gsmap.models.encoders.folded_backbone import FoldedBackbone
from gsmap.models.encoders.fused_resnet import FrozenNorms, has_frozen_norms
from gsmap.models.encoders.half_backbone import HalfBackbone
from gsmap.models.loss_check import LossCheck
from gsmap.models.step_graphs import StepGraphs, require_recordable
from gsmap.models.streams.memory import BatchMemory, StreamMemory
from gsmap.structures.grid import BEVGrid
from gsmap.structures.tensors import at_least_float32, is_recording
from gsmap.utils.errors import InputError

Inputs = dict[str, Any]
Samples = Sequence[Det3DDataSample]


@MODELS.register_module()
class MapDetector(Base3DDetector):
    """Detector of map elements: image backbone and neck, BEV encoder and head.

    A model with LiDAR has a LiDAR encoder. A model with cameras and LiDAR also has a fusion of
    their BEV features. Modules are given as configs, or as None if the model does not have them.

    Args:
        grid: Extent of the map, as arguments of `BEVGrid`: ``x_range`` and ``y_range`` in metres,
            and optionally ``forward``. The grid is passed on to the encoders and the head.
        classes: Names of the classes.
        map_head: Head.
        bev_encoder: BEV encoder of the cameras.
        img_backbone: Image backbone.
        img_neck: Image neck.
        img_augment: Augmentation of the normalised images in training, such as GridMask.
        lidar_encoder: BEV encoder of the LiDAR.
        bev_fuser: Fusion of the BEV features of cameras and LiDAR.
        temporal: Settings of `StreamMemory`, for a model with memory of earlier frames.
        prior: Config of a module that reads maps of earlier frames (`RasterPrior`,
            `ElementFusion`).
        fold_batch_norms: In inference, run a copy of the image backbone whose batch norms are
            folded into its convolutions. This is faster, but the copy has its weights in memory a
            second time.
        allow_untrained: Accept checkpoints that lack the weights of modules that initially have no
            effect. For example, a checkpoint of MapTR lacks the Gaussians of GSMap. Trainings
            accept such checkpoints, all other commands only on request. All other weights must be
            present, with the names of this package or of the published model. Further weights are
            not allowed.
        autocast: With ``"bfloat16"``, backbone, neck and encoders, which do nearly all of the
            arithmetic, use this type in training. Head, matching and losses run in float32, and no
            loss scale is needed. A ResNet with fixed batch norms is computed as fused convolutions
            (`FrozenNorms`). With None, the detector itself does not use autocast. The option
            ``--amp`` then applies autocast to the whole model, including the head.
        compiled: Compile backbone, neck, encoders and head at the start of a training, which takes
            a minute or more. True, or a mode of ``torch.compile``; ``"reduce-overhead"`` also
            captures CUDA graphs.
        cuda_graphs: On a GPU, record the operations of a training step up to the predictions once,
            and replay them in every step, forward and backward (`StepGraphs`). With ``autocast``,
            matrix products of float32 tensors among these operations are computed in TF32.
        data_preprocessor: Config of the data preprocessor.
        init_cfg: Initialisation config of mmengine.

    Raises:
        ValueError: If there is no encoder, if there is no fusion for two encoders or a fusion for
            one, if ``autocast`` has another value, or if ``cuda_graphs`` is set for a model whose
            steps cannot be recorded.
    """

    compiler: ClassVar[str] = "inductor"  # backend of torch.compile

    def __init__(
        self,
        grid: dict,
        classes: Sequence[str],
        map_head: dict,
        bev_encoder: dict | None = None,
        img_backbone: dict | None = None,
        img_neck: dict | None = None,
        img_augment: dict | None = None,
        lidar_encoder: dict | None = None,
        bev_fuser: dict | None = None,
        temporal: dict | None = None,
        prior: dict | None = None,
        fold_batch_norms: bool = True,
        allow_untrained: bool = True,
        autocast: str | None = None,
        compiled: bool | str = False,
        cuda_graphs: bool = False,
        data_preprocessor: dict | None = None,
        init_cfg: dict | None = None,
    ) -> None:
        super().__init__(data_preprocessor=data_preprocessor, init_cfg=init_cfg)
        self.img_backbone = MODELS.build(img_backbone) if img_backbone else None
        self.folded_backbone = FoldedBackbone() if fold_batch_norms else None
        self.frozen_norms = FrozenNorms()
        # Convolutions on CPUs and tensor cores are fastest with channels last. A backbone with
        # mmcv's deformable convolution cannot use this format: the convolution would read the
        # tensors as channels first, without an error.
        self.channels_last = True
        if self.img_backbone is not None:
            for module in self.img_backbone.modules():
                if isinstance(module, ModulatedDeformConv2d):
                    self.channels_last = False
        self.loss_check = LossCheck()
        self.half_backbone: HalfBackbone | None = None  # replaces backbone and neck in inference
        self.allow_untrained = allow_untrained
        if autocast not in (None, "bfloat16"):
            raise InputError(f"autocast must be None or 'bfloat16', got {autocast!r}.")
        self.autocast = autocast
        self.compiled = compiled
        self.img_neck = MODELS.build(img_neck) if img_neck else None
        self.img_augment = MODELS.build(img_augment) if img_augment else None
        if not (bev_encoder or lidar_encoder):
            raise InputError("a model needs a bev_encoder (cameras), a lidar_encoder or both.")
        if bool(bev_fuser) != bool(bev_encoder and lidar_encoder):
            raise InputError("bev_fuser belongs to a model of cameras and LiDAR, and to no other.")
        self.grid = BEVGrid(**grid)
        shared = {"grid": self.grid}  # a grid in the config of a module has precedence
        self.bev_encoder = MODELS.build({**shared, **bev_encoder}) if bev_encoder else None
        self.lidar_encoder = MODELS.build({**shared, **lidar_encoder}) if lidar_encoder else None
        self.bev_fuser = MODELS.build(bev_fuser) if bev_fuser else None
        self.map_head = MODELS.build({**shared, "classes": classes, **map_head})
        self.temporal = None if temporal is None else StreamMemory(self.map_head, **temporal)
        self.prior: Any = None
        if prior is not None:
            self.prior = MODELS.build({"head": self.map_head, "encoder": self.bev_encoder, **prior})
        # Number of times that a training may have changed the weights without their versions.
        self.num_trainings = 0
        self.step_graphs: StepGraphs | None = None
        if cuda_graphs:  # `SWITCH` is the name of this argument
            require_recordable(self)
            self.step_graphs = StepGraphs()

    def train(self, mode: bool = True) -> "MapDetector":
        """Set the mode. If ``compiled`` is set, the first call with True compiles the modules."""
        super().train(mode)
        if mode:
            self._drop_backbone_copies()
        if mode and self.compiled:
            compile_mode = None if self.compiled is True else self.compiled
            parts = (
                self.img_backbone,
                self.img_neck,
                self.bev_encoder,
                self.lidar_encoder,
                self.map_head,
            )
            for part in parts:
                if part is not None:
                    part.compile(backend=self.compiler, mode=compile_mode)
            self.compiled = False  # so that a later call does not compile the modules again
        return self

    def _drop_backbone_copies(self) -> None:
        """Delete the copies of the backbone for inference before its weights are trained.

        The copies are made again if the versions of the weights have changed, but a fused optimizer
        changes weights without their versions.
        """
        self.num_trainings += 1
        if self.folded_backbone is not None:
            self.folded_backbone.folded = None
        if self.half_backbone is not None:
            self.half_backbone.backbone = None

    def backbone_copies(self) -> list[Any]:
        """Copies of backbone and neck that inference runs at present; None if there is none."""
        copies: list[Any] = []
        if self.folded_backbone is not None:
            copies.append(self.folded_backbone.folded)
        if self.half_backbone is not None:
            copies += [self.half_backbone.backbone, self.half_backbone.neck]
        return copies

    def extract_img_feats(self, imgs: Tensor) -> list[Tensor]:
        """Run backbone and neck on all cameras. (B, V, 3, H, W) -> list of (B, V, C, h, w)"""
        if self.img_backbone is None:
            raise InputError("the model has no img_backbone, so it takes no images.")
        if torch.is_grad_enabled():
            self._drop_backbone_copies()
        images = imgs.flatten(0, 1)
        if self.half_backbone is not None and not torch.is_grad_enabled():
            maps = self.half_backbone(
                self.img_backbone, self.img_neck, images=images, channels_last=self.channels_last
            )
            return _split_batch(maps, batch_size=len(imgs))
        if self.channels_last:
            images = images.contiguous(memory_format=torch.channels_last)
        if self._fuses_frozen_norms(images):
            feats = self.frozen_norms(self.img_backbone, images, dtype=torch.bfloat16)
        elif self.folded_backbone is None:
            feats = self.img_backbone(images)
        else:
            feats = self.folded_backbone(self.img_backbone, images)
        if self.img_neck is not None:
            feats = self.img_neck(feats)
        return _split_batch(feats, batch_size=len(imgs))

    def _fuses_frozen_norms(self, images: Tensor) -> bool:
        """Whether the backbone runs as fused convolutions: in half-precision training on a GPU.

        A compiled backbone is not replaced, because its compiled code would not be used.
        """
        trains_in_half = self.training and bool(self.autocast)
        if not (trains_in_half and images.is_cuda and self.channels_last):
            return False
        is_compiled = getattr(self.img_backbone, "_compiled_call_impl", None) is not None
        return has_frozen_norms(self.img_backbone) and not is_compiled

    def augment_images(self, imgs: Tensor) -> Tensor:
        """Apply the augmentation of the normalised images in training. (B, V, 3, H, W)"""
        if not self.training or self.img_augment is None:
            return imgs
        images = self.img_augment(imgs.flatten(0, 1))
        return images.unflatten(dim=0, sizes=(len(imgs), -1))

    def halve_backbone(self) -> None:
        """Run image backbone and neck in float16 in inference (`HalfBackbone`)."""
        self.half_backbone = HalfBackbone()

    def extract_feat(self, batch_inputs: Inputs, batch_data_samples: Samples) -> dict[str, Any]:
        """Run the encoders on a batch.

        Args:
            batch_inputs: Inputs of the batch: ``imgs`` (B, V, 3, H, W), ``voxels`` or both.
            batch_data_samples: Samples of the batch, with the calibration in their metainfo.

        Returns:
            Outputs by name: ``bev_feats`` (B, C, H, W), and inputs of losses of the encoder.
        """
        with self._training_autocast() as in_half_precision:
            outputs = self._encode(batch_inputs, batch_data_samples)
        return tree_map_only(Tensor, _in_float32, outputs) if in_half_precision else outputs

    @contextmanager
    def _training_autocast(self) -> Iterator[bool]:
        """Context manager that applies ``autocast`` in training; yields whether it is active."""
        if not (self.training and self.autocast):
            yield False
            return
        device = next(self.parameters()).device.type
        # A recorded step must cast the weights at each replay, so autocast keeps no cast weights.
        caches = not is_recording(device)
        with torch.autocast(device, dtype=getattr(torch, self.autocast), cache_enabled=caches):
            yield True

    def _encode(self, batch_inputs: Inputs, batch_data_samples: Samples) -> dict[str, Tensor]:
        """Run the encoders. The types of the outputs are not converted after autocast."""
        outputs: dict[str, Tensor] = {}
        if self.bev_encoder is not None:
            imgs = self.augment_images(batch_inputs["imgs"])
            metas = []
            for sample in batch_data_samples:
                metas.append({**sample.metainfo, "batch_input_shape": tuple(imgs.shape[-2:])})
            outputs = self.bev_encoder(self.extract_img_feats(imgs), metas)
        if self.lidar_encoder is not None:
            feats = self.lidar_encoder(batch_inputs["voxels"], len(batch_data_samples))
            if self.bev_fuser is not None:
                feats = self.bev_fuser(outputs["bev_feats"], feats)
            outputs = {**outputs, "bev_feats": feats}
        if self.prior is not None and self.bev_encoder is not None:
            # The prior reads its map at the pose of each sample, and fuses it with the features.
            outputs = self.prior.fuse(outputs, metas, img_shape=tuple(imgs.shape[-2:]))
        return outputs

    def encode_images(self, imgs: Tensor, calibration: Mapping[str, Tensor]) -> dict[str, Any]:
        """Run backbone, neck and BEV encoder on tensors, without meta dicts.

        CUDA graphs record this method (`StepGraphs`), because a graph can only read tensors.

        Args:
            imgs: Normalised and augmented images. (B, V, 3, H, W)
            calibration: A tensor for each calibration array that the encoder reads. (B, ...)

        Returns:
            Outputs of the BEV encoder, in float32 under ``autocast``.
        """
        encoder: Any = self.bev_encoder
        size = (imgs.shape[-2], imgs.shape[-1])
        with self._training_autocast() as in_half_precision:
            levels = encoder.levels(self.extract_img_feats(imgs))
            outputs = encoder.encode(levels, calibration=calibration, img_shape=size)
        return tree_map_only(Tensor, _in_float32, outputs) if in_half_precision else outputs

    @contextmanager
    def over_time(
        self, outputs: dict[str, Any], batch_data_samples: Samples
    ) -> Iterator[BatchMemory]:
        """Context manager that recalls the memory of a batch, if the model has a memory.

        At the end of the context, the memory and the map prior are updated.

        Args:
            outputs: Outputs of the encoders.
            batch_data_samples: Samples of the batch.

        Yields:
            The outputs with the memory (``outputs``), and the keyword argument with the hooks of
            the head (``hooks``, empty if there are none). A hook changes the queries of the head.
        """
        metas = [sample.metainfo for sample in batch_data_samples]
        # The hook receives the predictions of the head, with which `keep` updates the prior below.
        prior_hook = None if self.prior is None else self.prior.hook(outputs)
        with ExitStack() as stack:
            batch = BatchMemory(outputs)
            if self.temporal is not None:
                batch = stack.enter_context(self.temporal.remember_batch(outputs, metas))
            if prior_hook is not None:
                batch.further_hooks = (prior_hook,)
            yield batch
        if prior_hook is not None:
            self.prior.keep(prior_hook, metas)

    def loss(self, batch_inputs: Inputs, batch_data_samples: Samples) -> dict[str, Tensor]:
        """Compute all losses as scalars, by name.

        Args:
            batch_inputs: Inputs of the batch: ``imgs``, ``voxels`` or both.
            batch_data_samples: Samples with ground truth.

        Raises:
            FloatingPointError: If a loss is not finite. On a GPU, the error is raised in the next
                step (`LossCheck`).
        """
        losses = self._losses(batch_inputs, batch_data_samples)
        # The check and the sum in `parse_losses` need scalars.
        scalars = {}
        for name, loss in losses.items():
            scalars[name] = loss.mean() if loss.dim() else loss
        tokens = [sample.metainfo.get("token", "unknown") for sample in batch_data_samples]
        self.loss_check.start(scalars, tokens=tokens)
        return scalars

    def _losses(self, batch_inputs: Inputs, batch_data_samples: Samples) -> dict[str, Tensor]:
        """Compute the losses of the head by name. Losses that are not scalars are not averaged."""
        if self.step_graphs is not None:
            imgs = self.augment_images(batch_inputs["imgs"])
            metas = [sample.metainfo for sample in batch_data_samples]
            encoder: Any = self.bev_encoder
            calibration = stack_calibration(metas, encoder.calibration, imgs.device)
            # The graphs include the head up to its predictions, so the head is not run again.
            outputs, layers = self.step_graphs(self, imgs, calibration=calibration)
            return self.map_head.loss(outputs, batch_data_samples, layers=layers)
        outputs = self.extract_feat(batch_inputs, batch_data_samples)
        with self.over_time(outputs, batch_data_samples) as batch:
            return self.map_head.loss(batch.outputs, batch_data_samples, **batch.hooks)

    def parse_losses(self, losses: dict[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        """Sum the values whose names contain "loss".

        Args:
            losses: Scalars by name.

        Returns:
            The sum, and all values by name for the log, with the sum first.
        """
        values = []
        for name, value in losses.items():
            if "loss" in name:
                values.append(value)
        total = torch.stack(values).sum()
        return total, {"loss": total, **losses}

    def predict(self, batch_inputs: Inputs, batch_data_samples: Samples) -> list[Det3DDataSample]:
        """Predict map elements, and add them to the samples as ``pred_instances_3d``."""
        outputs = self.extract_feat(batch_inputs, batch_data_samples)
        with self.over_time(outputs, batch_data_samples) as batch:
            results = self.map_head.predict(batch.outputs, batch_data_samples, **batch.hooks)
            if self.temporal is not None:
                results = self.temporal.update_detections(batch, results)
            if self.prior is not None:
                metas = [sample.metainfo for sample in batch_data_samples]
                results = self.prior.update_detections(results, metas)
        return self.add_pred_to_datasample(batch_data_samples, results)

    def _forward(self, batch_inputs: Inputs, batch_data_samples: Samples) -> dict[str, Tensor]:
        """Return the raw outputs of the head."""
        outputs = self.extract_feat(batch_inputs, batch_data_samples)
        with self.over_time(outputs, batch_data_samples) as batch:
            return self.map_head(batch.outputs, **batch.hooks)

    def _dump_init_info(self) -> None:
        """Log the initialisation of each weight, but only at debug level: it has many lines."""
        handlers = MMLogger.get_current_instance().handlers
        if min(handler.level for handler in handlers) <= logging.DEBUG:
            super()._dump_init_info()

    def _load_from_state_dict(
        self,
        state_dict: dict[str, Tensor],
        prefix: str,
        local_metadata: dict[str, Any],
        strict: bool,
        missing_keys: list[str],
        unexpected_keys: list[str],
        error_msgs: list[str],
    ) -> None:
        """Load weights with the names of this package or of a release (`adapt_state`)."""
        expected = self.state_dict(prefix=prefix)
        # Sets of keys that a checkpoint may lack, because the weights initially have no effect.
        neutral = neutral_keys(self, prefix)
        # Function with which the head adapts weights of another form to its modules.
        fit = partial(self.map_head.fit_state, prefix=f"{prefix}map_head.")
        adapt_state(
            state_dict,
            expected,
            prefix=prefix,
            neutral=neutral,
            fit=fit,
            allow_untrained=self.allow_untrained,
        )
        super()._load_from_state_dict(
            state_dict,
            prefix,
            local_metadata=local_metadata,
            strict=strict,
            missing_keys=missing_keys,
            unexpected_keys=unexpected_keys,
            error_msgs=error_msgs,
        )


def _split_batch(maps: Sequence[Tensor], batch_size: int) -> list[Tensor]:
    """Split maps of images by sample. (B * V, C, h, w) each -> (B, V, C, h, w) each"""
    batches = []
    for feats in maps:
        batches.append(feats.unflatten(dim=0, sizes=(batch_size, -1)))
    return batches


def _in_float32(values: Tensor) -> Tensor:
    """Convert half-precision features to float32."""
    return at_least_float32(values) if values.is_floating_point() else values
