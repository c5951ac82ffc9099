"""MMEngine's visualizer for vectorized maps."""

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
RASTER_SIZE = (400, 200)  # rows and columns of rendered masks


def images_from_inputs(images: torch.Tensor) -> list[np.ndarray]:
    """Turn a pipeline's images back into pictures.

    BGR, 0 to 255, before normalisation (V, 3, H, W) -> RGB, V x (H, W, 3) uint8

    Raises:
        ValueError: If the shape is wrong.
    """
    if images.ndim != 4 or images.shape[1] != 3:
        raise InputError(f"images must have shape (V, 3, H, W), got {tuple(images.shape)}.")
    pixels = images.flip(1).permute(0, 2, 3, 1).float().round().clamp(0, 255).to(torch.uint8)
    return list(pixels.cpu().numpy())


def ground_truth_elements(data_sample: Any) -> MapElements | None:
    """Read a ``Det3DDataSample``'s ground truth, at full resolution, or else its training targets.

    It is None if neither ``eval_ann_info`` nor ``gt_instances_3d`` is known.
    """
    info = data_sample.metainfo.get("eval_ann_info")
    if info is not None:
        return elements_of_truth(info)
    instances = getattr(data_sample, "gt_instances_3d", ())
    return elements_of_targets(instances) if "pts" in instances else None


def predicted_elements(data_sample: Any) -> MapElements | None:
    """Read a ``Det3DDataSample``'s predictions, the most confident last, to be drawn on top.

    It is None if there are no ``pred_instances_3d``.
    """
    instances = getattr(data_sample, "pred_instances_3d", ())
    if "pts" not in instances:
        return None
    found = elements_of_predictions(instances)
    return found.select(np.argsort(found.confidence, kind="stable"))


