"""`try`: shows whether a device's driver keeps the promises of its port; only printed without --live."""

import asyncio
from typing import Literal

from robot_client.cli.terminal import Outcome, rehearsed, show, show_steps, stop_on_signals, warning
from robot_client.ports import DriverError, Finding
from robot_client.session.trial.arm import ArmTrial, up_mm
from robot_client.session.trial.gripper import try_empty, try_part
from robot_client.settings import Settings

Subject = Literal["arm", "gripper", "part"]
_STEPS = {
    "arm": [
        "go up by {up_mm:g} mm from where it stands, with no watch for touch",
        "descend, and hold on the way",
        "{legs}",
        "descend again, and let the lease end: a failure",
    ],
    "gripper": ["close the open, empty fingers twice, and open them again"],
    "part": ["close the open fingers on the part between them", "leave it alone, and come back", "wait for its loss"],
}
_LEGS = "descend at two speeds, and have the lease renewed on the way"


def try_device(settings: Settings, subject: Subject, *, live: bool) -> Outcome:
    """Done if every promise is kept; raises DriverError if the device cannot be made ready."""
    show(warning(live=live, simulated=settings.simulated))
    pauses = settings.robot.pauses
    known = {"up_mm": up_mm(settings.ramps, settings.lease, pauses=pauses), "legs": _LEGS if pauses else ""}
    steps = [text for step in _STEPS[subject] if (text := step.format(**known))]
    if not live:
        return rehearsed("would:", steps)
    show_steps("will:", steps)
    return asyncio.run(_try(settings, subject))


async def _try(settings: Settings, subject: Subject) -> Outcome:
    findings: list[Finding] = []

    def note(finding: Finding) -> None:
        findings.append(finding)
        show(f"{'ok  ' if finding.good else 'BAD '} {finding.text}")

    stop_on_signals()
    try:
        if subject == "arm":
            limits, ramps, lease, timeouts = settings.limits, settings.ramps, settings.lease, settings.timeouts
            await ArmTrial(settings.make_arm(), limits, ramps, lease, timeouts, settings.robot.pauses).run(note)
        elif subject == "gripper":
            await try_empty(settings.make_gripper, settings.timeouts.grasping_s, note)
        else:
            await try_part(settings.make_gripper, settings.timeouts.grasping_s, note, show)
    except asyncio.CancelledError:
        raise DriverError("operator: interrupted") from None
    kept = all(finding.good for finding in findings)
    show("every promise was kept" if kept else "NOT every promise was kept")
    return Outcome(kept, {"kept": kept, "findings": [finding._asdict() for finding in findings]})
