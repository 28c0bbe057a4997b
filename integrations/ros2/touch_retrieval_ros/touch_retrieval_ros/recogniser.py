"""The logic of the node, without ROS: newest gel images, grasps, answers and the state of the topics."""

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from string import ascii_lowercase
from typing import Any

import numpy as np
from numpy.typing import NDArray

from retrieval import BadInput, QueryResult, Searcher, Verification
from robot.errors import ImporterError
from robot.importers.rosbag import picture_of

GelPicture = NDArray[np.uint8] | bytes
"""(H, W, 3) red first, or the content of a PNG or JPEG file."""

_RATE_IMAGES = 30
"""Number of images over which a rate is computed."""
_POLL_S = 0.05
"""Longest time in which a cancelled goal is noticed."""


@dataclass(frozen=True)
class GelTopicState:
    """The state of one finger's topic.

    Attributes:
        label: Finger and topic.
        problem: The reason why it has no usable image; empty if it has one.
        rate_hz: Rate of the last images that arrived; 0 before the second one.
        age_s: Age of the newest image; infinite before the first one.
    """

    label: str
    problem: str
    rate_hz: float
    age_s: float


class GelTopic:
    """The newest image of one finger.

    Attributes:
        label: Finger and topic, for messages.
        picture: The newest image; None before the first one, or if it cannot be decoded.
        time_ns: Time of the newest image: its time stamp, but at most the time of its arrival; -1 before the first one.
    """

    def __init__(self, finger: str, topic: str) -> None:
        self.label = f"finger {finger} ({topic})"
        self.picture: GelPicture | None = None
        self.time_ns = -1
        self._fault = ""
        self._arrivals_ns: deque[int] = deque(maxlen=_RATE_IMAGES)

    def add(self, message: Any, received_ns: int) -> None:
        """Store the image of a message."""
        try:
            self.picture, self._fault = picture_of(message), ""
        except ImporterError as error:
            self.picture, self._fault = None, str(error)
        stamp = message.header.stamp
        # A camera whose clock is ahead must not make old images look new; one without a clock states 0.
        self.time_ns = min(stamp.sec * 10**9 + stamp.nanosec or received_ns, received_ns)
        self._arrivals_ns.append(received_ns)

    def state(self, now_ns: int, max_age_s: float) -> GelTopicState:
        """Return the state; an image older than `max_age_s` is not usable."""
        arrivals = self._arrivals_ns
        span_ns = arrivals[-1] - arrivals[0] if arrivals else 0
        rate_hz = 1e9 * (len(arrivals) - 1) / span_ns if span_ns > 0 else 0.0
        age_s, fault = (now_ns - self.time_ns) / 1e9, self._fault
        if self.time_ns < 0:
            age_s, fault = math.inf, "no image has arrived; check the topic's name and type, and its publisher"
        elif age_s > max_age_s:
            fault = (
                f"the newest image is {age_s:.1f} s old by its time stamp; check the publisher, and that its clock "
                "agrees with the clock of this node"
            )
        return GelTopicState(self.label, fault and f"{self.label}: {fault}", rate_hz, age_s)


