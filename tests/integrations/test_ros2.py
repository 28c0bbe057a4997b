"""The ROS 2 node on a recorded bag, with a stub of rclpy (`fake_rclpy.py`). ROS itself did not run."""

import dataclasses
import math
import threading

import cv2
import numpy as np
import pytest

pytest.importorskip("rosbags")

import retrieval
from retrieval.model.touch_reader import TouchReader
from robot.importers.rosbag import Bag
from tests import synthetic
from tests.integrations import fake_rclpy
from tests.miniatures import rosbag
from tests.miniatures.rosbag import GEL_A, GEL_B, INTERVAL_NS, START_NS
from tests.verification import calibration, verified_index

REST, FIRST, SECOND = 4, 9, 19
"""Numbers of the last images before the contact, of the first grasp, and of the second grasp."""
IDENTIFY, VERIFY, NEXT_GRASP, NO_CONTACT = "~/identify", "~/verify", "~/next_grasp", "~/store_no_contact_frames"


@pytest.fixture(scope="module")
def index(model, catalogue, tmp_path_factory):
    """An index whose model has bounds for verification: always "another grasp" until the fourth."""
    return verified_index(tmp_path_factory.mktemp("ros2"), model, catalogue, calibration(1e3, -1e3))


@pytest.fixture(scope="module")
def ros():
    with fake_rclpy.node_module() as made:
        yield made


@pytest.fixture
def start(ros, index):
    """Return a function that creates the node with parameters."""
    (module, overrides, _), created = ros, []

    def started(**parameters):
        overrides.clear()
        overrides.update({"index": str(index), "image_timeout_s": 0.02, "grasp_timeout_s": 0.1, **parameters})
        created.append(module.RecogniserNode())
        return created[-1]

    yield started
    for made in created:
        made.close()
        assert made.node.is_destroyed


@pytest.fixture(scope="module")
def grasps(touches):
    """The files of two grasps of the first object."""
    return touches[min(touches)][:2]


def picture(path):
    return cv2.imread(str(path))[..., ::-1]


