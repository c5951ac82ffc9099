"""Maps of the places of a run: which frames share one, and which are refused."""

import numpy as np
import pytest
import torch
from prior_cases import CLASSES, frames, pose_at

from gsmap.prior import (
    ElementPrior,
    ElementRule,
    GaussianPrior,
    KeepMaximum,
    LastSeen,
    MapPrior,
    PriorSettings,
)
from gsmap.prior.places import GivenMaps, Place, PlaceMaps
from gsmap.structures.elements import MapElements
from gsmap.structures.grid import BEVGrid

WINDOW = BEVGrid((-15, 15), (-30, 30), 48, 24)  # cells of 1.25 m
TOWN = PriorSettings(CLASSES, "town", cell_m=1.25)


def place(town="town", scene="a", x=0.0):
    return Place("token", name=town, scene=scene, pose=pose_at(x))


def raster(value=1.0):
    return torch.full((3, 48, 24), value)


def empty_maps(memory="kept", rule=None):
    return PlaceMaps(CLASSES, WINDOW, rule=rule or KeepMaximum(), memory=memory)


@pytest.mark.parametrize(
    ("memory", "of_scene", "of_town"), [("kept", 1, 1), ("scene", 1, 0), ("none", 0, 0)]
)
def test_frames_share_a_map_by_town_or_by_scene(memory, of_scene, of_town):
    maps = empty_maps(memory)
    maps.write(place(), raster())
    assert maps.read(place()).amax() == of_scene
    assert maps.read(place(scene="b")).amax() == of_town
    assert maps.read(place(town="city")).amax() == 0
    assert maps.read(place(x=500.0)).amax() == 0


def test_without_the_name_of_a_town_a_scene_has_its_own_map():
    maps = empty_maps()
    maps.write(place(town=""), raster())
    assert maps.read(place(town="")).amax() == 1
    assert maps.read(place(town="", scene="b")).amax() == 0


def test_a_frame_without_a_pose_reads_and_writes_nothing():
    (sample,) = frames(None)
    assert Place.of(sample.metainfo) is None
    maps = empty_maps()
    maps.write(None, raster())
    assert not maps.read(None).any()
    with pytest.raises(ValueError, match="lidar2global of sample 'a' must be a rigid motion"):
        Place.of({"token": "a", "lidar2global": np.full((4, 4), np.nan)})


def test_many_scenes_do_not_fill_memory():
    maps = empty_maps("scene")
    for number in range(40):
        maps.write(place(scene=str(number)), raster())
    assert maps.read(place(scene="39")).amax() == 1
    assert maps.read(place(scene="0")).amax() == 0


def test_given_priors_are_read_and_written_only_on_request():
    for update in (False, True):
        prior = MapPrior(TOWN, LastSeen())
        maps = GivenMaps([prior], CLASSES, grid=WINDOW, update=update)
        maps.write(place(), raster())
        assert prior.read(pose_at(0), WINDOW).amax() == float(update)
        assert maps.read(place(town="")).amax() == float(update)  # the only one that there is


def test_a_gaussian_prior_is_drawn_in_the_cells_of_a_window_and_not_written():
    prior = GaussianPrior(PriorSettings(CLASSES, "town"))
    line = np.array([[3.0, -20.0], [3.0, 20.0]])
    elements = MapElements.from_polylines([line], [2])
    for _ in range(3):
        prior.write(pose_at(0), WINDOW, elements=elements)
    window = GivenMaps([prior], CLASSES, grid=WINDOW).read(place())
    assert window.shape == raster().shape
    rows, columns = (window[2] > 0.5).nonzero().unbind(-1)
    assert len(rows) >= 24  # 40 m, cells of 1.25 m
    assert (columns == 14).all()  # x of 2.5 to 3.75 m
    assert not window[:2].any()
    with pytest.raises(ValueError, match="has Gaussians, which a model can only read"):
        GivenMaps([prior], CLASSES, grid=WINDOW, update=True)


def test_a_prior_of_elements_is_drawn_and_not_written():
    line = np.array([[3.0, -20.0], [3.0, 20.0]])
    elements = MapElements.from_polylines([line], [2], scores=[0.75])
    prior = ElementPrior(PriorSettings(CLASSES, "town"), elements, ElementRule(line_width_m=1.25))
    window = GivenMaps([prior], CLASSES, grid=WINDOW).read(place())
    assert window.shape == raster().shape
    rows, columns = (window[2] > 0.5).nonzero().unbind(-1)
    assert rows.tolist() == list(range(8, 40))  # y of -20 to 20 m, cells of 1.25 m
    assert (columns == 14).all()  # x of 2.5 to 3.75 m
    assert not window[:2].any()
    with pytest.raises(ValueError, match="has elements, which a model can only read"):
        GivenMaps([prior], CLASSES, grid=WINDOW, update=True)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            PriorSettings(("divider", "boundary"), "town", cell_m=1.25),
            "prior of 'town' has classes",
        ),
        (PriorSettings(CLASSES, "town", cell_m=2.5), r"has cell_m 2\.5, and 1\.25 is needed"),
        (PriorSettings(CLASSES, "town", cell_m=1.25, tile_m=30.0), "has tile_m"),
    ],
)
def test_a_prior_of_other_classes_or_cells_is_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        GivenMaps([MapPrior(settings)], CLASSES, grid=WINDOW)


@pytest.mark.parametrize("kind", [MapPrior, GaussianPrior, ElementPrior])
def test_frames_with_nothing_of_a_prior_in_range_are_counted(kind):
    elements = MapElements.from_polylines([np.array([[3.0, -20.0], [3.0, 20.0]])], [2])
    prior = kind(TOWN, elements) if kind is ElementPrior else kind(TOWN)
    if kind is MapPrior:
        prior.write(pose_at(0), WINDOW, values=raster())
    if kind is GaussianPrior:
        for _ in range(3):
            prior.write(pose_at(0), WINDOW, elements=elements)
    for x in (0.0, 0.0, 500.0):
        GivenMaps([prior], CLASSES, grid=WINDOW).read(place(x=x))  # as each frame of a `LiveMap`
    assert (prior.reads.samples, prior.reads.empty) == (3, 1)


def test_a_frame_elsewhere_is_refused():
    maps = GivenMaps([MapPrior(TOWN)], CLASSES, grid=WINDOW)
    with pytest.raises(ValueError, match=r"sample 'token' is in 'city', and .* of \['town'\]"):
        maps.read(place(town="city"))
    with pytest.raises(ValueError, match="a sample has none"):
        maps.read(None)
    with pytest.raises(ValueError, match="two priors are of 'town'"):
        GivenMaps([MapPrior(TOWN), MapPrior(TOWN)], CLASSES, grid=WINDOW)
    with pytest.raises(ValueError, match="the list of priors is empty"):
        GivenMaps([], CLASSES, grid=WINDOW)


def test_settings_out_of_range_are_refused():
    with pytest.raises(ValueError, match="memory of a prior must be one of"):
        empty_maps("sometimes")
    oblong = BEVGrid((-15, 15), (-30, 30), 48, 48)
    with pytest.raises(ValueError, match="cells of a prior must be squares"):
        PlaceMaps(CLASSES, oblong, rule=KeepMaximum())
