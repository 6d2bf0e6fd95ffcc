"""The web server: application, access, metrics, routes, dashboard."""
