"""Files of the two ROS packages: definitions, dependencies, parameters, launch file, README. ROS did not build them."""

import ast
import re
import sys
import xml.etree.ElementTree as ET

import pytest

pytest.importorskip("rosbags")

from retrieval.model import gel_check, verification
from retrieval.search import answer
from retrieval.version import __version__
from tests.documents import table_rows
from tests.integrations.fake_rclpy import DEFINED, FILES, FOLDER, MESSAGES, node_module

ROS = FOLDER / "touch_retrieval_ros"
MODULES = sorted((ROS / "touch_retrieval_ros").glob("*.py"))


def dependencies(folder):
    root = ET.parse(folder / "package.xml").getroot()
    return {item.text for tag in ("depend", "exec_depend") for item in root.iter(tag)}


def imported(path):
    nodes = list(ast.walk(ast.parse(path.read_text())))
    names = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    names |= {node.module for node in nodes if isinstance(node, ast.ImportFrom)}
    return {name.partition(".")[0] for name in names}


def test_the_constants_of_the_messages_are_those_of_the_answers():
    def constants(name):
        return {value for _, _, value in DEFINED[f"touch_retrieval_msgs/msg/{name}"][0]}

    assert constants("Answer") == set(answer.EXIT_CODES)
    undecided = {gel_check.NO_CONTACT, gel_check.NOT_A_GEL}
    decisions = {verification.ACCEPT, verification.REJECT, verification.ANOTHER_GRASP}
    assert constants("Verify_Response") == decisions | undecided


def test_the_packages_depend_on_all_that_they_import():
    ours = {"retrieval", "robot", "indexes", "numpy", "touch_retrieval_ros"}
    launch = ROS / "launch" / "touch_retrieval.launch.py"
    names = set().union(*map(imported, (*MODULES, launch))) - set(sys.stdlib_module_names) - ours
    assert dependencies(ROS) == names
    packages = {name.partition("/")[0] for path in FILES for name in re.findall(r"^(\w+/\w+)", path.read_text(), re.M)}
    assert packages - {"touch_retrieval_msgs"} <= dependencies(MESSAGES)
    built = re.findall(r'"(\w+/\w+\.\w+)"', (MESSAGES / "CMakeLists.txt").read_text())
    assert set(built) == {str(path.relative_to(MESSAGES)) for path in FILES}


def test_the_packages_have_the_version_of_the_project():
    for folder in (ROS, MESSAGES):
        assert ET.parse(folder / "package.xml").find("version").text == __version__
    assert f'version="{__version__}"' in (ROS / "setup.py").read_text()


def test_the_readme_lists_all_parameters_with_their_defaults_and_the_launch_file_has_no_others():
    with node_module() as (module, _, _):
        parameters = {name: str(default).replace("'", '"') for name, default in module.PARAMETERS.items()}
    rows = [row for row in table_rows(FOLDER / "README.md") if row[0].strip("`") in parameters]
    documented = {row[0].strip("`"): row[1].strip("`") for row in rows}
    assert documented == {name: {"": '""', "False": "false"}.get(value, value) for name, value in parameters.items()}
    arguments = re.findall(r'^    "(\w+)": \(', (ROS / "launch" / "touch_retrieval.launch.py").read_text("utf-8"), re.M)
    assert "index" in arguments
    assert set(arguments) - {"use_sim_time"} <= set(parameters)
