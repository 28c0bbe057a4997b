"""The node: topics, action, services, parameters and diagnostics of ROS 2 around `Recogniser`."""

import math
import sys
from collections.abc import Callable
from functools import partial
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.action import ActionServer, CancelResponse
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CompressedImage, Image
from std_srvs.srv import Trigger
from touch_retrieval_msgs.action import Identify
from touch_retrieval_msgs.msg import Answer, ObjectHypothesis
from touch_retrieval_msgs.srv import Verify

import retrieval
from indexes.errors import IndexesError
from retrieval.errors import RetrievalError
from retrieval.search.answer import verdict_sentence
from touch_retrieval_ros.recogniser import Recogniser

PARAMETERS: dict[str, Any] = {
    "index": "index",
    "model": "",
    "image_topics": ["/gel/a", "/gel/b"],
    "compressed": False,
    "top": 10,
    "none_prior": 0.5,
    "image_timeout_s": 2.0,
    "grasp_timeout_s": 60.0,
    "diagnostics_period_s": 1.0,
}
"""Parameters and their defaults; README.md describes them."""

_THREADS = 6
"""Images, diagnostics, a waiting goal, a verification, and two for further requests."""
_ERRORS = (RetrievalError, IndexesError)


class RecogniserNode:
    """The node `touch_retrieval`. It opens the index when it is created.

    Raises:
        RetrievalError: A parameter or the model is invalid.
        IndexesError: The index is missing or damaged.
    """

    def __init__(self) -> None:
        self.node = node = rclpy.create_node("touch_retrieval")
        values = {name: node.declare_parameter(name, default).value for name, default in PARAMETERS.items()}
        topics: list[str] = values["image_topics"]
        self.searcher = retrieval.open(values["index"], model=values["model"] or None)
        self.recogniser = Recogniser(
            self.searcher,
            topics,
            lambda: int(node.get_clock().now().nanoseconds),
            **{name: values[name] for name in ("top", "none_prior", "image_timeout_s", "grasp_timeout_s")},
        )
        images, requests, grasps = (
            MutuallyExclusiveCallbackGroup(),
            ReentrantCallbackGroup(),
            MutuallyExclusiveCallbackGroup(),
        )
        kind = CompressedImage if values["compressed"] else Image
        for finger, topic in enumerate(topics):
            add_image = partial(self.recogniser.add_image, finger)
            node.create_subscription(kind, topic, add_image, qos_profile_sensor_data, callback_group=images)
        self.answers = node.create_publisher(Answer, "~/answer", 10)
        self.identify = ActionServer(
            node,
            Identify,
            "~/identify",
            self._identify,
            cancel_callback=lambda goal: CancelResponse.ACCEPT,
            callback_group=requests,
        )
        for name, action, group in (
            ("next_grasp", self.recogniser.request_grasp, requests),
            ("store_no_contact_frames", self.recogniser.store_no_contact_frames, grasps),
        ):
            callback = partial(self._trigger, name, action)
            node.create_service(Trigger, f"~/{name}", callback, callback_group=group)
        node.create_service(Verify, "~/verify", self._verify, callback_group=grasps)
        self.diagnostics = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        node.create_timer(values["diagnostics_period_s"], self._publish_diagnostics)
        facts = self.recogniser.index_facts()
        node.get_logger().info(
            f"{facts['index']}: {facts['objects']} objects; gel images: {', '.join(topics)}; waiting for requests"
        )

    def close(self) -> None:
        """Close the index and the node."""
        self.searcher.close()
        self.node.destroy_node()

    def _identify(self, goal: Any) -> Any:
        """Execute a goal; without the requested grasps it is aborted, with the reason in the result."""
        result, grasps = Identify.Result(), goal.request.grasps
        try:
            answers = self.recogniser.identify(grasps, lambda: goal.is_cancel_requested or not rclpy.ok())
            for number, answer in enumerate(answers, start=1):
                result.answer = self._answer(answer)
                self.answers.publish(result.answer)
                if number < grasps:
                    goal.publish_feedback(Identify.Feedback(next_grasp=number + 1, answer=result.answer))
        except _ERRORS as error:
            result.error = self._warn("Identify", error)
            goal.abort()
            return result
        if goal.is_cancel_requested:
            goal.canceled()
        else:
            goal.succeed()
        return result

    def _verify(self, request: Any, response: Any) -> Any:
        far, add_to_previous = request.false_accept_rate, request.add_to_previous
        try:
            result = self.recogniser.verify(request.expected_object, far, add_to_previous=add_to_previous)
        except _ERRORS as error:
            response.error = self._warn("Verify", error)
            return response
        response.decision, response.accepted = result.decision, result.decision == "accept"
        response.sentence, response.log_ratios = result.sentence, result.log_ratios
        return response

    def _trigger(self, name: str, action: Callable[[], None], request: Any, response: Any) -> Any:
        try:
            action()
        except _ERRORS as error:
            response.message = self._warn(name, error)
        else:
            response.success = True
        return response

    def _warn(self, request: str, error: Exception) -> str:
        self.node.get_logger().warning(f"{request}: {error}")
        return str(error)

    def _answer(self, result: retrieval.QueryResult) -> Any:
        """Return the message of a result; NaN stands for numbers that it lacks."""
        answer = Answer(verdict=result.verdict, sentence=verdict_sentence(result), grasps=result.grasps)
        answer.header.stamp = self.node.get_clock().now().to_msg()
        answer.none_probability = _or_nan(result.none_probability)
        answer.results = [
            ObjectHypothesis(
                class_id=match.object_id,
                score=_or_nan(match.probability),
                probability_if_present=_or_nan(match.probability_if_present),
                logit=match.logit,
                photo=match.photo,
            )
            for match in result.results
        ]
        return answer

    def _publish_diagnostics(self) -> None:
        array = DiagnosticArray()
        array.header.stamp = self.node.get_clock().now().to_msg()
        for state in self.recogniser.topic_states():
            level, message = (DiagnosticStatus.ERROR, state.problem) if state.problem else (DiagnosticStatus.OK, "ok")
            values = {"rate_hz": f"{state.rate_hz:.1f}", "age_s": f"{state.age_s:.3f}"}
            array.status.append(_status(level, state.label, message, values))
        facts = self.recogniser.index_facts()
        array.status.append(_status(DiagnosticStatus.OK, "index", f"{facts['objects']} objects", facts))
        self.diagnostics.publish(array)


def _status(level: Any, name: str, message: str, values: dict[str, str]) -> Any:
    pairs = [KeyValue(key=key, value=value) for key, value in values.items()]
    return DiagnosticStatus(level=level, name=f"touch_retrieval: {name}", message=message, values=pairs)


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value


def main() -> int:
    """Run the node until it is stopped; return the exit code."""
    rclpy.init()
    node = None
    try:
        node = RecogniserNode()
        executor = MultiThreadedExecutor(num_threads=_THREADS)
        executor.add_node(node.node)
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except _ERRORS as error:
        print(f"touch_retrieval: {error}", file=sys.stderr)
        return error.exit_code
    finally:
        if node is not None:
            node.close()
        rclpy.try_shutdown()
    return 0
