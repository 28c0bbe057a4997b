"""Start the node: `ros2 launch touch_retrieval_ros touch_retrieval.launch.py index:=/data/index`."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

ARGUMENTS = {
    "index": ("index", str, "folder of the index"),
    "model": ("", str, "path of the checkpoint, if it was moved"),
    "image_topics": ("[/gel/a, /gel/b]", None, "topic of the gel images of each finger"),
    "compressed": ("false", None, "whether the topics have the type sensor_msgs/CompressedImage"),
    "use_sim_time": ("false", None, "whether the time is that of /clock, as with a bag or a simulator"),
}
"""Default, type (None: read as YAML) and description of each argument, which is also a parameter of the node."""


def generate_launch_description() -> LaunchDescription:
    """Return the node and its arguments."""
    arguments = [
        DeclareLaunchArgument(name, default_value=default, description=description)
        for name, (default, _, description) in ARGUMENTS.items()
    ]
    parameters = {
        name: ParameterValue(LaunchConfiguration(name), value_type=kind) for name, (_, kind, _) in ARGUMENTS.items()
    }
    node = Node(
        package="touch_retrieval_ros",
        executable="touch_retrieval",
        name="touch_retrieval",
        output="screen",
        parameters=[parameters],
    )
    return LaunchDescription([*arguments, node])
