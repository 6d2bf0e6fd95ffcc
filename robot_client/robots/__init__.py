"""Arms, one folder a device, behind the port :class:`robot_client.ports.Arm`."""
