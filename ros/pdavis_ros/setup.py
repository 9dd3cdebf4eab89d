"""Package of the node, for colcon."""
from setuptools import setup

setup(
    name="pdavis_ros",
    version="0.1.0",
    packages=["pdavis_ros"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/pdavis_ros"]),
        ("share/pdavis_ros", ["package.xml"]),
        ("share/pdavis_ros/launch", ["launch/pdavis.launch.py"])],
    install_requires=["setuptools", "pdavis-cv"],
    license="Apache-2.0",
    entry_points={"console_scripts": ["pdavis_node = pdavis_ros.node:main"]},
)
