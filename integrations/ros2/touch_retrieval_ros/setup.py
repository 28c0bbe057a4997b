"""Build of the ament_python package."""

from setuptools import setup

NAME = "touch_retrieval_ros"

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/touch_retrieval.launch.py"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    maintainer="The touch-retrieval developers",
    description="Identify and verify the object in a gripper by its gel images.",
    license="MIT",
    entry_points={"console_scripts": [f"touch_retrieval = {NAME}.node:main"]},
)
