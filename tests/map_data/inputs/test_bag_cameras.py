"""Cameras of a bag: every field of their camera info counts, and one bad camera costs itself."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from bag_cases import PINHOLE, START_NS, Recorder, Straight, at, jpeg, options, picture

from mapdata.bag_cameras import ImageTopic, build_camera, is_rectified
from mapdata.bag_topics import parse_topics
from mapdata.inputs import open_input

BENT = np.array([-0.3, 0.1, 0.0, 0.0, 0.0])
PROJECTION = np.array([[200.0, 0, 150, 0], [0, 200, 80, 0], [0, 0, 1, 0]])


@pytest.fixture
def straight(tmp_path):
    """A drive of half a second to record, its bag in the test's folder."""
    return Straight(Recorder(tmp_path / "drive", "sqlite"), count=6)


def names_of(source):
    return {camera.name for sample in source.samples for camera in sample.cameras}


def info(**changed):
    """Return a camera info of 320 x 180 pixels."""
    roi = SimpleNamespace(x_offset=0, y_offset=0, width=0, height=0, do_rectify=False)
    fields = {
        "width": 320, "height": 180, "distortion_model": "plumb_bob", "d": np.zeros(5),
        "k": PINHOLE.ravel(), "p": PROJECTION.ravel(), "binning_x": 0, "binning_y": 0, "roi": roi,
    }  # fmt: skip
    return SimpleNamespace(**fields | changed)


def made(size_px, topic="/front/image_raw", **changed):
    """Return the camera of an info whose images have a size, and the notes."""
    images = ImageTopic(times_ns=[1], sizes_px=[size_px])
    return build_camera("front", images, info(**changed), (topic, "/front/camera_info"), np.eye(4))


def region(x, y, width, height):
    return SimpleNamespace(x_offset=x, y_offset=y, width=width, height=height, do_rectify=False)


@pytest.mark.parametrize(
    ("size_px", "changed", "focal_px", "centre_px"),
    [
        ((320, 180), {}, (250, 250), (160, 90)),
        ((160, 90), {"binning_x": 2, "binning_y": 2}, (125, 125), (80, 45)),
        ((320, 90), {"binning_x": 1, "binning_y": 2}, (250, 125), (160, 45)),
        ((100, 60), {"roi": region(40, 20, 100, 60)}, (250, 250), (120, 70)),
        (
            (50, 30),
            {"roi": region(40, 20, 100, 60), "binning_x": 2, "binning_y": 2},
            (125, 125),
            (60, 35),
        ),
    ],
)
def test_binning_and_region_of_interest_count_as_in_image_geometry(
    size_px, changed, focal_px, centre_px
):
    camera, notes = made(size_px, **changed)
    assert camera.size_px == size_px
    assert notes == []
    expected = [[focal_px[0], 0, centre_px[0]], [0, focal_px[1], centre_px[1]], [0, 0, 1]]
    np.testing.assert_allclose(camera.intrinsics, expected)


def test_binning_is_not_applied_to_images_that_have_all_pixels():
    camera, (note,) = made((320, 180), binning_x=2, binning_y=2)
    np.testing.assert_array_equal(camera.intrinsics, PINHOLE)
    assert "its images have all (320, 180) pixels, so that neither is applied" in note


def test_images_of_a_size_that_nothing_explains_are_refused_with_the_topic():
    with pytest.raises(
        ValueError, match=r"camera 'front': its camera info /front/camera_info says \(320, 180\) "
        r"pixels, binning \(2, 2\) .* its images have \(200, 90\)",
    ):  # fmt: skip
        made((200, 90), binning_x=2, binning_y=2)


@pytest.mark.parametrize(
    ("topic", "changed", "expected"),
    [
        ("/front/image_raw", {"k": np.zeros(9)}, PROJECTION[:, :3]),
        ("/front/image_raw", {"k": np.zeros(0)}, PROJECTION[:, :3]),
        ("/front/image_rect", {"p": np.zeros(12)}, PINHOLE),
        ("/front/image_rect", {"d": BENT}, PROJECTION[:, :3]),
    ],
)
def test_the_other_matrix_stands_for_an_empty_one_and_it_is_said(topic, changed, expected):
    camera, (note,) = made((320, 180), topic, **changed)
    np.testing.assert_array_equal(camera.intrinsics, expected)
    assert not camera.is_distorted
    assert "/front/camera_info" in note


