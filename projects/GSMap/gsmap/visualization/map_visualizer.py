"""MMEngine visualizer of vectorized maps."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from mmdet3d.registry import VISUALIZERS
from mmengine.dist import master_only
from mmengine.visualization import Visualizer

from gsmap.datasets.elements import elements_of_predictions, elements_of_targets, elements_of_truth
from gsmap.datasets.image_files import read_image
from gsmap.evaluation.core.chamfer_ap import ChamferConfig, match_chamfer
from gsmap.ops.gaussian_raster import render_gaussians
from gsmap.structures.elements import MapElements
from gsmap.structures.frames import FRAME_VIEWS, FrameView, frame_view
from gsmap.structures.grid import BEVGrid
from gsmap.utils.errors import InputError
from gsmap.visualization.bev_view import BEVPanel
from gsmap.visualization.camera_view import CameraView
from gsmap.visualization.figure import compose_figure, figure_to_rgb, sample_title
from gsmap.visualization.style import MapStyle

PANELS = ("ground_truth", "prediction", "matches", "gaussians", "rasters")
"""Names of the bird's-eye views, in their order in a picture."""
RASTER_SIZE = (400, 200)
"""Rows and columns of the rendered masks in the view ``rasters``."""


def images_from_inputs(images: torch.Tensor) -> list[np.ndarray]:
    """Convert images of a pipeline to pictures.

    Args:
        images: BGR, 0 to 255, before normalisation. (V, 3, H, W)

    Returns:
        RGB. V x (H, W, 3) uint8

    Raises:
        ValueError: If the shape is wrong.
    """
    if images.ndim != 4 or images.shape[1] != 3:
        raise InputError(f"images must have shape (V, 3, H, W), got {tuple(images.shape)}.")
    rgb = images.flip(1).permute(0, 2, 3, 1)  # (V, H, W, 3)
    pixels = rgb.float().round().clamp(0, 255).to(torch.uint8)
    return list(pixels.cpu().numpy())


def ground_truth_elements(data_sample: Any) -> MapElements | None:
    """Read the ground truth of a sample at full resolution, or else its training targets.

    Args:
        data_sample: A ``Det3DDataSample``.

    Returns:
        Elements, or None if the sample has neither ``eval_ann_info`` nor ``gt_instances_3d``.
    """
    info = data_sample.metainfo.get("eval_ann_info")
    if info is not None:
        return elements_of_truth(info)
    instances = getattr(data_sample, "gt_instances_3d", ())  # an empty tuple has no "pts"
    return elements_of_targets(instances) if "pts" in instances else None


def predicted_elements(data_sample: Any) -> MapElements | None:
    """Read the predictions of a sample.

    Args:
        data_sample: A ``Det3DDataSample``.

    Returns:
        Elements by rising score, so that the most confident one is drawn last, or None if the
        sample has no ``pred_instances_3d``.
    """
    instances = getattr(data_sample, "pred_instances_3d", ())
    if "pts" not in instances:
        return None
    elements = elements_of_predictions(instances)
    return elements.select(np.argsort(elements.confidence, kind="stable"))


