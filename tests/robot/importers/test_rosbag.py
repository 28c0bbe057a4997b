"""Importer of ROS bags; test_importers.py tests the common behaviour."""

import tracemalloc

import cv2
import numpy as np
import pytest

from robot.errors import ImporterError
from robot.importers.rosbag import import_rosbag
from tests.miniatures import encoded, rosbag
from tests.miniatures.rosbag import CAMERA, GEL_A, GEL_B, GRASP, GRIPPER, INTERVAL_NS, OBJECT, START_NS, write_bag

each_format = pytest.mark.parametrize("name", ["mug.bag", "sqlite", "mcap"])


def pixels(recording, path):
    return cv2.cvtColor(cv2.imread(str(recording.folder / path)), cv2.COLOR_BGR2RGB)


def at(number, topic, short, **fields):
    return START_NS + number * INTERVAL_NS, topic, short, fields


def merged(*parts):
    return sorted((message for part in parts for message in part), key=lambda message: message[0])


def write_changed(path, change):
    """Write a bag; `change` gets number, topic, type and fields of each message, and returns the last two or None."""
    content = (
        (time_ns, topic, *changed)
        for time_ns, topic, *rest in rosbag.messages()
        if (changed := change((time_ns - START_NS) // INTERVAL_NS, topic, *rest))
    )
    return write_bag(path, content)


def numbers_of(recording):
    """Return the numbers of photo and touch of each grasp, found by their pixels."""
    gels = {rosbag.gel("a", number).tobytes(): number for number in reversed(range(rosbag.FRAMES))}
    return [
        (int(pixels(recording, grasp.photo)[0, 0, 0]), gels[pixels(recording, grasp.touches["a"]).tobytes()])
        for grasp in recording.grasps
    ]


@each_format
def test_grasps_of_each_format_have_the_expected_images_and_fields(name, tmp_path):
    """Contacts begin at images 20 and 50. The photos 18 and 48 are the last ones before; 19 and 49 have none."""
    bag = write_bag(tmp_path / name, rosbag.messages())
    if name == "mcap":  # a ROS 2 bag needs no metadata
        (bag / "metadata.yaml").unlink()
    recording = import_rosbag(bag, tmp_path / "out", gripper=GRIPPER, sensor="GelSight Mini")
    stem = name.removesuffix(".bag")
    assert [grasp.grasp_id for grasp in recording.grasps] == [f"{stem}-001", f"{stem}-002"]
    # The first image is number 0, the first one after the release number 30: (0 + 20) / 2 and (30 + 50) / 2.
    for grasp, photo, rest, touch in zip(recording.grasps, (18, 48), (10, 40), (27, 58), strict=True):
        assert np.array_equal(pixels(recording, grasp.photo), rosbag.photo(photo))
        for finger in "ab":
            assert np.array_equal(pixels(recording, grasp.touches_before[finger]), rosbag.gel(finger, rest))
            assert np.array_equal(pixels(recording, grasp.touches[finger]), rosbag.gel(finger, touch))
        assert (grasp.object_id, grasp.sequence_id, grasp.touch_skew_s) == (stem, stem, 0.01)
        assert grasp.time_s == pytest.approx(0.05 * touch)
        assert grasp.opening_mm == pytest.approx(2 * touch)  # two joints of 1 mm an image
        assert grasp.force_n == pytest.approx(5)
    assert recording.info["sensor"] == "GelSight Mini"


def test_topics_can_mark_the_grasps_and_name_the_object_which_is_missing_before_its_first_name(tmp_path):
    """The marks decide, not the contact: 22 to 26, then 55 to 70, whose strongest contacts are 25 and 58."""
    marks = [
        at(number, GRASP, "std_msgs/Bool", data=held) for number, held in ((22, True), (26, False), (55, 1), (70, 0))
    ]
    names = [at(1, OBJECT, "std_msgs/String", data="mug"), at(40, OBJECT, "std_msgs/String", data="red tin")]
    write_bag(tmp_path / "a.bag", merged(marks, names, rosbag.messages()))
    recording = import_rosbag(tmp_path / "a.bag", tmp_path / "out", grasp=GRASP, object=OBJECT)
    assert numbers_of(recording) == [(20, 25), (54, 58)]
    assert [grasp.object_id for grasp in recording.grasps] == ["mug", "red tin"]
    # A split must be able to separate the objects of one bag.
    assert len({grasp.sequence_id for grasp in recording.grasps}) == 2
    write_bag(tmp_path / "b.bag", merged(names[1:], rosbag.messages()))
    recording = import_rosbag(tmp_path / "b.bag", tmp_path / "late", object=OBJECT)
    assert [grasp.grasp_id for grasp in recording.grasps] == ["b-002"]
    assert recording.info["skipped"] == {"there is no message of /object before it": 1}


def test_a_grasp_without_a_camera_image_since_the_previous_one_is_skipped(tmp_path):
    """The photo of the previous grasp may show another object."""
    bag = write_changed(tmp_path / "a.bag", lambda number, topic, *rest: rest * (topic != CAMERA or number < 20))
    recording = import_rosbag(bag, tmp_path / "out")
    assert numbers_of(recording) == [(18, 27)]
    assert recording.info["skipped"] == {"there is no camera image between the previous grasp and its contact": 1}


def test_short_interruptions_and_short_grasps_are_ignored(tmp_path):
    """The gels show no contact in image 24, and contact in image 5: 50 ms each."""

    def change(number, topic, short, fields):
        if topic in (GEL_A, GEL_B) and number in (5, 24):
            fields = rosbag.image_fields(rosbag.gel(topic[-1], 27 if number == 5 else 9), "rgb8")
        return short, fields

    bag = write_changed(tmp_path / "a.bag", change)
    assert numbers_of(import_rosbag(bag, tmp_path / "out")) == [(18, 27), (48, 58)]
    short = import_rosbag(bag, tmp_path / "short", settle_s=0.01)
    assert [number for _, number in numbers_of(short)] == [27, 23, 27, 58]


def test_one_finger_is_enough_and_compressed_images_are_stored_unchanged(tmp_path):
    def change(number, topic, short, fields):
        if topic == CAMERA:
            fields = {"format": "jpeg", "data": np.frombuffer(encoded(".jpg", number), np.uint8)}
        return (short, fields) if topic != GEL_B else None

    recording = import_rosbag(write_changed(tmp_path / "a.bag", change), tmp_path / "out", touch_b="")
    assert recording.info["fingers"] == 1
    assert [sorted(grasp.touches) for grasp in recording.grasps] == [["a"], ["a"]]
    photos = [(recording.folder / grasp.photo).read_bytes() for grasp in recording.grasps]
    assert photos == [encoded(".jpg", 18), encoded(".jpg", 48)]


@each_format
def test_a_bag_that_is_cut_off_costs_no_other_bag_and_names_the_repair(name, tmp_path):
    (tmp_path / "src").mkdir()
    write_bag(tmp_path / "src/whole.bag", rosbag.messages())
    bag = write_bag(tmp_path / "src" / name, rosbag.messages())
    path = bag if bag.is_file() else next(path for path in bag.iterdir() if path.suffix in (".mcap", ".db3"))
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * 0.6)])
    recording = import_rosbag(tmp_path / "src", tmp_path / "out")
    assert {grasp.object_id for grasp in recording.grasps} == {"whole"}
    assert any("repair it: rosbag reindex" in note for note in recording.notes)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"photo": "/camera"}, r"must have the topic /camera of type .*; choose .* from: /camera/color \(sensor_msgs"),
        ({"grasp": GEL_A}, "must have the topic /gel/a of type std_msgs/msg/Bool"),
        ({"contact": 0.0}, r"contact must be a number > 0"),
        ({"touch_a": "", "touch_b": ""}, "the source contains none"),
    ],
)
def test_topics_and_options_are_checked(tmp_path, options, message):
    write_bag(tmp_path / "a.bag", rosbag.messages())
    with pytest.raises(ImporterError, match=message):
        import_rosbag(tmp_path / "a.bag", tmp_path / "out", **options)


