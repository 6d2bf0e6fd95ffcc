"""Whether the networks that decide took over with the gels that are calibrated now."""

from collections.abc import Mapping

from service.contract.frames import Finger
from service.decision.models import ModelSet
from service.versions.store import Wiring

Gels = Mapping[Finger, str]
"""The name of each finger's gel, where it is known."""


def unlike_gels(wiring: Wiring, networks: Mapping[str, ModelSet], gels: Gels) -> str:
    """Why networks that took over in this cell may no longer fit its ``gels``, and what to do; else empty.

    ``networks`` by version. Where a gel is not known, now or then, nothing speaks against it.
    """
    before = {} if wiring.active == wiring.released else wiring.gels.get(wiring.active, {})
    changed = [
        f"{finger} {before[finger]}, now {gel}" for finger, gel in gels.items() if before.get(finger, gel) != gel
    ]
    if not changed:
        return ""
    release = networks[wiring.released].folder
    last = wiring.beside.get("previous") == wiring.released
    back = "`versions rollback`" if last else f"`versions shadow {release}` and `versions promote`"
    took = f"version {wiring.active} took over with other gels, or before they were calibrated anew"
    return f"{took} ({'; '.join(changed)}): let the release decide again ({back}), then commission and adapt"