def test_a_fisheye_of_zeros_is_taken_as_rectified_and_it_is_said():
    """As image_geometry does."""
    camera, (note,) = made((320, 180), distortion_model="equidistant", d=np.zeros(4))
    assert not camera.is_distorted
    assert "coefficients that are all zero: its images are taken as rectified" in note
    _, notes = made((320, 180), "/front/image_rect", distortion_model="equidistant", d=np.zeros(4))
    assert notes == []
    _, notes = made((320, 180), distortion_model="plumb_bob", d=np.zeros(5))
    assert notes == []


@pytest.mark.parametrize(
    ("topic", "changed", "message"),
    [
        ("/front/image_raw", {"k": np.zeros(9), "p": np.zeros(12)}, "K and P have no focal length"),
        ("/front/image_raw", {"k": np.full(9, np.nan), "p": np.zeros(12)}, "K and P have no focal"),
        ("/front/image_raw", {"k": np.zeros(9), "d": BENT}, "P alone is not enough with its dist"),
        ("/front/image_rect", {"p": np.zeros(12), "d": BENT}, "K alone is not enough with its"),
        ("/front/image_raw", {"k": np.zeros(8)}, "its camera info has 8 numbers in K"),
    ],
)
def test_a_camera_info_that_says_too_little_is_refused(topic, changed, message):
    with pytest.raises(ValueError, match=message):
        made((320, 180), topic, **changed)


@pytest.mark.parametrize(
    ("topic", "expected"),
    [
        ("/front/image_rect", True),
        ("/front/image_rect_color/compressed", True),
        ("/front/rectified/image", True),
        ("/front/image_raw", False),
        ("/front/image_unrectified/compressed", False),
        ("/front/image_non_rect", False),
        ("/direct/image", False),
        ("/corrected/image", False),
    ],
)
def test_a_word_of_the_topic_says_whether_images_are_rectified(topic, expected):
    assert is_rectified(topic) is expected


def test_images_of_an_unrectified_topic_are_rectified(straight, tmp_path):
    straight.recorder.image_topic = "/{}/image_unrectified"

    def bent(camera, time_ns):
        straight.recorder.info(camera, time_ns, BENT, p=PROJECTION.ravel())

    source = open_input(straight.write(info=bent), options(tmp_path))
    camera = source.samples[0].cameras[0]
    np.testing.assert_array_equal(camera.intrinsics, PINHOLE)
    found = cv2.imread(str(source.data_root / camera.path)).astype(int)
    assert np.abs(found - cv2.undistort(picture(), PINHOLE, BENT)).mean() < 3


def test_the_first_camera_info_that_is_calibrated_counts(straight, tmp_path):
    def late(camera, time_ns):
        empty = {"k": np.zeros(9), "p": np.zeros(12)} if time_ns == straight.times_ns[0] else {}
        straight.recorder.info(camera, time_ns, **empty)

    source = open_input(straight.write(info=late), options(tmp_path))
    np.testing.assert_array_equal(source.samples[0].cameras[0].intrinsics, PINHOLE)


def test_images_without_a_frame_are_where_their_camera_info_is(straight, tmp_path):
    def image(camera, time_ns):
        header = straight.recorder.header(time_ns, "")
        straight.recorder.image(camera, time_ns, jpeg(), header=header)

    source = open_input(straight.write(image=image), options(tmp_path))
    assert names_of(source) == {"front", "rear"}


def no_place(straight):
    mount = straight.mount
    return {"mount": lambda camera: camera.name == "front" and mount(camera)}


def odd_lens(straight):
    def bad(camera, time_ns):
        changed = {} if camera.name == "front" else {"distortion_model": "omni"}
        straight.recorder.info(camera, time_ns, BENT if changed else (), **changed)

    return {"info": bad}


def depth(straight):
    def image(camera, time_ns):
        if camera.name == "front":
            straight.recorder.image(camera, time_ns, jpeg())
        else:
            millimetres = np.full((180, 320), 3000, np.uint16)
            straight.recorder.image(camera, time_ns, jpeg(), "bgr8", encoding="16UC1", step=640,
                                    data=millimetres.view(np.uint8).ravel())  # fmt: skip

    return {"image": image}


