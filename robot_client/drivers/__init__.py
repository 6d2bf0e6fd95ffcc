"""Device drivers behind the ports of :mod:`robot_client.ports`."""
