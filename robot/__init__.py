"""Robot rigs, the recordings that they write, and importers of public data sets. Imports neither torch nor faiss.

Public names are imported on first use, so `import robot` is cheap.

>>> import robot
>>> rig = robot.load_rig("sim", seed=0)
>>> rig.info["source"]
'simulated rig'
"""

from typing import TYPE_CHECKING

from _touch_retrieval.lazy import lazy_names

if TYPE_CHECKING:
    from robot.collection import CollectSettings as CollectSettings
    from robot.collection import collect as collect
    from robot.devices import Arm as Arm
    from robot.devices import Camera as Camera
    from robot.devices import Gripper as Gripper
    from robot.devices import TactileSensor as TactileSensor
    from robot.errors import RobotError as RobotError
    from robot.importers import load_importer as load_importer
    from robot.readings import Frame as Frame
    from robot.readings import Pose as Pose
    from robot.recording.folder import Recording as Recording
    from robot.recording.folder import RecordingWriter as RecordingWriter
    from robot.recording.folder import SharedImage as SharedImage
    from robot.recording.folder import read_recording as read_recording
    from robot.recording.grasp import RecordedGrasp as RecordedGrasp
    from robot.rig import GraspPlan as GraspPlan
    from robot.rig import GraspPlanner as GraspPlanner
    from robot.rig import Rig as Rig
    from robot.rig import load_rig as load_rig
    from robot.sim.gel.sensor import draw_sensor as draw_sensor
    from robot.sim.objects.draw import draw_object as draw_object
    from robot.sim.scene import Grip as Grip
    from robot.sim.scene import Scene as Scene

_MODULES = {
    "Arm": "devices",
    "Camera": "devices",
    "CollectSettings": "collection",
    "Frame": "readings",
    "GraspPlan": "rig",
    "GraspPlanner": "rig",
    "Grip": "sim.scene",
    "Gripper": "devices",
    "Pose": "readings",
    "RecordedGrasp": "recording.grasp",
    "Recording": "recording.folder",
    "RecordingWriter": "recording.folder",
    "Rig": "rig",
    "RobotError": "errors",
    "Scene": "sim.scene",
    "SharedImage": "recording.folder",
    "TactileSensor": "devices",
    "collect": "collection",
    "draw_object": "sim.objects.draw",
    "draw_sensor": "sim.gel.sensor",
    "load_importer": "importers",
    "load_rig": "rig",
    "read_recording": "recording.folder",
}
"""Public name -> its module in this package."""

__all__ = list(_MODULES)

if not TYPE_CHECKING:  # with __getattr__, a type checker accepts every attribute name
    __getattr__, __dir__ = lazy_names(__name__, _MODULES)
