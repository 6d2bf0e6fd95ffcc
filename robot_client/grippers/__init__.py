"""Grippers, one folder per device, behind the port :class:`robot_client.ports.Gripper`."""
