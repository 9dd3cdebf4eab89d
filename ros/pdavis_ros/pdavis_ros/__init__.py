"""A ROS 2 node of pdavis_cv."""
