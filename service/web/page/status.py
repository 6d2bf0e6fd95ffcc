"""The state of the cell for the page: one snapshot, sent on connecting and after each change."""

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

from service.contract import FINGERS, wire
from service.contract.replies import MEANT, descended_n
from service.contract.words.causes import CAUSES
from service.observability.hub import Hub
from service.session.station import Station
from service.web.page.alarms import FILE, Alarms
from service.web.page.disk import SILENT, Disk
from service.web.page.past import Last, newest
from service.web.page.running import ANSWERED, Running
from service.web.page.sentences import CHARTS, PHASES, changed, ended, event, versions

EVENTS_N = 30
AFRESH_S = 90.0  # the trip to the fixture and back takes some 16 s, 300 mm away
SHOWN_ALARMS_N = 20
RECORDING_REMEDY = "The cell goes on. Make room on that disk, or see that it can be written."
SILENT_REMEDY = "No insertion begins until it answers: check that disk, its server and the network between."
STANDSTILL = "The service stands still"
STANDSTILL_REMEDY = "If it does so for a minute, restart it and report its log."
CAMERA_REMEDY = "Check cable and power of that finger. It comes back by itself."


class Status:
    """Follows the hub's events from the start of the service, whether or not a page is open. Thread safe."""

    def __init__(self, station: Station) -> None:
        self._station = station
        self._alarms = Alarms(station.settings.recordings / FILE)
        self._disk = Disk(lambda: station.manager.unrecorded)
        self._lock = threading.Lock()
        self._running: Running | None = None
        self._continues: str | None = None
        self._last, self._put_back = newest(station.settings.recordings)  # the latter: another one may go on with it
        gone_s = time.time() - self._last.at_s if self._last and self._last.at_s else 0.0
        self._put_back_s = time.monotonic() - max(0.0, gone_s)  # the clock may have been set back since
        self._overdue = False
        self._events: deque[dict[str, Any]] = deque(maxlen=EVENTS_N)
        self._unrecorded = ""  # the remedy of what keeps insertions from being recorded
        self._recorded: str | None = None  # the last insertion that has its place in the history
        self.changes_n = 0
        self._note_interrupted()
        self._follow(station.hub)

    def _follow(self, hub: Hub) -> None:
        handlers: dict[str, Callable[[Any], None]] = {
            "message": self._on_message,
            "client": self._on_client,
            "robot": self._on_robot,
            "command": self._on_command,
            "camera_fault": self._on_camera_fault,
            "error": self._on_error,
            "unrecorded": self._on_unrecorded,
            "drift": self._on_drift,
            "version": self._on_version,
            "recorded": self._on_recorded,
        }

        def on_event(kind: str, content: Any) -> None:
            if handler := handlers.get(kind):
                with self._lock:
                    handler(content)
                    self.changes_n += 1

        hub.subscribe(on_event)
        for finger, camera in self._station.cameras.items():  # what was lost while the service waited for its cameras
            if camera.state == "lost":
                on_event("camera_fault", {"finger": finger, "code": "camera_lost", "detail": camera.last_fault})

    def _note_interrupted(self) -> None:
        """Raise an alarm for an insertion interrupted by a crash of the service: its end is unknown.

        An insertion that has its alarm gets no second one, at however many starts it is the last.
        """
        last = self._last
        key = f"insertion {last.insertion_id}" if last else ""
        if any(alarm.key == key for alarm in self._alarms.all):
            self._overdue = True
        elif last and last.outcome == "interrupted":
            detail = "The service ended during it, or the disk was full."
            remedy, named = "Look where the object is; start a new insertion.", last.insertion_id
            self._alarms.sound(key, "stop", "An insertion broke off", detail=detail, remedy=remedy, insertion_id=named)

    # ---- events -----------------------------------------------------------------------------------------------------

    def _on_message(self, message: Any) -> None:
        running = self._running
        if isinstance(message, wire.ServiceHello) and not (running and running.insertion_id == message.insertion_id):
            running = self._running = self._opened(message.insertion_id)
        if text := event(message, running.earlier_n if running else 0):
            self._events.append({"at_s": time.time(), "kind": message.type, "text": text})
        if running is None or running.insertion_id != message.insertion_id:
            return
        if isinstance(message, wire.Finished):
            self._on_finished(message, running)
        else:
            running.from_service(message)

    def _opened(self, insertion_id: str) -> Running:
        """An insertion that opens: a new one, or one that continues with a regrasped object."""
        self._note_overdue()  # perhaps nobody has looked
        before, self._put_back = self._put_back, None
        if before is not None and before.insertion_id == self._continues:
            return before.goes_on(insertion_id)
        self._events.clear()
        return Running(insertion_id)

    def _on_client(self, message: Any) -> None:
        if isinstance(message, wire.ClientHello):
            self._continues = message.continues
        if self._running is not None:
            self._running.from_client(message)

    def _on_robot(self, sample: wire.RobotSample) -> None:
        if self._running is not None:
            self._running.robot(sample)

    def _on_command(self, command: Any) -> None:
        if self._running is not None:
            self._running.believes(command)

    def _on_finished(self, message: wire.Finished, running: Running) -> None:
        cause = message.cause
        attempts_n = running.earlier_n + message.attempts
        words = ended(message.outcome, cause, attempts_n, running.object, running.afresh_n)
        at_s, took_s = time.time(), time.monotonic() - running.began_s  # the wall clock may have been set meanwhile
        self._last = Last(message.insertion_id, message.outcome, cause, words, attempts_n, running.object, at_s, took_s)
        running.descended_n = running.earlier_n + descended_n(cause, message.attempts, message.doubts)
        self._running, self._put_back = None, running if message.outcome != "inserted" else None
        self._put_back_s, self._overdue = time.monotonic(), False
        if cause is not None and cause not in MEANT:
            detail = "; ".join(doubt.detail for doubt in message.doubts) or running.problem
            self._alarms.sound(
                f"insertion {message.insertion_id}",
                "stop",
                words,
                detail=detail,
                remedy=CAUSES[cause].remedy,
                insertion_id=message.insertion_id,
            )

    def _on_camera_fault(self, fault: dict[str, str]) -> None:
        finger = fault["finger"]
        title = f"{finger} camera {fault['code'].removeprefix('camera_')}"
        self._alarms.sound(
            f"camera {finger}", "warning", title.capitalize(), detail=fault["detail"], remedy=CAMERA_REMEDY
        )

    def _on_error(self, detail: str) -> None:
        self._alarms.sound("service", "warning", "Fault of the service", detail=str(detail), remedy="Read its log.")

    def _on_unrecorded(self, problem: str) -> None:
        """Raise an alarm when insertions begin not to be recorded, and none as long as its remedy stays the same."""
        remedy = _remedy(problem)
        if remedy not in {"", self._unrecorded}:
            title = "Insertions are not recorded"
            self._alarms.sound("recording", "warning", title, detail=problem, remedy=remedy)
        self._unrecorded = remedy

    def _on_drift(self, drift: dict[str, str]) -> None:
        title = f"The cell drifts: likely {drift['cause']}"
        detail = f"It shows in {CHARTS[drift['chart']]}."
        self._alarms.sound(f"drift {drift['chart']}", "warning", title, detail=detail, remedy=drift["remedy"])

    def _on_version(self, version: dict[str, str]) -> None:
        text = changed(version)
        self._events.append({"at_s": time.time(), "kind": "version", "text": text})
        if version["what"] == "rolled_back" and not version["why"].startswith("by hand"):
            remedy = "Nothing to do at the cell: what worked before works again. Adapt the networks anew."
            facts = {"detail": f"{text[0].upper()}{text[1:]}.", "remedy": remedy}
            self._alarms.sound("version", "warning", "The networks of before decide again", **facts)

    def _on_recorded(self, finished: wire.Finished) -> None:
        self._recorded = finished.insertion_id

    def acknowledge(self, number: int) -> bool:
        """Acknowledge an alarm on a person's behalf; False if there is no such alarm."""
        with self._lock:
            self.changes_n += 1
            return self._alarms.acknowledge(number)

    # ---- snapshot ---------------------------------------------------------------------------------------------------

    def snapshot(self) -> dict[str, Any]:
        """Everything the page needs to know, whenever it connects."""
        health = self._health()
        with self._lock:
            self._note_overdue()
            self._on_unrecorded(health["recording"])
            listed = self._alarms.shown(SHOWN_ALARMS_N)
            alarms = [asdict(alarm) | {"active": self._is_active(alarm.key, health)} for alarm in listed]
            running, last = self._running, self._last
            now_s, steady_s = time.time(), time.monotonic()
            shown = running and asdict(running) | {
                "began_s": now_s - (steady_s - running.began_s),
                "attempts_max": running.most_n,
                "words": PHASES.get(running.phase, running.phase),
            }
            return {
                "now_s": now_s,
                "headline": self._headline(health),
                "running": shown,
                "last": asdict(last) if last else None,
                "recorded": self._recorded,
                "alarms": alarms,
                "open_alarms_n": len(self._alarms.open),
                "events": list(self._events)[::-1],
                "health": health,
            }

    @property
    def _regrasps(self) -> bool:
        """Whether the arm regrasps the object; after another end a person may put it back, at any time."""
        return self._put_back is not None and self._last is not None and self._last.cause == "afresh"

    def _note_overdue(self) -> None:
        """Note an overdue regrasp: the arm may have stopped on its way, where the service hears nothing."""
        waiting, late_s = self._put_back, time.monotonic() - self._put_back_s - AFRESH_S
        if waiting is None or not self._regrasps or self._overdue or late_s < 0.0:
            return
        self._overdue, named = True, waiting.insertion_id
        title, detail = "Holding: the object was to be regrasped", f"Nothing went on within {AFRESH_S:g} s."
        remedy = "Look at the pendant and at what the robot client says; start a new insertion."
        facts = {"detail": detail, "remedy": remedy, "insertion_id": named}
        self._alarms.sound(f"insertion {named}", "stop", title, late_s, **facts)

    def _headline(self, health: dict[str, Any]) -> dict[str, str]:
        """The most important fact now: an unacknowledged stop, else the present activity."""
        bad = [finger for finger in FINGERS if health["cameras"][finger]["state"] != "live"]
        stop = next((alarm for alarm in self._alarms.open if alarm.level == "stop"), None)
        unseen = f"No picture from the {' and the '.join(bad)} camera" if bad else ""
        still = STANDSTILL if health["standstill"] else ""
        if self._running is not None:
            running = self._running
            counted = f"Attempt {running.attempt} of {running.most_n}: " if running.attempt else ""
            if running.afresh_n and running.attempt == running.earlier_n:
                counted = "Regrasped: "
            words = PHASES.get(running.phase, running.phase)
            text = words[:1].lower() + words[1:] if counted else words  # a client may name no phase
            alone = "" if health["driver"] else "No connection to the robot client"
            level = "warning" if running.phase in ANSWERED or bad or alone or still else "busy"
            detail = ". ".join(part for part in (still, alone, unseen, running.problem) if part)
            return {"level": level, "words": counted + text, "detail": detail}
        if stop is not None:
            return {"level": "stop", "words": stop.title, "detail": f"{stop.remedy}\n{stop.detail}".strip()}
        if still or bad:
            remedy = SILENT_REMEDY if self._unrecorded == SILENT_REMEDY else STANDSTILL_REMEDY
            detail = f"{remedy}\n{health['standstill']}" if still else CAMERA_REMEDY
            return {"level": "warning", "words": still or unseen, "detail": detail}
        if self._regrasps and not self._overdue and self._last is not None:
            return {"level": "busy", "words": self._last.words, "detail": CAUSES["afresh"].remedy}
        if self._last is not None and self._last.at_s is not None and self._last.cause is None:
            return {"level": "good", "words": self._last.words, "detail": "Ready for the next object."}
        return {"level": "good", "words": "Ready for the next object", "detail": ""}

    def _is_active(self, key: str, health: dict[str, Any]) -> bool:
        """Whether an alarm's fault still exists, as far as can be determined."""
        what, _, name = key.partition(" ")
        if what == "camera":
            return name in health["cameras"] and health["cameras"][name]["state"] != "live"
        if what == "drift":
            return self._station.manager.charts.level(name) >= 1.0
        return what == "recording" and bool(health["recording"])

    def _health(self) -> dict[str, Any]:
        station = self._station
        active = station.active
        return {
            "ready": station.ready,
            "standstill": station.standstill,
            "cameras": {f: station.cameras[f].entry.model_dump() for f in FINGERS},
            "driver": active.session.insertion_id if active and active.send else None,
            "recording": self._disk.problem(),
            "frames_dropped_n": station.counters.frames_dropped_n,
            "insertions_n": station.manager.opened_n,
            "versions": versions(station.versions.state()),
            "versions_problem": station.versions.problem,
        }


def _remedy(problem: str) -> str:
    """What to do about insertions that are not recorded; "" if they are."""
    if problem.startswith(SILENT):
        return SILENT_REMEDY
    return RECORDING_REMEDY if problem else ""
