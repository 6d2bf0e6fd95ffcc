"""The state of the cell and its alarms under /v1: what the page shows, for whoever wants to know it otherwise."""

from typing import Any

from fastapi import APIRouter, HTTPException

from service.web.access import Access
from service.web.page.status import Status


def router(status: Status, access: Access) -> APIRouter:
    routes = APIRouter(prefix="/v1", tags=["v1"])
    watch = [access.require("watch")]

    @routes.get("/status", dependencies=watch)
    def snapshot() -> dict[str, Any]:
        """What is going on, how the last insertion ended, and the alarms: unacknowledged ones first, all of them."""
        return status.snapshot()

    @routes.post("/alarms/{number}/acknowledge", dependencies=watch)
    def acknowledge(number: int) -> dict[str, int]:
        """A person has seen an alarm. Nothing moves because of it."""
        if not status.acknowledge(number):
            raise HTTPException(404, f"no alarm {number}")
        return {"acknowledged": number}

    return routes