@VISUALIZERS.register_module()
class MapVisualizer(Visualizer):
    """Draws samples: the map over the cameras, and bird's-eye views of truth and prediction.

    Extent, classes and frame come from the data set's ``metainfo`` (``dataset_meta``, which the
    runner sets). The prediction is drawn over the cameras, or else the ground truth.

    Args:
        ground_z_m: Level ground at this z of the frame. By default the ground follows the sensor's
            mounting (``lidar2ego`` of the sample), or else the height that the annotation file
            has, or the frame's usual one.
        score_thr: Smallest score of a drawn prediction.
        panels: Which bird's-eye views to draw, of ``PANELS``; those that a sample has no data
            for are left out.
        match_m: Largest Chamfer distance of a hit in ``matches``, in metres, as in AP_chamfer.
        show_order: Whether to mark the start and direction of elements.
        width_px: Width of the picture.
        style: Other options of ``MapStyle``, by name.
        **kwargs: Options of mmengine's ``Visualizer``: ``vis_backends``, ``save_dir``.

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
        x_range, y_range = meta.get("x_range", (-15.0, 15.0)), meta.get("y_range", (-30.0, 30.0))
        return BEVGrid(x_range, y_range, *RASTER_SIZE)

    @property
    def style(self) -> MapStyle:
        """Colours and widths, with the data set's classes."""
        classes = (self.dataset_meta or {}).get("classes", MapStyle.classes)
        return MapStyle(**{"classes": tuple(classes), **self.style_options})

    def frame_view(self, metainfo: dict) -> FrameView:
        """Return orientation and ground plane for a sample with this meta data."""
        frame = (self.dataset_meta or {}).get("frame", "lidar")
        if frame not in FRAME_VIEWS:
            raise InputError(
                f"No view is known for frame {frame!r}, only for {sorted(FRAME_VIEWS)}; "
                "add one to gsmap.structures.frames.FRAME_VIEWS."
            )
        view = frame_view(frame, (self.dataset_meta or {}).get("ground_z_m"))
        if self.ground_z_m is not None:
            return replace(view, ground=(0.0, 0.0, self.ground_z_m))
        return view.with_mounting(metainfo.get("lidar2ego"))

    def cameras(
        self, metainfo: dict, images: Sequence[np.ndarray] | None = None
    ) -> list[CameraView]:
        """Pair a sample's images with their projections; a camera whose path is None is left out.

        ``images`` are RGB in the geometry that the model sees (after augmentation); None reads the
        original files, if there are any, and takes the augmentation out of the projections.

        Raises:
            ValueError: If the numbers of images and projections disagree, or a file is missing or
                damaged.
        """
        paths = metainfo.get("img_path")
        if images is None and paths is None:
            return []
        projections = np.asarray(metainfo["lidar2img"], dtype=np.float64)  # (V, 4, 4)
        names = metainfo.get("cam_names") or [f"camera {i}" for i in range(len(projections))]
        found: list[Any] = list(images or ())
        if images is None:
            if metainfo.get("img_aug_matrix") is not None:
                unscaled = np.linalg.inv(np.asarray(metainfo["img_aug_matrix"], np.float64))
                projections = unscaled @ projections
            where = f"sample {metainfo.get('token')!r}"
            found = [None if p is None else read_image(p, where)[..., ::-1] for p in paths or ()]
        if len(found) != len(projections):
            raise InputError(
                f"A sample has {len(found)} images, but {len(projections)} projections."
            )
        triples = zip(names, found, projections, strict=True)
        return [CameraView(*triple) for triple in triples if triple[1] is not None]

    def _bev_panels(
        self,
        truth: MapElements | None,
        found: MapElements | None,
        points: np.ndarray | None,
        note: str,
    ) -> list[BEVPanel]:
        """Choose the bird's-eye views that the sample has data for."""
        panels = {}
        both: dict[str, Any] = {"order": self.show_order, "points": points}
        if truth is not None:
            panels["ground_truth"] = BEVPanel("Ground truth", truth, **both)
        if found is not None:
            title = "Prediction"
            panels["prediction"] = BEVPanel(title, found, note, vertices=True, scores=True, **both)
        if found is not None and truth is not None and "matches" in self.panels:
            rules = ChamferConfig(tuple(self.style.classes), (self.match_m,))
            matched, hits = match_chamfer(found, truth, rules), np.full(len(found), -1)
            hits[matched.pred_index] = matched.matched_gt[:, 0]
            title = f"Hits within {self.match_m:g} m"
            panels["matches"] = BEVPanel(title, found, note, truth=truth, hits=hits)
        if found is not None and found.has_gaussians:
            title = "Gaussians (1\N{GREEK SMALL LETTER SIGMA})"
            panels["gaussians"] = BEVPanel(title, found, note, lines=False, gaussians=True)
            if "rasters" in self.panels:
                masks = self._render_masks(found) if len(found) else None
                title = "Rendered masks"
                panels["rasters"] = BEVPanel(title, found, note, lines=False, rasters=masks)
        return [panel for name, panel in panels.items() if name in self.panels]

    def _render_masks(self, elements: MapElements) -> np.ndarray:
        """Render every element's Gaussians to occupancy in [0, 1] (GSMap Eq. 6). (N, H, W)"""
        means, scales, rotations = (
            torch.as_tensor(values, dtype=torch.float32).unflatten(0, (len(elements), -1))
            for values in (elements.points[:, :2], elements.scales, elements.rotations)
        )
        with torch.no_grad():
            return render_gaussians(means, scales, rotations, self.grid).numpy()

    def draw_sample(
        self,
        data_sample: Any,
        images: Sequence[np.ndarray] | None = None,
        score_thr: float | None = None,
        points: np.ndarray | None = None,
    ) -> Figure:
        """Compose the picture of one sample.

        Args:
            data_sample: A ``Det3DDataSample`` as ``docs/architecture.md`` describes it.
            images: RGB images after augmentation; None reads the original files. V x (h, w, 3)
            score_thr: Smallest drawn score instead of the visualizer's own.
            points: LiDAR points in metres of the frame, drawn as faint dots. (n, >= 2)

        Raises:
            ValueError: If the sample has neither images nor a map.
        """
        meta = data_sample.metainfo
        truth = ground_truth_elements(data_sample)
        threshold = self.score_thr if score_thr is None else score_thr
        found, note = predicted_elements(data_sample), "no elements"
        if found:
            note = f"no score reaches {threshold:g}\n(highest {found.confidence.max():.2g})"
            found = found.select(found.confidence >= threshold)
        return compose_figure(
            self.cameras(meta, images),
            self._bev_panels(truth, found, points, note),
            self.grid,
            self.frame_view(meta),
            self.style,
            camera_elements=truth if found is None else found,
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
        """Draw one sample, as `draw_sample` does, to the backends (TensorBoard, ``vis_data``).

        ``name`` is its tag there, ``step`` the training step.
        """
        figure = self.draw_sample(data_sample, image, points=points)
        self.add_image(name, figure_to_rgb(figure), step)
