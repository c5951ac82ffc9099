"""Films of drives: a frame for each sample, tracks that keep their colour, and what is refused."""

import json

import av
import cv2
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from report_case import FRAMES, STRANGE, write_case

from gsmap.datasets.annotations.file import AnnotationFile, write_annotations
from gsmap.visualization import film
from gsmap.visualization.style import track_colours


def frames_of(path) -> list[np.ndarray]:
    with av.open(str(path)) as opened:
        return [frame.to_ndarray(format="rgb24") for frame in opened.decode(video=0)]


def share_of(picture: np.ndarray, colour: str) -> float:
    """Return the share of pixels that nearly have a colour; compression moves it a little."""
    wanted = 255 * np.array(to_rgb(colour))
    return float((np.abs(picture - wanted).max(-1) < 40).mean())


def test_a_drive_has_a_frame_for_each_sample_as_fast_as_it_was(tmp_path):
    annotations, results = write_case(tmp_path)
    path = tmp_path / "drive.mp4"
    said = film.write_drive_film(path, annotations, results, width_px=480)
    assert said == f"{STRANGE}, {FRAMES} frames: {path}"
    shown = frames_of(path)
    assert len(shown) == FRAMES
    assert shown[0].shape[1] == 480
    with av.open(str(path)) as opened:
        assert opened.streams.video[0].average_rate == 1  # samples are a second apart
    film.write_drive_film(path, annotations, results, images=False, max_frames=2, width_px=480)
    shorter = frames_of(path)
    assert len(shorter) == 2
    assert shorter[0].shape[0] < shown[0].shape[0]  # without cameras


def test_pictures_of_equal_times_do_not_make_a_film_faster(tmp_path):
    """Two drives that are joined, each with a picture at 0, 0.5 and 1 s."""
    path = tmp_path / "joined.mp4"
    pictures = [np.full((32, 32, 3), level, np.uint8) for level in range(0, 240, 40)]
    for times_s, rate in (([0, 0, 0.5, 0.5, 1, 1], 2), ([0] * 6, 2), ([0, 2, 4, 6, 8, 10], 0.5)):
        film.write_film(path, pictures, [int(time_s * 1e9) for time_s in times_s])
        with av.open(str(path)) as opened:
            assert opened.streams.video[0].average_rate == rate


def test_an_element_keeps_the_colour_of_its_track(tmp_path):
    annotations, results = write_case(tmp_path)
    found = json.loads(results["good"].read_text())
    for number, sample in enumerate(found["results"]):
        for vector, track in zip(sample["vectors"], (4, 7 + number, -1), strict=True):
            vector["track_id"] = track
    results["good"].write_text(json.dumps(found))
    path = tmp_path / "drive.mp4"
    one = {"good": results["good"]}
    film.write_drive_film(path, annotations, one, images=False, width_px=960)
    stays, first, later = track_colours([4, 7, 7 + FRAMES - 1])
    start, end = (frames_of(path)[index] for index in (0, -1))
    assert min(share_of(start, stays), share_of(end, stays)) > 5e-4
    assert share_of(start, first) > 5e-4 > share_of(end, first)
    assert share_of(end, later) > 5e-4 > share_of(start, later)


def test_tracks_have_colours_of_their_own_always_the_same():
    colours = track_colours(range(12))
    assert len(set(colours)) == 12
    assert track_colours([11, 3]) == [colours[11], colours[3]]
    assert track_colours([-1])[0] not in colours


def test_a_scene_that_does_not_exist_is_named_with_one_that_does(tmp_path):
    annotations, results = write_case(tmp_path)
    with pytest.raises(ValueError, match="no scene 'scene-0003': give one of its 1, such as"):
        film.write_drive_film(tmp_path / "no.mp4", annotations, results, scene="scene-0003")
    with pytest.raises(ValueError, match="results must name at least one result file"):
        film.write_drive_film(tmp_path / "no.mp4", annotations, {})
    write_annotations(annotations, AnnotationFile(annotations).meta, [])
    for scene in (None, STRANGE):
        with pytest.raises(ValueError, match="has no samples to show"):
            film.write_drive_film(tmp_path / "no.mp4", annotations, results, scene=scene)
    assert not (tmp_path / "no.mp4").exists()


def test_pictures_of_other_sizes_are_shrunk_and_padded(tmp_path):
    """A drive whose later samples have more cameras, which make the picture higher."""
    pictures = [np.zeros((60, 80, 3), np.uint8), np.zeros((120, 80, 3), np.uint8)]
    film.write_film(tmp_path / "film.mp4", pictures, [0, 10**9])
    small, large = frames_of(tmp_path / "film.mp4")
    assert small.shape == large.shape == (60, 80, 3)
    assert large[:, :38].max() < 40
    assert large[:, 42:].min() > 215


def test_an_image_of_another_size_than_its_calibration_is_refused(tmp_path):
    annotations, results = write_case(tmp_path)
    path = next(tmp_path.rglob("*.jpg"))
    small = cv2.resize(cv2.imread(str(path)), dsize=None, fx=0.5, fy=0.5)
    cv2.imwrite(str(path), small)
    with pytest.raises(ValueError, match=r"sample 't0', camera .* pixels"):
        film.write_drive_film(tmp_path / "no.mp4", annotations, results)


def test_elements_of_other_classes_are_not_drawn_and_lines_may_be_empty(tmp_path):
    annotations, results = write_case(tmp_path)
    other = {"cls_name": "centerline", "pts": [[0, 0], [0, 9]]}
    empty = {"cls_name": "boundary", "pts": []}
    drawn = []
    for more in ((), (other, empty)):
        content = json.loads(results["good"].read_text())
        for sample in content["results"]:
            sample["vectors"] += [{**vector, "confidence_level": 0.9} for vector in more]
        for sample in content["results"]:
            for vector in sample["vectors"]:
                vector.pop("gaussian_scales", None)
                vector.pop("gaussian_rotations", None)
        file = tmp_path / f"results{len(more)}.json"
        file.write_text(json.dumps(content))
        path = tmp_path / f"{len(more)}.mp4"
        said = film.write_drive_film(path, annotations, {"a": file}, max_frames=1, width_px=480)
        assert ("; 1 element of other classes left out" in said) == bool(more)
        assert ("; 1 element of fewer than two points left out" in said) == bool(more)
        drawn.append(frames_of(path)[0])
    np.testing.assert_array_equal(*drawn)


@pytest.mark.parametrize("bad", [{"max_frames": 0}, {"score_thr": 1.5}])
def test_numbers_out_of_range_are_refused(tmp_path, bad):
    annotations, results = write_case(tmp_path)
    (name,) = bad
    with pytest.raises(ValueError, match=f"{name} must be"):
        film.write_drive_film(tmp_path / "drive.mp4", annotations, results, **bad)