@VISUALIZERS.register_module()
class MapVisualizer(Visualizer):
    """Visualizer of samples: the map over the cameras, and bird's-eye views of truth and results.

    Extent, classes and frame come from the ``metainfo`` of the data set (``dataset_meta``, which
    the runner sets). The cameras show the prediction, or else the ground truth.

    Args:
        name: Name of the visualizer in MMEngine.
        ground_z_m: Height of the level ground in the annotation frame, in metres. By default, the
            ground follows from the mounting of the sensor (``lidar2ego`` of the sample), or else
            from the height in the annotation file, or from the usual height of the frame.
        score_thr: Smallest score of a drawn prediction, in [0, 1].
        panels: Bird's-eye views to draw, from `PANELS`; by default all but ``rasters``. Views
            without data are left out.
        match_m: Largest Chamfer distance of a hit in ``matches``, in metres, as in AP_chamfer.
        show_order: Whether to mark the start and the direction of elements.
        width_px: Width of the picture in pixels.
        style: Other options of ``MapStyle``, by name.
        **kwargs: Options of MMEngine's ``Visualizer``: ``vis_backends``, ``save_dir``.

    Raises:
        ValueError: If a panel is not known.
    """

    def __init__(
        self,
        name: str = "visualizer",
        ground_z_m: float | None = None,
        score_thr: float = 0.4,
        panels: Sequence[str] = PANELS[:4],
        match_m: float = 1.0,
        show_order: bool = False,
        width_px: int = 1500,
        style: dict | None = None,
        **kwargs: Any,
    ):
        super().__init__(name=name, **kwargs)
        unknown = set(panels) - set(PANELS)
        if unknown:
            raise InputError(f"panels must be among {PANELS}, got {sorted(unknown)}.")
        self.ground_z_m = ground_z_m
        self.score_thr = score_thr
        self.panels = tuple(panels)
        self.match_m = match_m
        self.show_order = show_order
        self.width_px = width_px
        self.style_options = dict(style or {})

    @property
    def grid(self) -> BEVGrid:
        """Extent of the map and size of its rendered masks."""
        meta = self.dataset_meta or {}
        rows, columns = RASTER_SIZE
        return BEVGrid(
            x_range=meta.get("x_range", (-15.0, 15.0)),
            y_range=meta.get("y_range", (-30.0, 30.0)),
            height=rows,
            width=columns,
        )

    @property
    def style(self) -> MapStyle:
        """Colours and widths, with the classes of the data set."""
        classes = (self.dataset_meta or {}).get("classes", MapStyle.classes)
        return MapStyle(**{"classes": tuple(classes), **self.style_options})

    def frame_view(self, metainfo: dict) -> FrameView:
        """Create the orientation and the ground plane of a sample.

        Args:
            metainfo: Metadata of the sample, with ``lidar2ego`` if it is known.

        Raises:
            ValueError: If the annotation frame is not known.
        """
        meta = self.dataset_meta or {}
        frame = meta.get("frame", "lidar")
        if frame not in FRAME_VIEWS:
            raise InputError(
                f"No view is known for frame {frame!r}, only for {sorted(FRAME_VIEWS)}; "
                "add one to gsmap.structures.frames.FRAME_VIEWS."
            )
        view = frame_view(frame, meta.get("ground_z_m"))
        if self.ground_z_m is not None:
            return replace(view, ground=(0.0, 0.0, self.ground_z_m))
        return view.with_mounting(metainfo.get("lidar2ego"))

    def cameras(
        self, metainfo: dict, images: Sequence[np.ndarray] | None = None
    ) -> list[CameraView]:
        """Pair the images of a sample with their projections.

        Args:
            metainfo: Metadata of the sample: ``lidar2img``, ``img_path``, ``cam_names`` and
                ``img_aug_matrix``.
            images: RGB images in the geometry of the model input (after augmentation). By default,
                the original files are read, and the augmentation is removed from the projections.
                V x (h, w, 3) uint8

        Returns:
            Cameras that have an image. A camera whose path is None is left out. The list is empty
            if there are neither images nor paths.

        Raises:
            ValueError: If the numbers of images and projections disagree, or a file is missing or
                damaged.
        """
        paths = metainfo.get("img_path")
        if images is None and paths is None:
            return []
        projections = np.asarray(metainfo["lidar2img"], dtype=np.float64)  # (V, 4, 4)
        names = metainfo.get("cam_names") or [f"camera {i}" for i in range(len(projections))]
        pictures: list[np.ndarray | None] = []
        if images is not None:
            pictures += images
        else:
            # The files show the original images, but `lidar2img` includes the augmentation.
            if metainfo.get("img_aug_matrix") is not None:
                augmentation = np.asarray(metainfo["img_aug_matrix"], np.float64)
                projections = np.linalg.inv(augmentation) @ projections
            where = f"sample {metainfo.get('token')!r}"
            for path in paths or ():
                if path is None:
                    pictures.append(None)
                else:
                    pictures.append(read_image(path, where)[..., ::-1])  # BGR -> RGB
        if len(pictures) != len(projections):
            raise InputError(
                f"A sample has {len(pictures)} images, but {len(projections)} projections."
            )
        views = []
        for name, picture, projection in zip(names, pictures, projections, strict=True):
            if picture is not None:
                views.append(CameraView(name, picture, projection))
        return views

    def _bev_panels(
        self,
        truth: MapElements | None,
        predictions: MapElements | None,
        points: np.ndarray | None,
        note: str,
    ) -> list[BEVPanel]:
        """Create the chosen bird's-eye views for which the sample has data.

        Args:
            truth: Ground truth, if it is known.
            predictions: Predictions, if there are any.
            points: LiDAR points in metres in the annotation frame, drawn as faint dots. (n, >= 2)
            note: Text of panels without predictions.
        """
        panels = {}  # by name, in the order of `PANELS`
        if truth is not None:
            panels["ground_truth"] = BEVPanel(
                "Ground truth", truth, order=self.show_order, points=points
            )
        if predictions is not None:
            panels["prediction"] = BEVPanel(
                "Prediction",
                predictions,
                note=note,
                vertices=True,
                order=self.show_order,
                scores=True,
                points=points,
            )
            if truth is not None and "matches" in self.panels:
                hits = self._find_hits(predictions, truth)
                title = f"Hits within {self.match_m:g} m"
                panels["matches"] = BEVPanel(title, predictions, note=note, truth=truth, hits=hits)
            if predictions.has_gaussians:
                title = "Gaussians (1\N{GREEK SMALL LETTER SIGMA})"
                panels["gaussians"] = BEVPanel(
                    title, predictions, note=note, lines=False, gaussians=True
                )
                if "rasters" in self.panels:
                    masks = self._render_masks(predictions) if len(predictions) else None
                    panels["rasters"] = BEVPanel(
                        "Rendered masks", predictions, note=note, lines=False, rasters=masks
                    )
        return [panel for name, panel in panels.items() if name in self.panels]

    def _find_hits(self, predictions: MapElements, truth: MapElements) -> np.ndarray:
        """Index of the ground truth that each prediction hits, or -1. (N,)"""
        config = ChamferConfig(tuple(self.style.classes), (self.match_m,))
        matches = match_chamfer(predictions, truth, config)
        hits = np.full(len(predictions), -1)
        # The matches are sorted and may lack predictions. `pred_index` has their original indices.
        hits[matches.pred_index] = matches.matched_gt[:, 0]  # at the only threshold
        return hits

    def _render_masks(self, elements: MapElements) -> np.ndarray:
        """Render the Gaussians of each element to occupancy in [0, 1] (GSMap Eq. 6). (N, H, W)"""
        # Elements with Gaussians all have P points, so that their flat arrays can be split evenly.
        tensors = []
        for values in (elements.points[:, :2], elements.scales, elements.rotations):
            flat = torch.as_tensor(values, dtype=torch.float32)  # (N * P, 2) or (N * P,)
            tensors.append(flat.unflatten(0, (len(elements), -1)))  # (N, P, 2) or (N, P)
        means, scales, rotations = tensors
        with torch.no_grad():
            masks = render_gaussians(means, scales=scales, rotations=rotations, grid=self.grid)
        return masks.numpy()

    def draw_sample(
        self,
        data_sample: Any,
        images: Sequence[np.ndarray] | None = None,
        score_thr: float | None = None,
        points: np.ndarray | None = None,
    ) -> Figure:
        """Compose the picture of one sample.

        Args:
            data_sample: A ``Det3DDataSample`` as described in ``docs/architecture.md``.
            images: RGB images after augmentation; by default the original files are read.
                V x (h, w, 3) uint8
            score_thr: Smallest score of a drawn prediction, in [0, 1]; by default ``score_thr`` of
                the visualizer.
            points: LiDAR points in metres in the annotation frame, drawn as faint dots. (n, >= 2)

        Returns:
            Figure, not rendered yet.

        Raises:
            ValueError: If the sample has neither images nor a map, if its images do not fit its
                cameras or cannot be read, or if the annotation frame is not known.
        """
        meta = data_sample.metainfo
        truth = ground_truth_elements(data_sample)
        threshold = self.score_thr if score_thr is None else score_thr
        predictions = predicted_elements(data_sample)
        note = "no elements"
        if predictions:  # neither None nor empty
            highest = predictions.confidence.max()
            note = f"no score reaches {threshold:g}\n(highest {highest:.2g})"
            predictions = predictions.select(predictions.confidence >= threshold)
        return compose_figure(
            self.cameras(meta, images),
            self._bev_panels(truth, predictions=predictions, points=points, note=note),
            grid=self.grid,
            view=self.frame_view(meta),
            style=self.style,
            camera_elements=truth if predictions is None else predictions,
            title=sample_title(meta),
            width_px=self.width_px,
        )

    @master_only
    def add_datasample(
        self,
        name: str,
        image: Sequence[np.ndarray] | None,
        data_sample: Any,
        step: int = 0,
        points: np.ndarray | None = None,
    ) -> None:
        """Draw one sample to the backends (TensorBoard, ``vis_data``).

        Args:
            name: Tag of the picture in the backends.
            image: RGB images after augmentation, as in `draw_sample`. V x (h, w, 3) uint8
            data_sample: A ``Det3DDataSample`` as described in ``docs/architecture.md``.
            step: Training step.
            points: LiDAR points in metres in the annotation frame, drawn as faint dots. (n, >= 2)
        """
        figure = self.draw_sample(data_sample, image, points=points)
        self.add_image(name, figure_to_rgb(figure), step)
