"""The service's routes: one module a concern, each a router built around the station."""
