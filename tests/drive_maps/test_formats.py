import json
import math
import re
import sys
import warnings
from dataclasses import replace
from pathlib import Path
from unittest.mock import MagicMock

import av
import numpy as np
import pytest
import shapely
from drive_cases import CLASSES, drive_of
from PIL import Image

from drivemaps.drive import DriveFrame
from drivemaps.geodetic import MapGrid, MapOrigin, known_origin, require_near
from drivemaps.geojson import write_geojson
from drivemaps.lanelet2 import write_lanelet2
from drivemaps.mcap import write_mcap
from drivemaps.replay import Replay
from drivemaps.rerun import write_rerun
from drivemaps.truth import true_map
from drivemaps.video import write_video
from gsmap.datasets.annotations.record import AnnotationMeta, CameraRecord
from gsmap.datasets.errors import BrokenSampleError
from gsmap.datasets.image_files import encode_jpeg
from gsmap.structures.elements import MapElements

ORIGIN = MapOrigin(48.26, 11.67)
COLOURS = ("#FF9500", "#2D8CFF", "#1DB954")
JPEG = encode_jpeg(np.full((225, 400, 3), 90, np.uint8), 90)


@pytest.fixture(scope="module")
def true():
    return true_map(drive_of())


@pytest.fixture(scope="module")
def camera_drive(tmp_path_factory):
    """Three frames with a camera that looks ahead, and a Gaussian on each vertex."""
    root = tmp_path_factory.mktemp("images")
    cam_from_frame = np.eye(4)
    cam_from_frame[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    intrinsics = np.array([[200.0, 0.0, 200.0], [0.0, 200.0, 112.0], [0.0, 0.0, 1.0]])
    frames = []
    for number, frame in enumerate(drive_of().frames[:3]):
        name = f"{number}.jpg"
        (root / name).write_bytes(JPEG)
        camera = CameraRecord("CAM_FRONT", name, 400, 225, intrinsics, cam_from_frame)
        count = len(frame.elements.points)
        elements = replace(
            frame.elements, scales=np.full((count, 2), [0.4, 0.1]), rotations=np.zeros(count)
        )
        frames.append(DriveFrame(replace(frame.sample, cameras=[camera]), elements))
    return replace(drive_of(), frames=frames), root


def test_geojson_in_metres_holds_lines_and_polygons(tmp_path, true):
    write_geojson(tmp_path / "map.geojson", true, CLASSES, None)
    written = json.loads((tmp_path / "map.geojson").read_text())
    assert written["crs"] is None  # local: no program may take the metres for degrees
    features = written["features"]
    assert [f["properties"]["class"] for f in features] == [CLASSES[k] for k in true.labels]
    for feature, line in zip(features, true.polylines, strict=True):
        shape = shapely.geometry.shape(feature["geometry"])
        assert shape.geom_type == (
            "Polygon" if feature["properties"]["class"] == "ped_crossing" else "LineString"
        )
        if shape.geom_type == "Polygon":
            assert shape.exterior.is_ccw
            shape = shape.exterior
        assert shape.hausdorff_distance(shapely.LineString(line)) < 1e-4


def test_geojson_in_degrees_comes_back_within_a_millimetre(tmp_path, true):
    pyproj = pytest.importorskip("pyproj", reason="pip install -e .[maps]")
    write_geojson(tmp_path / "map.geojson", true, CLASSES, ORIGIN)
    written = json.loads((tmp_path / "map.geojson").read_text())
    assert written["crs"]["properties"]["name"].endswith("CRS84")
    features = written["features"]
    lon, lat = np.array(features[0]["geometry"]["coordinates"]).T
    azimuth, _, distance = pyproj.Geod(ellps="WGS84").inv(
        np.full(len(lon), ORIGIN.longitude_deg), np.full(len(lon), ORIGIN.latitude_deg), lon, lat
    )
    x, y = true.polylines[0].T
    # geodesics and a transverse Mercator grid differ by 1e-8 at a kilometre
    np.testing.assert_allclose(distance, np.hypot(x, y), atol=1e-3)
    np.testing.assert_allclose(np.radians(azimuth), np.arctan2(x, y), atol=1e-6)


def test_lanelet2_loads_the_map_within_a_centimetre(tmp_path, true):
    pytest.importorskip("pyproj", reason="pip install -e .[maps]")
    pytest.importorskip("lanelet2", reason="pip install lanelet2")
    import lanelet2.io
    import lanelet2.projection

    path = tmp_path / "map.osm"
    write_lanelet2(path, true, CLASSES, ORIGIN)
    origin = lanelet2.io.Origin(ORIGIN.latitude_deg, ORIGIN.longitude_deg)
    projector = lanelet2.projection.LocalCartesianProjector(origin)
    found, errors = lanelet2.io.loadRobust(str(path), projector)
    assert not list(errors)
    lines = [*found.lineStringLayer, *found.polygonLayer]
    assert len(lines) == len(true)
    by_class = {name: [] for name in CLASSES}
    for line in lines:
        by_class[line.attributes["class"]].append(np.array([[p.x, p.y] for p in line]))
    for label, points in zip(true.labels, true.polylines, strict=True):
        name = CLASSES[label]
        if name == "ped_crossing":  # a polygon's last vertex is not its first
            points = points[:-1]
        alike = [line for line in by_class[name] if line.shape == points.shape]
        assert min(np.abs(line - points).max() for line in alike) < 0.01


def test_origins_are_those_of_the_devkits():
    pyproj = pytest.importorskip("pyproj", reason="pip install -e .[maps]")
    del pyproj
    av2 = pytest.importorskip("av2.geometry.utm")
    meta = AnnotationMeta("av2", "ego", "val")
    points = np.array([[1200.0, -340.0], [0.0, 0.0]])
    expected = av2.convert_city_coords_to_wgs84(points, av2.CityName.PIT)[:, ::-1]
    found = known_origin(meta, "PIT").lon_lat(points)
    np.testing.assert_allclose(found, expected, atol=1e-9)
    assert known_origin(AnnotationMeta("nuscenes", "lidar", "val"), "boston-seaport") is not None
    assert known_origin(AnnotationMeta("minicity", "lidar", "val"), "boston-seaport") is None
    with pytest.raises(ValueError, match="latitude within 90"):
        MapOrigin(120.0, 0.0)


def test_a_map_off_the_earth_has_no_degrees(tmp_path):
    pytest.importorskip("pyproj", reason="pip install -e .[maps]")
    origin = MapOrigin(48.0, 11.0)
    for far_m in (1e9, 1e200, np.inf):
        line = np.array([[0.0, 0.0], [far_m, 1.0]])
        with pytest.raises(ValueError, match=r"the map reaches .* where there is no longitude"):
            origin.lon_lat(line)
    elements = MapElements.from_polylines([[[0.0, 0.0], [1e9, 1.0]]], [0], [1.0])
    for write in (write_geojson, write_lanelet2):
        with pytest.raises(ValueError, match="no longitude and latitude"):
            write(tmp_path / "map", elements, CLASSES, origin)
    assert not list(tmp_path.iterdir())


def test_the_map_grows_on_the_ground(camera_drive, true):
    drive, _ = camera_drive
    lengths = []
    for moment in Replay(drive, true, "lidar", ()).moments():
        lengths.append(sum(shapely.LineString(line[:, :2]).length for _, line in moment.map_lines))
        for local in moment.lines:
            np.testing.assert_allclose(local[:, 2], -1.84)
        for _, line in moment.map_lines:
            np.testing.assert_allclose(line[:, 2], 0.0, atol=1e-9)
        centres, half_axes, quaternions = moment.ellipses
        assert len(centres) == len(half_axes) == len(quaternions)
        np.testing.assert_allclose(half_axes[0], [0.8, 0.2])
    assert lengths[0] < lengths[1] < lengths[2]


def decoded(schema: object, message: object) -> object:
    """Read a message of an MCAP file by the schema that stands in it, without foxglove's code."""
    pytest.importorskip("google.protobuf", reason="pip install -e .[bags]")
    from google.protobuf import descriptor_pb2, message_factory

    files = descriptor_pb2.FileDescriptorSet.FromString(schema.data)
    return message_factory.GetMessages(files.file)[schema.name].FromString(message.data)


def test_mcap_holds_images_lines_and_gaussians_of_every_frame(tmp_path, camera_drive, true):
    pytest.importorskip("foxglove", reason="pip install -e .[viz]")
    reader = pytest.importorskip("mcap.reader", reason="pip install mcap")
    drive, root = camera_drive
    write_mcap(tmp_path / "drive.mcap", Replay(drive, true, "lidar", COLOURS, root))
    with (tmp_path / "drive.mcap").open("rb") as file:
        made = reader.make_reader(file)
        summary = made.get_summary()
        messages = [(c.topic, m.log_time, decoded(s, m)) for s, c, m in made.iter_messages()]
    for topic in ("/map", "/predictions", "/gaussians"):
        updates = [(time_ns, message) for name, time_ns, message in messages if name == topic]
        for time_ns, update in updates:
            (entity,) = update.entities
            assert entity.frame_locked  # the entity moves with its frame
            assert entity.frame_id == ("global" if topic == "/map" else "vehicle")
            assert entity.timestamp.ToNanoseconds() == time_ns
            assert bool(entity.spheres) == (topic == "/gaussians") != bool(entity.lines)
    projections = [list(m.P) for topic, _, m in messages if topic == "/CAM_FRONT/calibration"]
    assert projections == [[200, 0, 200, 0, 0, 200, 112, 0, 0, 0, 1, 0]] * len(drive.frames)
    counts = summary.statistics.channel_message_counts
    found = {channel.topic: counts[k] for k, channel in summary.channels.items()}
    topics = {
        "/map",
        "/predictions",
        "/gaussians",
        "/tf/vehicle",
        "/tf/CAM_FRONT",
        "/tf/base_footprint",
    }
    assert found == dict.fromkeys(
        topics | {"/CAM_FRONT/image", "/CAM_FRONT/calibration"}, len(drive.frames)
    )
    assert summary.statistics.message_start_time == drive.frames[0].sample.timestamp_ns


def test_rerun_recording_holds_cameras_lines_and_gaussians(tmp_path, camera_drive, true):
    pytest.importorskip("rerun", reason="pip install -e .[viz]")
    drive, root = camera_drive
    write_rerun(tmp_path / "drive.rrd", Replay(drive, true, "lidar", COLOURS, root))
    content = (tmp_path / "drive.rrd").read_bytes()
    assert content[:3] == b"RRF"
    for entity in (b"/world/map", b"/world/vehicle/CAM_FRONT", b"predictions/gaussians"):
        assert entity in content


@pytest.mark.parametrize("east_m", [0.0, 39_512_000.0])
def test_rerun_gets_positions_from_the_start_of_the_drive(tmp_path, monkeypatch, true, east_m):
    """Its coordinates are float32, which has steps of 4 m at the second easting."""
    rerun = MagicMock()
    stream = rerun.RecordingStream.return_value.binary_stream.return_value
    stream.read.return_value = b""
    monkeypatch.setattr("drivemaps.rerun.import_extra", lambda *_: rerun)
    shift = np.eye(4)
    shift[0, 3] = east_m
    frames = []
    for frame in drive_of().frames[:3]:
        sample = replace(frame.sample, global_from_frame=shift @ frame.sample.global_from_frame)
        frames.append(DriveFrame(sample, frame.elements.to_frame(shift)))
    drive = replace(drive_of(), frames=frames)
    write_rerun(tmp_path / "drive.rrd", Replay(drive, true.to_frame(shift), "lidar", COLOURS))
    poses = [call.kwargs["translation"] for call in rerun.Transform3D.call_args_list]
    expected = [frame.sample.global_from_frame[:3, 3] for frame in frames]
    (text,) = rerun.TextDocument.call_args.args
    x, y, z = map(float, re.findall(r"[xyz] (-?\d+)", text))
    np.testing.assert_allclose(np.float32(poses) + np.array([x, y, z]), expected, atol=1e-4)
    lines = [call.args[0] for call in rerun.LineStrips3D.call_args_list]
    points = np.concatenate([point for line in lines for point in line])
    assert np.abs(points).max() < 100  # of predictions around the vehicle, and of the map


@pytest.mark.parametrize(("module", "write"), [("foxglove", write_mcap), ("rerun", write_rerun)])
def test_a_recording_to_hand_on_copies_images_alone(module, write, tmp_path, camera_drive, true):
    pytest.importorskip(module, reason="pip install -e .[viz]")
    drive, _ = camera_drive
    for number in range(len(drive.frames)):
        (tmp_path / f"{number}.jpg").symlink_to(tmp_path / "key")
    (tmp_path / "key").write_text("secret")
    with pytest.raises(BrokenSampleError, match=r"'CAM_FRONT': .*0\.jpg is not an image"):
        write(tmp_path / "recording", Replay(drive, true, "lidar", COLOURS, tmp_path))
    assert not (tmp_path / "recording").exists()


def test_a_film_shows_every_frame_at_the_pace_of_the_drive(tmp_path, camera_drive, true):
    """H.264 of 4:2:0, which players take; a map has a panel of its own and grows."""
    drive, _ = camera_drive
    for number, value in enumerate((40, 120, 200)):
        Image.new("RGB", (400, 225), (value, value, value)).save(tmp_path / f"{number}.jpg")
    frames = [
        DriveFrame(replace(f.sample, timestamp_ns=i * 250_000_000), f.elements)
        for i, f in enumerate(drive.frames)
    ]
    drive = replace(drive, frames=frames)
    pictures = {}
    for name, elements in (("map", true), ("none", MapElements.from_polylines())):
        replayed = Replay(drive, elements, "lidar", COLOURS, tmp_path)
        write_video(tmp_path / f"{name}.mp4", replayed, width_px=480)
        with av.open(tmp_path / f"{name}.mp4") as film:
            stream = film.streams.video[0]
            assert (stream.codec_context.name, stream.pix_fmt) == ("h264", "yuv420p")
            assert stream.average_rate == 4
            assert stream.width == 480
            pictures[name] = [f.to_ndarray(format="rgb24") for f in film.decode(video=0)]
        assert len(pictures[name]) == 3
    greys = [np.median(picture[60:100, 100:380]) for picture in pictures["none"]]
    np.testing.assert_allclose(greys, (40, 120, 200), atol=4)  # the image of each moment
    assert pictures["map"][0].shape != pictures["none"][0].shape or (
        np.abs(pictures["map"][0].astype(int) - pictures["none"][0]).max() > 50
    )
    with pytest.raises(ValueError, match=r"no image at .*0.jpg"):
        write_video(tmp_path / "no.mp4", Replay(drive, true, "lidar", COLOURS, tmp_path / "a"))
    assert not (tmp_path / "no.mp4").exists()


@pytest.mark.parametrize(
    ("module", "extra", "write"),
    [
        ("pyproj", "maps", lambda p, d, t: write_geojson(p, t, CLASSES, MapOrigin(1.0, 2.0))),
        ("rerun", "viz", lambda p, d, t: write_rerun(p, Replay(d, t, "lidar", COLOURS))),
        ("foxglove", "viz", lambda p, d, t: write_mcap(p, Replay(d, t, "lidar", COLOURS))),
        ("av", "viz", lambda p, d, t: write_video(p, Replay(d, t, "lidar", COLOURS))),
    ],
)
def test_a_missing_extra_is_named(module, extra, write, tmp_path, monkeypatch, true):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(RuntimeError, match=rf"pip install -e \.\[{extra}\]"):
        write(tmp_path / "map", drive_of(), true)
    assert not list(tmp_path.iterdir())


def test_an_empty_map_is_written(tmp_path):
    write_geojson(tmp_path / "map.geojson", MapElements.from_polylines(), CLASSES, None)
    assert json.loads((tmp_path / "map.geojson").read_text())["features"] == []


def test_poses_in_a_grid_lie_where_the_grid_says():
    """UTM zone 50 north: 500 km east is the meridian of 117 degrees."""
    (lon, lat) = MapGrid("EPSG:32650").lon_lat(np.array([[500_000.0, 4_429_000.0]]))[0]
    assert lon == pytest.approx(117.0, abs=1e-9)
    assert lat == pytest.approx(40.0, abs=0.02)
    for wrong, reason in (("EPSG:4326", "no grid in metres"), ("EPSG:0", "no coordinate ref")):
        with pytest.raises(ValueError, match=reason):
            MapGrid(wrong)
    require_near(np.array([[99_000.0, -5.0]]), "a")
    with pytest.raises(ValueError, match=r"a: positions lie up to 4429 km.*give --crs"):
        require_near(np.array([[500_000.0, 4_429_000.0]]), "a")


@pytest.mark.parametrize(
    ("crs", "position", "is_inside"),
    [
        ("EPSG:32650", (500_000.0, 4_429_000.0), True),
        ("EPSG:32650", (100.0, 200.0), False),  # at the equator, west of the zone
        ("EPSG:25832", (900_000.0, 5_800_000.0), True),  # maps of a country leave the zone
        ("EPSG:2056", (2_600_000.0, 1_200_000.0), True),
        ("EPSG:2056", (10.0, -10.0), False),
        ("EPSG:3857", (10.0, 10.0), True),
        ("EPSG:31468", (4_470_315.0, 5_329_181.0), True),
        ("EPSG:25832+7837", (693_566.0, 5_330_684.0), True),
        ("EPSG:31288", (176_675.0, 5_227_960.0), True),  # longitudes from Ferro
        ("EPSG:5514", (-744_430.0, -1_043_628.0), True),
        ("EPSG:2180", (636_640.0, 483_432.0), True),
        ("EPSG:2048", (55_496.0, 3_752_731.0), True),  # westing and southing: turned, not mirrored
        ("EPSG:32650", (1e12, 0.0), False),
        ("EPSG:32650", (math.nan, 0.0), False),
    ],
)
def test_local_positions_are_no_coordinates_of_a_grid(crs, position, is_inside):
    pytest.importorskip("pyproj", reason="pip install -e .[maps]")
    positions = np.array([position])
    if is_inside:
        MapGrid(crs).require_inside(positions, "a")
        return
    with pytest.raises(
        ValueError, match=rf"a: the position .* outside of .*{crs}.*give its --orig"
    ):
        MapGrid(crs).require_inside(positions, "a")


@pytest.mark.parametrize(
    ("crs", "position", "file"),
    [
        ("EPSG:27700", (651_409.8, 313_177.5), "uk_os_OSTN15_NTv2_OSGBtoETRS.tif"),
        ("EPSG:31468", (4_470_315.0, 5_329_181.0), "de_adv_BETA2007.tif"),
        ("EPSG:26710", (500_000.0, 4_400_000.0), "us_noaa_conus.tif"),
        ("EPSG:26710", (500_000.0, 6_100_000.0), "ca_nrc_ntv2_0.tif"),
        ("EPSG:32650", (500_000.0, 4_429_000.0), None),
        ("EPSG:25832+7837", (693_566.0, 5_330_684.0), None),
        ("EPSG:2056", (2_600_000.0, 1_200_000.0), None),
        ("EPSG:5514", (-744_430.0, -1_043_628.0), None),
        ("EPSG:3832", (3_300_000.0, 100_000.0), None),
    ],
)
def test_grids_without_their_file_of_corrections_are_named(crs, position, file):
    """If the file is installed here, there is nothing to name."""
    datadir = pytest.importorskip("pyproj.datadir", reason="pip install -e .[maps]")
    network = pytest.importorskip("pyproj.network", reason="pip install -e .[maps]")
    folders = [datadir.get_data_dir(), datadir.get_user_data_dir()]
    is_installed = file is not None and any(Path(folder, file).exists() for folder in folders)
    if is_installed or network.is_network_enabled():
        pytest.skip(f"{file} is installed or downloaded")
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)  # of pyproj
        text = MapGrid(crs).accuracy_warning(np.array([position]))
    if file is None:
        assert text is None
        return
    assert text.startswith(f"longitude and latitude in {crs} (")
    assert re.search(r"only accurate to \d+ m ", text)
    assert f"pyproj sync --file {file}" in text


@pytest.mark.parametrize(
    ("crs", "position", "message"),
    [
        ("EPSG:32632", (5_330_684.0, 693_566.0), "outside of .*x must be the easting"),
        ("EPSG:31468", (5_329_181.0, 4_470_315.0), "outside of .*x must be the easting"),
        ("EPSG:2056", (1_239_333.0, 2_680_270.0), "outside of .*x must be the easting"),
        ("EPSG:3857", (1_291_306.0, 6_123_507.0), "differs by 50% .*such as its UTM zone"),
        ("EPSG:3034", (4_115_192.0, 2_382_244.0), "differs by 3% .*such as its UTM zone"),
        ("EPSG:5513", (1_043_628.0, 744_430.0), "mirrored, .* such as EPSG:5514"),
        ("EPSG:2065", (1_043_628.0, 744_430.0), "mirrored"),  # longitudes from Ferro
    ],
)
def test_swapped_mirrored_and_stretched_grids_are_refused(crs, position, message):
    """Munich, Zurich, Prague: exchanged or mirrored axes, and grids without true metres."""
    pytest.importorskip("pyproj", reason="pip install -e .[maps]")
    with pytest.raises(ValueError, match=message):
        MapGrid(crs).require_inside(np.array([position]), "a")
