"""Prometheus metrics, fed by the hub."""

import asyncio
import time
from functools import partial
from itertools import product
from typing import Any, get_args

from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry, Counter, Gauge, Histogram, generate_latest

from service.cameras.capture import now_ns
from service.contract import Finger, wire
from service.contract.replies import ending
from service.observability.charts import CAUSES, SIDES
from service.perception.observation import Observation
from service.session.station import Station
from service.web.page.disk import Disk
from service.web.page.sentences import CHANGES

_STAGE_BUCKETS = (0.0005, 0.001, 0.002, 0.004, 0.008, 0.016, 0.033, 0.066, 0.13, 0.25, 0.5, 1, 2)

_NEWEST_NS = 100_000_000
NO_CAUSE = "none"
TURNED_AWAY: tuple[wire.FaultCode, ...] = ("bad_message", "busy", "forbidden", "not_ready", "protocol_version")


class Metrics:
    """Counts the hub's events in its own registry, so that two apps in one process do not collide."""

    def __init__(self, station: Station) -> None:
        self.registry = CollectorRegistry()
        make: dict[str, Any] = {"registry": self.registry, "namespace": "tactile"}
        self._station = station
        self._stages = Histogram("stage_seconds", "Time by stage", ["stage"], buckets=_STAGE_BUCKETS, **make)
        self._frames = Counter("frames", "Camera frames", ["finger"], **make)
        self._messages = Counter("messages", "Messages to clients", ["type"], **make)
        self._refusals = Counter("no_decisions", "Attempts without a correction", ["reason"], **make)
        self._finished = Counter("insertions", "Insertions by outcome and cause", ["outcome", "cause"], **make)
        self._refused = Counter("clients_refused", "Clients that could open no insertion, by why", ["code"], **make)
        Gauge("start_time_seconds", "When the service started, Unix time", **make).set(time.time())
        self._faults = Counter("camera_faults", "Camera faults", ["finger", "code"], **make)
        self._slip_age = Histogram("slip_age_seconds", "Capture to slip or enough", buckets=_STAGE_BUCKETS, **make)
        self._result_age = Histogram("result_age_seconds", "Capture to slip judgement", buckets=_STAGE_BUCKETS, **make)
        age = Gauge("frame_age_seconds", "Age of the newest frame", ["finger"], **make)
        expected = Gauge("frames_expected_hz", "Frames a second of the setting, else of the sensor", ["finger"], **make)
        dropped = Gauge("frames_dropped", "Frames dropped by backlog", **make)
        unpaired = Gauge("frames_unpaired", "Frames without a partner in time", **make)
        caught = Gauge("internal_errors", "Errors caught inside the service, each with a log line", ["where"], **make)
        recording = Gauge("recording_ok", "1 if the last insertion was recorded whole and the next can be", **make)
        unrecorded = Gauge("insertions_unrecorded", "Insertions that were not recorded whole", **make)
        left_out = Gauge("frames_unrecorded", "Frames and observations left out of ended recordings", **make)
        drift = Gauge("drift", "Control charts of the cell; 1 is their limit", ["chart"], **make)
        self._drifts = Counter("drift_alarms", "Control charts that crossed their limit, by cause", ["cause"], **make)
        for cause in CAUSES:
            self._drifts.labels(cause.what)
        for chart in SIDES:
            drift.labels(chart).set_function(partial(station.manager.charts.level, chart))
        self._versions = Gauge("version_evidence", "That a version beside should decide", ["role", "version"], **make)
        self._changes = Counter("version_changes", "Changes of versions of the networks", ["what"], **make)
        for what in CHANGES:
            self._changes.labels(what)
        ready = Gauge("ready", "1 if models are warm, cameras live and clients answered", **make)
        for finger in station.cameras:
            age.labels(finger).set_function(partial(self._age_s, finger))
            expected.labels(finger).set(station.expected_hz)
        dropped.set_function(lambda: station.counters.frames_dropped_n)
        unpaired.set_function(lambda: station.pairer.dropped_n)
        caught.labels("perception").set_function(lambda: station.counters.perception_errors_n)
        caught.labels("listener").set_function(lambda: station.hub.errors_n)
        self._disk = Disk(lambda: station.manager.unrecorded)
        recording.set_function(lambda: float(not self._disk.problem()))
        unrecorded.set_function(lambda: station.manager.unrecorded_n)
        left_out.set_function(lambda: station.manager.frames_unrecorded_n)
        ready.set_function(lambda: float(station.ready))
        self._counted: dict[Finger, int] = {}
        self._text, self._made_ns, self._making = b"", -_NEWEST_NS, asyncio.Lock()
        self._begin_series()
        station.hub.subscribe(self._on_event)

    def _begin_series(self) -> None:
        """Series that alerts read begin at 0: a worn gel gives no correction, and nothing is divided by no series."""
        for cause in get_args(wire.Cause):  # a series that begins at its first event hides that event from increase()
            self._finished.labels(ending(cause), cause)
        self._finished.labels("inserted", NO_CAUSE)
        for code in TURNED_AWAY:
            self._refused.labels(code)
        self._messages.labels("correction")
        for reason in get_args(wire.NoDecisionReason):
            self._refusals.labels(reason)
        for finger, fault in product(self._station.cameras, get_args(wire.FaultCode)):
            if fault.startswith("camera_"):
                self._faults.labels(finger, fault)
        for finger, camera in self._station.cameras.items():  # lost while the service waited for its cameras
            if camera.state == "lost":
                self._faults.labels(finger, "camera_lost").inc()

    def _age_s(self, finger: Finger) -> float:
        newest_ns = self._station.cameras[finger].newest_ns
        return float("nan") if newest_ns is None else (now_ns() - newest_ns) * 1e-9

    async def exposition(self) -> tuple[bytes, str]:
        """The text Prometheus scrapes, and its content type; at most ten a second are made, since each takes 1 ms.

        They are made in a thread, as the disk of the recordings may be slow to tell how much room it has.
        """
        async with self._making:
            if now_ns() - self._made_ns > _NEWEST_NS:
                self._text, self._made_ns = await asyncio.to_thread(self._made), now_ns()
        return self._text, CONTENT_TYPE_LATEST

    def _made(self) -> bytes:
        for finger, camera in self._station.cameras.items():
            counted = self._counted.get(finger, 0)
            self._counted[finger] = camera.frames_n
            self._frames.labels(finger).inc(self._counted[finger] - counted)
        self._versions.clear()
        state = self._station.versions.state()
        for role, rival in (("shadow", state.shadow), ("previous", state.previous)):
            if rival is not None:
                self._versions.labels(role, rival.version).set(rival.evidence)
        return generate_latest(self.registry)

    def _on_event(self, kind: str, content: Any) -> None:
        self._count(kind, content)
        match content:
            case Observation():
                self._result_age.observe((now_ns() - content.captured_ns) * 1e-9)
                for stage, cost_ms in content.cost_ms.items():
                    self._stages.labels(stage).observe(cost_ms / 1e3)
            case wire.Correction():
                for stage, cost_ms in content.latency_ms.items():
                    self._stages.labels(stage).observe(cost_ms / 1e3)
            case wire.NoDecision():
                self._refusals.labels(content.reason).inc()

    def _count(self, kind: str, content: Any) -> None:
        if kind == "message":
            self._messages.labels(content.type).inc()
        elif kind == "finished":
            self._finished.labels(content.outcome, content.cause or NO_CAUSE).inc()
        elif kind == "turned_away" and content in TURNED_AWAY:
            self._refused.labels(content).inc()
        elif kind == "stop_age_s":
            self._slip_age.observe(content)
        elif kind == "version":
            self._changes.labels(content["what"]).inc()
        elif kind == "drift":
            self._drifts.labels(content["cause"]).inc()
        elif kind == "camera_fault":
            self._faults.labels(content["finger"], content["code"]).inc()
