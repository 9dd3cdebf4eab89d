"""Start the node with the topics of a driver.

ros2 launch pdavis_ros pdavis.launch.py events:=/event_camera/events
"""
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

ARGUMENTS = {
    "events": ("/event_camera/events", "topic of event_camera_msgs/EventPacket"),
    "image": ("/event_camera/image_raw", "topic of mono8 or mono16 images"),
    "layout": ("pdavis", "polarizers of the 2x2 cell"),
    "fps": ("50.0", "images per second"),
    "method": ("", "method of fusion; empty: the best for what arrives"),
    "exposure_us": ("0", "exposure of the images, us; 0: not known"),
}
TYPES = {"layout": str, "method": str, "fps": float, "exposure_us": int}


def generate_launch_description():
    """Return the node and its arguments."""
    return LaunchDescription([
        *(DeclareLaunchArgument(name, default_value=value, description=text)
          for name, (value, text) in ARGUMENTS.items()),
        Node(package="pdavis_ros", executable="pdavis_node", name="pdavis",
             remappings=[("events", LaunchConfiguration("events")),
                         ("image_raw", LaunchConfiguration("image"))],
             parameters=[{name: ParameterValue(LaunchConfiguration(name),
                                               value_type=kind)
                          for name, kind in TYPES.items()}])])