def messages(grasps):
    """Yield 20 images of each gel: 5 without contact, 5 of the first grasp, and the same with the second grasp."""
    gels = [[picture(path) for path in grasp] for grasp in grasps]
    rest = [synthetic.draw_background(1, finger) for finger in "ab"]
    for number in range(20):
        images = gels[number // 10] if number % 10 >= 5 else rest
        time_ns = START_NS + number * INTERVAL_NS
        yield time_ns, GEL_A, "sensor_msgs/Image", rosbag.image_fields(images[0][..., ::-1], "bgr8")
        yield time_ns, GEL_B, "sensor_msgs/Image", rosbag.image_fields(images[1], "rgb8")


@pytest.fixture(scope="module")
def bag(grasps, tmp_path_factory):
    return rosbag.write_bag(tmp_path_factory.mktemp("bag") / "mcap_hand", messages(grasps))


class Player:
    """Plays a bag to a node, whose clock is that of the bag."""

    def __init__(self, bag, made, *, without=()):
        self.node, self.without = made.node, without
        with Bag(bag) as opened:
            self.messages = [
                (time_ns, topic, fake_rclpy.from_bag(decode()))
                for topic, time_ns, decode in opened.messages((GEL_A, GEL_B))
            ]

    def play(self, number):
        """Play up to and with an image of each gel."""
        until_ns = START_NS + number * INTERVAL_NS
        while self.messages and self.messages[0][0] <= until_ns:
            self.node.now_ns, topic, message = self.messages.pop(0)
            if topic not in self.without:
                self.node.deliver(topic, message)
        self.node.now_ns = until_ns


def assert_answers(message, result):
    """The message has the verdict and the ranking of the result."""
    assert message.verdict == result.verdict
    assert message.none_probability == pytest.approx(result.none_probability, abs=1e-6)
    assert [row.class_id for row in message.results] == [match.object_id for match in result.results]
    assert [row.logit for row in message.results] == pytest.approx([match.logit for match in result.results], abs=1e-5)
    for row, match in zip(message.results, result.results, strict=True):
        numbers = match.probability, match.probability_if_present
        assert (row.score, row.probability_if_present) == pytest.approx(numbers, abs=1e-6)
        assert row.photo == match.photo


def test_feedback_requests_the_next_grasp_and_the_result_uses_the_images_of_all(start, bag, grasps):
    made = start(top=3)
    player, feedback = Player(bag, made), []

    def regrasp(goal, message):
        feedback.append(message)
        player.play(SECOND)
        assert made.node.call(NEXT_GRASP).success

    player.play(FIRST)
    goal, result = made.node.send_goal(IDENTIFY, regrasp, grasps=2)
    assert (goal.status, result.error) == ("succeeded", "")
    assert [message.next_grasp for message in feedback] == [2]
    first, both = (made.searcher.query(grasps[:count], top=3) for count in (1, 2))
    assert len(result.answer.results) == 3
    assert_answers(feedback[0].answer, first)
    assert_answers(result.answer, both)
    assert result.answer.sentence.startswith(both.verdict)
    assert result.answer.grasps == ["contact", "contact"]
    assert result.answer.header.stamp.sec * 10**9 + result.answer.header.stamp.nanosec == made.node.now_ns
    assert made.node.published["~/answer"] == [feedback[0].answer, result.answer]


def test_images_older_than_the_request_are_not_used(start, bag, grasps):
    """The goal arrives 10 ms after the last image of the rest; the images of the grasp arrive later."""
    made = start(image_timeout_s=60.0)
    player, results = Player(bag, made), []
    player.play(REST)
    made.node.now_ns += 10_000_000
    read_clock, requested = made.recogniser.now_ns, threading.Event()

    def now_ns():
        time_ns = read_clock()
        if threading.current_thread() is not threading.main_thread():
            requested.set()
        return time_ns

    made.recogniser.now_ns = now_ns
    client = threading.Thread(target=lambda: results.append(made.node.send_goal(IDENTIFY)[1]))
    client.start()
    assert requested.wait(60)
    player.play(FIRST)
    client.join(60)
    assert_answers(results[0].answer, made.searcher.query(grasps[:1]))


@pytest.mark.parametrize(
    ("is_cancelled", "status", "error"),
    [(True, "canceled", ""), (False, "aborted", "grasp 2 was not requested within 0.1 s; close the gripper")],
)
def test_a_goal_that_is_cancelled_or_has_no_further_grasp_ends_with_the_answer_so_far(
    start, bag, grasps, is_cancelled, status, error
):
    made = start(grasp_timeout_s=60.0 if is_cancelled else 0.1)
    Player(bag, made).play(FIRST)
    goal, result = made.node.send_goal(IDENTIFY, lambda goal, _: goal.cancel() if is_cancelled else None, grasps=2)
    assert goal.status == status
    assert result.error.startswith(error)
    assert bool(result.error) == bool(error)
    assert_answers(result.answer, made.searcher.query(grasps[:1]))


def test_a_second_goal_and_a_grasp_without_a_goal_are_refused(start, bag):
    made, second = start(), []
    Player(bag, made).play(FIRST)
    made.node.send_goal(IDENTIFY, lambda goal, feedback: second.append(made.node.send_goal(IDENTIFY)), grasps=2)
    ((goal, result),) = second
    assert goal.status == "aborted"
    assert result.error == "another goal of Identify is running; wait for its result, or cancel it"
    response = made.node.call(NEXT_GRASP)
    assert not response.success
    assert response.message.startswith("no goal of Identify waits for a grasp")
    assert made.node.send_goal(IDENTIFY)[0].status == "succeeded"


def test_a_model_without_calibration_has_nan_in_place_of_probabilities(start, bag):
    made = start()
    made.searcher.posterior = None
    Player(bag, made).play(FIRST)
    answer = made.node.send_goal(IDENTIFY)[1].answer
    assert answer.verdict == "uncalibrated"
    assert math.isnan(answer.none_probability)
    assert all(math.isnan(row.score) and math.isnan(row.probability_if_present) for row in answer.results)


def image(pixels, encoding, time_ns, **changes):
    fields = rosbag.image_fields(pixels, encoding)
    fields["data"] = fake_rclpy.array("B", fields["data"].tobytes())
    made = fake_rclpy.message_class("sensor_msgs/msg/Image")(**{**fields, **changes})
    made.header.stamp.sec, made.header.stamp.nanosec = time_ns // 10**9, time_ns % 10**9
    return made


def test_a_missing_finger_a_stale_image_and_an_unknown_encoding_are_one_error_and_the_node_goes_on(start, bag):
    made = start()
    node, player = made.node, Player(bag, made, without=[GEL_B])
    player.play(FIRST)
    goal, result = node.send_goal(IDENTIFY)
    assert (goal.status, result.answer.verdict) == ("aborted", "")
    assert result.error == (
        "finger b (/gel/b): no image has arrived; check the topic's name and type, and its publisher"
    )
    node.now_ns += 3_000_000_000
    node.deliver(GEL_B, image(np.zeros((8, 8, 3), np.uint8), "yuv422", node.now_ns))
    result = node.send_goal(IDENTIFY)[1]
    assert result.error == (
        "finger a (/gel/a): the newest image is 3.0 s old by its time stamp; check the publisher, and that its clock "
        "agrees with the clock of this node; finger b (/gel/b): the encoding of its images must be rgb8, bgr8, mono8, "
        "rgba8, bgra8, got 'yuv422'"
    )
    assert sum(text.startswith("Identify: ") for text in node.log) == 2
    player.without = ()
    player.play(SECOND)
    assert node.send_goal(IDENTIFY)[0].status == "succeeded"


def test_a_time_stamp_in_the_future_does_not_make_an_image_new(start):
    """The camera's clock is an hour ahead; the image arrived one second before the goal."""
    made = start()
    made.node.now_ns = START_NS
    for topic in (GEL_A, GEL_B):
        made.node.deliver(topic, image(np.zeros((8, 8, 3), np.uint8), "rgb8", START_NS + 3600 * 10**9))
    made.node.now_ns += 1_000_000_000
    assert "the newest image is 1.0 s old" in made.node.send_goal(IDENTIFY)[1].error


def test_verify_adds_a_grasp_to_the_previous_ones_only_on_request(start, bag, touches, grasps):
    made, name = start(), min(touches)
    player = Player(bag, made)
    player.play(FIRST)
    first = made.node.call(VERIFY, expected_object=name, false_accept_rate=0.05)
    player.play(SECOND)
    second = made.node.call(VERIFY, expected_object=name, false_accept_rate=0.05, add_to_previous=True)
    expected = made.searcher.verify(grasps, name, far=0.05)
    assert (first.decision, first.accepted, first.error) == ("another grasp", False, "")
    assert first.log_ratios == pytest.approx(expected.log_ratios[:1], abs=1e-5)
    assert (second.decision, second.sentence) == (expected.decision, expected.sentence)
    assert second.log_ratios == pytest.approx(expected.log_ratios, abs=1e-5)
    checkpoint = made.searcher.checkpoint
    made.searcher.checkpoint = dataclasses.replace(checkpoint, verification=calibration(-1e3, -2e3))
    third = made.node.call(VERIFY, expected_object=name)
    assert (third.decision, third.accepted, len(third.log_ratios)) == ("accept", True, 1)


def test_an_invalid_verification_is_one_error_and_the_node_goes_on(start, bag, touches):
    made, known = start(), min(touches)
    Player(bag, made).play(FIRST)
    for name, far, message in (
        ("anvil", 0.01, "has no object 'anvil'; give the name of its folder"),
        (known, math.nan, "the false-accept rate must be above 0 and at most 0.5, got nan"),
    ):
        response = made.node.call(VERIFY, expected_object=name, false_accept_rate=far)
        assert message in response.error
        assert (response.decision, response.accepted) == ("", False)
    assert made.node.call(VERIFY, expected_object=known).error == ""


def test_a_model_that_subtracts_no_contact_frames_needs_them_once(start, bag, grasps):
    made = start()
    player, searcher = Player(bag, made), made.searcher
    player.play(REST)
    response = made.node.call(NO_CONTACT)
    assert not response.success
    assert "this model uses gel images unchanged" in response.message
    preprocessing = dataclasses.replace(searcher.checkpoint.config.preprocessing, background="difference")
    config = dataclasses.replace(searcher.checkpoint.config, preprocessing=preprocessing)
    searcher.checkpoint = dataclasses.replace(searcher.checkpoint, config=config)
    searcher.reader = TouchReader(config, searcher.encoder)
    result = made.node.send_goal(IDENTIFY)[1]
    assert result.error.startswith("the model needs no-contact frames; open the gripper and call")
    assert made.node.call(NO_CONTACT).success
    player.play(FIRST)
    rest = [synthetic.draw_background(1, finger) for finger in "ab"]
    assert_answers(made.node.send_goal(IDENTIFY)[1].answer, searcher.query(grasps[:1], background=rest))


def test_diagnostics_give_rate_age_and_problem_of_each_topic_and_the_index(start, bag, index):
    made = start()
    Player(bag, made, without=[GEL_B]).play(FIRST)
    made.node.now_ns += 10_000_000
    made.node.timers[0]()
    ((array),) = made.node.published["/diagnostics"]
    finger_a, finger_b, of_index = array.status
    values = [{pair.key: pair.value for pair in status.values} for status in array.status]
    assert [status.level for status in array.status] == [b"\0", b"\2", b"\0"]
    assert (finger_a.name, finger_a.message) == ("touch_retrieval: finger a (/gel/a)", "ok")
    assert values[0] == {"rate_hz": "20.0", "age_s": "0.010"}
    assert "no image has arrived" in finger_b.message
    assert values[1] == {"rate_hz": "0.0", "age_s": "inf"}
    assert of_index.message == "8 objects"
    assert (values[2]["index"], values[2]["photos"], values[2]["generation"]) == (str(index), "24", "gen-000001")
    assert values[2]["model"].endswith("m.safetensors")


def test_the_number_of_topics_must_be_that_of_the_model(start):
    with pytest.raises(retrieval.BadInput, match=r"takes 2 gel image\(s\) for one touch, but image_topics has 1 topic"):
        start(image_topics=["/gel"])


def test_the_program_ends_with_one_line_without_an_index_and_quietly_when_it_is_stopped(ros, index, tmp_path, capsys):
    module, overrides, _ = ros
    overrides.clear()
    overrides["index"] = str(tmp_path / "nothing")
    assert module.main() == 2
    assert "nothing: there is no index here; run `retrieve build-index` first" in capsys.readouterr().err
    overrides["index"] = str(index)
    assert module.main() == 0
    assert capsys.readouterr().err == ""
