"""Files of the two ROS packages: definitions, dependencies, parameters, launch file, README. ROS did not build them."""

import ast
import re
import runpy
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ET
import zipfile
from types import ModuleType, SimpleNamespace

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


def test_the_readme_lists_all_parameters_with_their_defaults():
    with node_module() as (module, _, _):
        parameters = {name: str(default).replace("'", '"') for name, default in module.PARAMETERS.items()}
    rows = [row for row in table_rows(FOLDER / "README.md") if row[0].strip("`") in parameters]
    documented = {row[0].strip("`"): row[1].strip("`") for row in rows}
    assert documented == {name: {"": '""', "False": "false"}.get(value, value) for name, value in parameters.items()}


def recorded(*args, **fields):
    """Return a part of a launch file, with its arguments."""
    return SimpleNamespace(args=args, **fields)


def test_the_launch_file_gives_the_node_its_arguments_as_parameters(monkeypatch):
    for name, member in (
        ("launch", "LaunchDescription"),
        ("launch.actions", "DeclareLaunchArgument"),
        ("launch.substitutions", "LaunchConfiguration"),
        ("launch_ros", ""),
        ("launch_ros.actions", "Node"),
        ("launch_ros.parameter_descriptions", "ParameterValue"),
    ):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
        setattr(sys.modules[name], member, recorded)
    content = runpy.run_path(str(ROS / "launch" / "touch_retrieval.launch.py"))
    *arguments, node = content["generate_launch_description"]().args[0]
    (parameters,) = node.parameters
    assert [argument.args[0] for argument in arguments] == list(parameters)
    assert {name: value.args[0].args[0] for name, value in parameters.items()} == {name: name for name in parameters}
    with node_module() as (module, _, _):
        assert set(parameters) - {"use_sim_time"} <= set(module.PARAMETERS)
    assert f"{node.executable} = {node.package}.node:main" in (ROS / "setup.py").read_text().replace(
        "{NAME}", node.package
    )


def test_setuptools_builds_the_package_with_its_launch_file_and_program(tmp_path):
    shutil.copytree(ROS, tmp_path / "source")
    command = [sys.executable, "setup.py", "-q", "bdist_wheel", "--dist-dir", str(tmp_path)]
    done = subprocess.run(command, cwd=tmp_path / "source", capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    with zipfile.ZipFile(next(tmp_path.glob("*.whl"))) as wheel:
        names = wheel.namelist()
    for path in (*MODULES, ROS / "package.xml", ROS / "launch" / "touch_retrieval.launch.py"):
        assert any(name.endswith("/".join(path.relative_to(ROS).parts)) for name in names), path
    assert any(name.endswith("resource_index/packages/touch_retrieval_ros") for name in names)