def test_an_unknown_encoding_is_an_error_that_names_the_known_ones(tmp_path):
    content = [at(0, GEL_A, "sensor_msgs/Image", **rosbag.image_fields(rosbag.gel("a", 0), "yuv422"))]
    write_bag(tmp_path / "a.bag", merged(content, list(rosbag.messages())[1:]))
    with pytest.raises(ImporterError, match=r"must be rgb8, .*bgra8, got 'yuv422'"):
        import_rosbag(tmp_path / "a.bag", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_images_that_cannot_be_decoded_are_counted(tmp_path):
    def change(number, topic, short, fields):
        if topic != GEL_A:
            return short, fields
        fields = rosbag.png_fields(rosbag.gel("a", number))
        if number in (7, 8):
            fields["data"] = fields["data"][:50]
        return "sensor_msgs/CompressedImage", fields

    recording = import_rosbag(write_changed(tmp_path / "a.bag", change), tmp_path / "out")
    assert numbers_of(recording) == [(18, 27), (48, 58)]
    assert any(note.startswith("2 gel image(s) cannot be decoded") for note in recording.notes)


def test_images_are_not_all_in_memory(tmp_path):
    """200 gel images of 230,400 bytes, in chunks of 1 MB."""

    def content():
        for number in range(200):
            image = np.zeros((240, 320, 3), np.uint8)
            image[60:180, 60:180] = 100 * (number % 40 >= 20)
            yield at(number, GEL_A, "sensor_msgs/Image", **rosbag.image_fields(image, "rgb8"))
            if number % 40 == 0:
                yield at(number, CAMERA, "sensor_msgs/Image", **rosbag.image_fields(image, "rgb8"))

    bag = write_bag(tmp_path / "mcap", content(), chunk_bytes=1_000_000)
    import_rosbag(bag, tmp_path / "first", touch_b="")  # packages imported on first use do not count
    tracemalloc.start()
    try:
        recording = import_rosbag(bag, tmp_path / "out", touch_b="")
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert len(recording.grasps) == 5
    assert peak < 25_000_000
