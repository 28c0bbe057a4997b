"""A stub of the documented API of rclpy, as far as the node of `integrations/ros2` uses it. A test is the client.

The classes of messages come from the definitions: those of ROS from the package rosbags, ours from their files. Like
the classes that ROS generates, they have a default for each field, and refuse unknown fields and values of a wrong
type.
"""

import re
import sys
from array import array
from contextlib import contextmanager
from functools import partial
from importlib import import_module
from types import ModuleType, SimpleNamespace
from typing import Any, ClassVar

import pytest
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tests.documents import ROOT

FOLDER = ROOT / "integrations" / "ros2"
MESSAGES = FOLDER / "touch_retrieval_msgs"
PARTS = {".msg": ("",), ".srv": ("_Request", "_Response"), ".action": ("_Goal", "_Result", "_Feedback")}
FILES = sorted(path for path in MESSAGES.rglob("*") if path.suffix in PARTS)
NUMBERS = {"float64": float, "bool": bool, "string": str, "uint32": int, "int32": int, "uint8": int}


def _definitions():
    """Return name -> (constants, fields) of all messages, and (name, field) -> default of our own."""
    defined, defaults = dict(get_typestore(Stores.ROS2_JAZZY).fielddefs), {}
    for path in FILES:
        for suffix, text in zip(PARTS[path.suffix], path.read_text().split("\n---\n"), strict=True):
            name = f"touch_retrieval_msgs/msg/{path.stem}{suffix}"
            defined |= get_types_from_msg(text, name)
            for field, default in re.findall(r"^\w+ (\w+) +([\d.]+)", text, re.M):
                defaults[name, field] = float(default) if "." in default else int(default)
    defined["std_srvs/msg/Trigger_Request"] = ([], [])
    defined |= get_types_from_msg("bool success\nstring message\n", "std_srvs/msg/Trigger_Response")
    return defined, defaults


DEFINED, DEFAULTS = _definitions()
CLASSES: dict[str, Any] = {}


def message_class(name):
    """Return the class of a message such as "sensor_msgs/msg/Image"."""
    if name not in CLASSES:
        constants, fields = DEFINED[name]
        names = {"_fields": dict(fields), "_name": name, "__slots__": [field for field, _ in fields]}
        values = {key: bytes([value]) if kind == "byte" else value for key, kind, value in constants}
        CLASSES[name] = type(name.rsplit("/")[-1], (FakeMessage,), names | values)
    return CLASSES[name]


class FakeMessage:
    """Base of the classes of messages."""

    __slots__ = ()
    _fields: ClassVar[dict[str, Any]] = {}
    _name = ""

    def __init__(self, **values):
        for field, kind in self._fields.items():
            default = DEFAULTS.get((self._name, field), _class(kind)[0]())
            setattr(self, field, values.pop(field, default))
        assert not values, f"{self._name} has no field {', '.join(values)}"

    def __setattr__(self, field, value):
        assert _has_type(value, self._fields[field]), f"{self._name}.{field} must not be {value!r}"
        object.__setattr__(self, field, value)


def _class(kind):
    """Return the class of the values of a field, and the type of the items of a list."""
    node, what = kind
    if node == Nodetype.BASE:
        return (partial(bytes, 1) if what[0] == "byte" else NUMBERS[what[0]]), None
    if node == Nodetype.NAME:
        return message_class(what), None
    return (partial(array, "B"), None) if what[0][1][0] == "uint8" else (list, what[0])


def _has_type(value, kind):
    made, item_kind = _class(kind)
    return isinstance(value, type(made())) and (not item_kind or all(_has_type(item, item_kind) for item in value))


def from_bag(message):
    """Return a message that rosbags read as the class that rclpy would give to a subscription."""
    name = message.__msgtype__
    values = {}
    for field, (node, _) in DEFINED[name][1]:
        value = getattr(message, field)
        values[field] = from_bag(value) if node == Nodetype.NAME else value
        if hasattr(value, "tobytes"):
            values[field] = array("B", value.tobytes())
    return message_class(name)(**values)