class Recogniser:
    """Answers queries from the newest image of each finger. Threads may add images and call its methods at once.

    A grasp consists of an image of each finger that is not older than the request: the gripper is closed when the
    client requests, so older images may show another state.

    Args:
        searcher: The opened index.
        topics: Topic of each finger's gel images, in the order of the model's fingers.
        now_ns: Returns the time in ns, by the clock of the time stamps.
        top: Number of objects in an answer.
        none_prior: Prior probability that the catalogue lacks the object.
        image_timeout_s: Longest wait for images that are newer than a request.
        grasp_timeout_s: Longest wait for the request of the next grasp.

    Raises:
        BadInput: The model takes another number of gel images.
    """

    def __init__(
        self,
        searcher: Searcher,
        topics: Sequence[str],
        now_ns: Callable[[], int],
        *,
        top: int = 10,
        none_prior: float = 0.5,
        image_timeout_s: float = 2.0,
        grasp_timeout_s: float = 60.0,
    ) -> None:
        if len(topics) != (fingers := searcher.reader.fingers):
            raise BadInput(
                f"the model takes {fingers} gel image(s) for one touch, but image_topics has {len(topics)} topic(s): "
                f"{', '.join(topics)}; give one topic for each finger"
            )
        self.searcher, self.now_ns, self.top, self.none_prior = searcher, now_ns, top, none_prior
        self.image_timeout_s, self.grasp_timeout_s = image_timeout_s, grasp_timeout_s
        self._topics = [GelTopic(finger, topic) for finger, topic in zip(ascii_lowercase, topics, strict=False)]
        self._changed = threading.Condition()
        self._identifying = threading.Lock()
        self._requested_ns: int | None = None
        self._no_contact_frames: list[GelPicture] | None = None
        self._verified: list[list[GelPicture]] = []

    def add_image(self, finger: int, message: Any) -> None:
        """Store the newest image of a finger, a message of type sensor_msgs/Image or CompressedImage."""
        with self._changed:
            self._topics[finger].add(message, self.now_ns())
            self._changed.notify_all()

    def identify(self, grasps: int, is_cancelled: Callable[[], bool]) -> Iterator[QueryResult]:
        """Yield the answer after each grasp. The first grasp is read at once, each further one after `request_grasp`.

        Args:
            grasps: Number of grasps.
            is_cancelled: Whether the client no longer waits; then no further grasp is read.

        Raises:
            BadInput: Another identification is running, images are missing or old, or no grasp was requested in time.
            RetrievalError: The query failed.
        """
        if grasps < 1:
            raise BadInput(f"grasps must be at least 1, got {grasps}")
        if not self._identifying.acquire(blocking=False):
            raise BadInput("another goal of Identify is running; wait for its result, or cancel it")
        try:
            self._requested_ns = None
            since_ns: int | None = self.now_ns()
            touches: list[list[GelPicture]] = []
            while since_ns is not None:
                touches.append(self._read_grasp(since_ns))
                yield self.searcher.query(
                    touches, background=self._background(), top=self.top, none_prior=self.none_prior
                )
                if len(touches) == grasps:
                    return
                since_ns = self._next_request(len(touches) + 1, is_cancelled)
        finally:
            self._identifying.release()

    def request_grasp(self) -> None:
        """Make the running identification read its next grasp: the gripper is closed on the object again.

        Raises:
            BadInput: No identification is running.
        """
        if not self._identifying.locked():
            raise BadInput("no goal of Identify waits for a grasp; send a goal with two or more grasps first")
        with self._changed:
            self._requested_ns = self.now_ns()
            self._changed.notify_all()

    def verify(self, expected: str, far: float, *, add_to_previous: bool) -> Verification:
        """Read a grasp, and decide whether the expected object is in the hand.

        Args:
            expected: The expected object of the catalogue.
            far: False-accept rate.
            add_to_previous: Whether the hand holds the object of the previous call, whose grasps then count too.

        Raises:
            BadInput: Images are missing or old, the object or the rate is invalid, or the model has no error rates.
        """
        grasps = [*(self._verified if add_to_previous else ()), self._read_grasp(self.now_ns())]
        result = self.searcher.verify(grasps, expected, far=far, background=self._background())
        self._verified = grasps
        return result

    def store_no_contact_frames(self) -> None:
        """Read the no-contact frame of each finger: the gripper is open.

        Raises:
            BadInput: Images are missing or old, or the model does not use such frames.
        """
        frames = self._read_grasp(self.now_ns())
        self.searcher.reader.no_contact_frames(frames)
        self._no_contact_frames = frames

    def topic_states(self) -> list[GelTopicState]:
        """Return the state of each finger's topic."""
        with self._changed:
            return [topic.state(self.now_ns(), self.image_timeout_s) for topic in self._topics]

    def index_facts(self) -> dict[str, str]:
        """Return facts on the index and the model, by name."""
        searcher, manifest = self.searcher, self.searcher.manifest
        facts = {
            "index": searcher.index,
            "generation": manifest.generation,
            "photos": manifest.photos,
            "objects": manifest.objects,
            "model": searcher.checkpoint.path,
            "trained_on": searcher.checkpoint.provenance.get("source", "unknown"),
            "encoder": searcher.encoder.name,
        }
        return {name: str(value) for name, value in facts.items()}

    def _read_grasp(self, since_ns: int) -> list[GelPicture]:
        """Return an image of each finger that is not older than `since_ns`. Raises BadInput after the timeout."""

        def are_fresh() -> bool:
            return all(topic.time_ns >= since_ns for topic in self._topics)

        with self._changed:
            self._changed.wait_for(are_fresh, self.image_timeout_s)
            now_ns = self.now_ns()
            states = [topic.state(now_ns, (now_ns - since_ns) / 1e9) for topic in self._topics]
            if problems := [state.problem for state in states if state.problem]:
                raise BadInput("; ".join(problems))
            return [topic.picture for topic in self._topics if topic.picture is not None]

    def _next_request(self, number: int, is_cancelled: Callable[[], bool]) -> int | None:
        """Return the time of the request of the next grasp; None if the client cancelled."""
        deadline = time.monotonic() + self.grasp_timeout_s
        while not is_cancelled():
            with self._changed:
                self._changed.wait_for(lambda: self._requested_ns is not None, _POLL_S)
                if self._requested_ns is not None:
                    requested_ns, self._requested_ns = self._requested_ns, None
                    return requested_ns
            if time.monotonic() > deadline:
                raise BadInput(
                    f"grasp {number} was not requested within {self.grasp_timeout_s:g} s; close the gripper and call "
                    "~/next_grasp after each feedback, or raise grasp_timeout_s"
                )
        return None

    def _background(self) -> list[GelPicture] | None:
        if self._no_contact_frames is None and self.searcher.checkpoint.config.preprocessing.background != "none":
            raise BadInput("the model needs no-contact frames; open the gripper and call ~/store_no_contact_frames")
        return self._no_contact_frames
