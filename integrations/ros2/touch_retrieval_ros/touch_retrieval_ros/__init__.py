"""ROS 2 node that identifies and verifies the object in a gripper by its gel images."""