def packed_depth(straight):
    png = cv2.imencode(".png", np.full((180, 320), 3000, np.uint16))[1].ravel()

    def image(camera, time_ns):
        changed = (
            {} if camera.name == "front" else {"format": "16UC1; png compressed ", "data": png}
        )
        straight.recorder.image(camera, time_ns, jpeg(), **changed)

    return {"image": image}


def video(straight):
    def image(camera, time_ns):
        changed = {} if camera.name == "front" else {"format": "h264"}
        straight.recorder.image(camera, time_ns, jpeg(), **changed)

    return {"image": image}


def of_other_size(straight):
    def image(camera, time_ns):
        straight.recorder.image(camera, time_ns, jpeg() if camera.name == "front" else jpeg(64, 64))

    return {"image": image}


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        (no_place, "no transform leads from its frame 'rear_optical' to 'base_link'"),
        (odd_lens, "distortion model 'omni'"),
        (depth, "it has the encoding '16UC1'"),
        (packed_depth, "it is a depth image ('16UC1; png compressed')"),
        (video, "it is a frame of video ('h264')"),
        (of_other_size, "its images have (64, 64)"),
    ],
)
def test_a_camera_that_cannot_be_used_costs_itself_and_an_asked_for_one_is_refused(
    straight, tmp_path, fault, reason
):
    path = straight.write(**fault(straight))
    source = open_input(path, options(tmp_path))
    assert names_of(source) == {"front"}
    assert len(source.samples) == 6
    (note,) = source.notes
    assert note.startswith("/rear/image_raw")
    assert "is left out: camera 'rear'" in note
    assert reason in note
    assert "--topics" in note
    topic = note.split()[0]
    asked = options(tmp_path, topics=parse_topics([f"rear={topic},/rear/camera_info"]))
    if fault in (depth, packed_depth, video):  # its frames are broken, each with the reason
        assert all(reason in note for note in open_input(path, asked).notes)
    else:
        with pytest.raises(ValueError, match="camera 'rear'"):
            open_input(path, asked)


@pytest.mark.parametrize(
    ("encoding", "order"),
    [("yuyv", "YUYV"), ("yuv422_yuy2", "YUYV"), ("uyvy", "UYVY"), ("yuv422", "UYVY")],
)
def test_yuv_of_either_order_of_bytes_keeps_its_colours(straight, tmp_path, encoding, order):
    """The bytes are made of the picture by the equations of ITU-R BT.601."""
    luma, chroma = order.index("Y"), 1 - order.index("Y")
    blue, green, red = np.moveaxis(picture().astype(float), -1, 0)
    y = 16 + 0.257 * red + 0.504 * green + 0.098 * blue
    u = 128 - 0.148 * red - 0.291 * green + 0.439 * blue
    v = 128 + 0.439 * red - 0.368 * green - 0.071 * blue
    yuv = np.stack([y, u, v], -1).round().astype(np.uint8)
    packed = np.zeros((180, 330, 2), np.uint8)  # rows have a step
    packed[:, :320, luma] = yuv[..., 0]
    packed[:, 0:320:2, chroma], packed[:, 1:320:2, chroma] = yuv[:, ::2, 1], yuv[:, ::2, 2]

    def image(camera, time_ns):
        straight.recorder.image(
            camera, time_ns, jpeg(), "bgr8", encoding=encoding, step=660, data=packed.ravel()
        )

    source = open_input(straight.write(image=image), options(tmp_path))
    assert source.notes == ()
    found = cv2.imread(str(source.data_root / source.samples[0].cameras[0].path)).astype(int)
    assert np.abs(found - picture()).mean() < 4


def test_camera_infos_and_static_transforms_that_change_are_counted(straight, tmp_path):
    def info(camera, time_ns):
        matrix = PINHOLE if time_ns < straight.times_ns[4] else 2 * PINHOLE
        straight.recorder.info(camera, time_ns, k=matrix.ravel())

    def before():
        for ahead_m in (1.0, 3.0, 1.0):
            straight.recorder.transform(
                "/tf_static", START_NS, "base_link", "front_optical", at(ahead_m)
            )

    source = open_input(straight.write(info=info, before=before), options(tmp_path))
    changed = [note for note in source.notes if "2 messages of the camera info of" in note]
    assert len(changed) == 2
    assert "'front_optical' to 'base_link' (4 messages on /tf_static) differ" in source.notes[-1]
    assert source.notes[-1].startswith("2 of the transforms")