class FakeNode:
    """A node whose topics, services, actions and timers a test uses."""

    def __init__(self, name, overrides):
        self.name, self.overrides, self.now_ns, self.is_destroyed = name, overrides, 0, False
        self.published, self.log = {}, []
        self.subscriptions, self.services, self.actions, self.timers = {}, {}, {}, []

    def declare_parameter(self, name, default):
        value = self.overrides.get(name, default)
        assert type(value) is type(default), f"the parameter {name} must have the type of {default!r}"
        return SimpleNamespace(value=value)

    def create_subscription(self, kind, topic, callback, qos, *, callback_group):
        self.subscriptions[topic] = kind, callback

    def create_publisher(self, kind, topic, qos):
        messages = self.published.setdefault(topic, [])

        def publish(message):
            assert isinstance(message, kind)
            messages.append(message)

        return SimpleNamespace(publish=publish)

    def create_service(self, kind, name, callback, *, callback_group):
        self.services[name] = kind, callback

    def create_timer(self, period_s, callback):
        self.timers.append(callback)

    def get_clock(self):
        def to_msg():
            return message_class("builtin_interfaces/msg/Time")(sec=self.now_ns // 10**9, nanosec=self.now_ns % 10**9)

        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=self.now_ns, to_msg=to_msg))

    def get_logger(self):
        return SimpleNamespace(info=self.log.append, warning=self.log.append)

    def destroy_node(self):
        self.is_destroyed = True

    # The client ----------------------------------------------------------------------------------------------

    def deliver(self, topic, message):
        """Give a message to the subscription of a topic."""
        kind, callback = self.subscriptions[topic]
        assert isinstance(message, kind), f"{topic} has another type"
        callback(message)

    def call(self, name, **fields):
        """Call a service and return its response."""
        kind, callback = self.services[name]
        return callback(kind.Request(**fields), kind.Response())

    def send_goal(self, name, on_feedback=lambda goal, feedback: None, **fields):
        """Execute a goal; return its handle and result."""
        server = self.actions[name]
        goal = FakeGoal(server, server.kind.Goal(**fields), on_feedback)
        result = server.execute(goal)
        assert isinstance(result, server.kind.Result)
        assert goal.status
        return goal, result


class FakeActionServer:
    def __init__(self, node, kind, name, execute_callback, *, callback_group, cancel_callback):
        self.kind, self.execute, self.cancel_callback = kind, execute_callback, cancel_callback
        node.actions[name] = self


class FakeGoal:
    """A goal handle; the node sets its status once."""

    def __init__(self, server, request, on_feedback):
        self.server, self.request, self.on_feedback = server, request, on_feedback
        self.status, self.is_cancel_requested = "", False
        self.succeed, self.abort, self.canceled = (
            partial(self._set, status) for status in ("succeeded", "aborted", "canceled")
        )

    def publish_feedback(self, message):
        assert isinstance(message, self.server.kind.Feedback)
        self.on_feedback(self, message)

    def cancel(self):
        """Request the cancellation, as a client does."""
        self.is_cancel_requested = self.server.cancel_callback(self) == "accept"

    def _set(self, status):
        assert not self.status
        self.status = status


class ExternalShutdownException(Exception):
    pass


class StoppedExecutor:
    """An executor in a process that is stopped at once."""

    def __init__(self, num_threads): ...

    def add_node(self, node): ...

    def spin(self):
        raise ExternalShutdownException


def _service(name, *parts):
    return type(name, (), {part: message_class(f"{name}_{part}") for part in parts})


def _modules(overrides, nodes):
    def create_node(name):
        nodes.append(FakeNode(name, overrides))
        return nodes[-1]

    callback_groups = dict.fromkeys(("MutuallyExclusiveCallbackGroup", "ReentrantCallbackGroup"), object)
    ours = {}
    for path in FILES:
        kind, name = path.suffix[1:], f"touch_retrieval_msgs/msg/{path.stem}"
        made = message_class(name) if kind == "msg" else _service(name, *(part[1:] for part in PARTS[path.suffix]))
        ours.setdefault(f"touch_retrieval_msgs.{kind}", {})[path.stem] = made
    theirs = {
        f"{package}.msg": {name: message_class(f"{package}/msg/{name}") for name in names}
        for package, names in (
            ("sensor_msgs", ("Image", "CompressedImage")),
            ("diagnostic_msgs", ("DiagnosticArray", "DiagnosticStatus", "KeyValue")),
        )
    }
    return {
        "rclpy": {"init": lambda: None, "ok": lambda: True, "try_shutdown": lambda: None, "create_node": create_node},
        "rclpy.action": {
            "ActionServer": FakeActionServer,
            "CancelResponse": SimpleNamespace(ACCEPT="accept", REJECT="reject"),
        },
        "rclpy.callback_groups": callback_groups,
        "rclpy.executors": {
            "ExternalShutdownException": ExternalShutdownException,
            "MultiThreadedExecutor": StoppedExecutor,
        },
        "rclpy.qos": {"qos_profile_sensor_data": object()},
        "std_srvs.srv": {"Trigger": _service("std_srvs/msg/Trigger", "Request", "Response")},
        **ours,
        **theirs,
    }


@contextmanager
def node_module():
    """Import `touch_retrieval_ros.node` with the stub; yield it, the parameters to set, and the created nodes."""
    overrides: dict[str, Any] = {}
    nodes: list[FakeNode] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(FOLDER / "touch_retrieval_ros")
        for name, members in _modules(overrides, nodes).items():
            package = name.partition(".")[0]
            patch.setitem(sys.modules, package, sys.modules.get(package, ModuleType(package)))
            module = ModuleType(name) if "." in name else sys.modules[name]
            vars(module).update(members)
            patch.setitem(sys.modules, name, module)
        yield import_module("touch_retrieval_ros.node"), overrides, nodes
        for name in [name for name in sys.modules if name.startswith("touch_retrieval_ros")]:
            del sys.modules[name]
