"""The node: subscribes to events and images, publishes S0, AoP, DoLP and a picture."""
from array import array as array_of

import rclpy
from event_camera_msgs.msg import EventPacket
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image

from pdavis_ros.fuser import QUANTITIES, Fuser, planes


class PdavisNode(Node):
    """Subscribe to ``events`` and ``image_raw``, publish ``~/s0`` and the others."""

    def __init__(self):
        super().__init__("pdavis")
        value = {name: self.declare_parameter(name, default).value
                 for name, default in (("layout", "pdavis"), ("fps", 50.0),
                                       ("method", ""), ("exposure_us", 0))}
        self._fuser = Fuser(
            layout=value["layout"], exposure_us=value["exposure_us"], fps=value["fps"],
            method=value["method"] or None)
        self._outputs = {
            name: self.create_publisher(Image, f"~/{name}", qos_profile_sensor_data)
            for name in (*QUANTITIES, "picture")}
        self._info = self.create_publisher(
            CameraInfo, "~/camera_info", qos_profile_sensor_data)
        self._inputs = [
            self.create_subscription(
                kind, topic, lambda message, take=take: self._take(message, take),
                qos_profile_sensor_data)
            for kind, topic, take in ((EventPacket, "events", self._fuser.events),
                                      (Image, "image_raw", self._fuser.image))]

    def _take(self, message, take):
        try:
            images = take(message)
        except ValueError as error:
            self.get_logger().error(str(error), throttle_duration_sec=5.0)
            return
        for image in images:
            self._publish(image, message.header.frame_id)

    def _publish(self, image, frame_id):
        info = CameraInfo()     # zeros: not calibrated
        info.height, info.width = image.shape
        messages = [(self._info, info)]
        for name, array, encoding in planes(image):
            one = Image()
            one.height, one.width = array.shape[:2]
            one.encoding, one.step = encoding, array.strides[0]
            one.data = array_of("B", array.tobytes())  # as rclpy holds it
            messages.append((self._outputs[name], one))
        for publisher, message in messages:
            message.header.frame_id = frame_id
            message.header.stamp.sec, microseconds = divmod(image.t_us, 1_000_000)
            message.header.stamp.nanosec = 1000 * microseconds
            publisher.publish(message)

    def destroy_node(self):
        """End the session as well."""
        self._fuser.close()
        super().destroy_node()


def main():
    """Run the node until it is interrupted."""
    rclpy.init()
    node = PdavisNode()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
