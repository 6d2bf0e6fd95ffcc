"""Remedies for findings. The first pattern found in the text counts; device and software write these texts."""

import re

GENERAL = "Read the text on the left; docs/troubleshooting.md has more."
REMEDIES: tuple[tuple[str, str], ...] = (
    (r"another client has", "Run this again once that command has ended, or end it."),
    (r"processor cores", "Run client and service on a PC with two cores or more."),
    (r"load \d", "Stop what else runs on this PC; frames come late on a busy one."),
    (r"GB free", "Remove old recordings, or name another folder."),
    (r"recordings may not", "Give the folder to the user of the service."),
    (
        r"no record of a commissioning|not as it was written",
        "It is of another version, or damaged: move its folder away and `commission --live --config FILE` again.",
    ),
    (
        r"not commissioned to the end",
        "Run `tactile-insertion commission --live --config FILE` with the same --out to its end.",
    ),
    (r"cannot read configuration", "Name an existing file with --config."),
    (r"is not used|unknown key|is unknown|expected a (whole )?number|extra", "Correct that key in the configuration."),
    (r"allowed .*\.\.|ramps\.|allowed up to|limits allow", "Correct the pose, the ramp or the limit of that name."),
    (r"Cannot assign requested address", "Leave robot.bind out, or set it to an address of this PC."),
    (r"cannot listen on UDP", "Another client runs, or set robot.port to the port of UCdevice."),
    (r"HTTP 401|HTTP 403|Unauthorized|www-auth", "Set user and TACTILE_INSERTION_RWS_PASSWORD of the controller."),
    (r"HTTP 503|too many sessions", "The controller has no session left: end other clients, or wait a minute."),
    (r"signal .*HTTP 404", "Define the signal on the controller, or correct [cycle.plc]."),
    (r"operating mode", "Turn the key switch to automatic."),
    (r"emergencystop", "Release the emergency stop, then acknowledge it on the pendant."),
    (r"guardstop|protective", "Close the guard or clear the protective stop."),
    (r"sysfail", "Read the event log on the pendant and restart the controller."),
    (r"controller (motoroff|init)", "Switch the motors on, or allow robot.rws.switch_motors_on."),
    (r"speed ratio", "Set the speed ratio to 100 % on the pendant, and the speeds in [ramps]."),
    (r"RAPID running", "Stop the program on the pendant."),
    (r"how late pictures", "Commission again with a wider part or a firmer grip, or set lease.stop_lag_s."),
    (r"not homed", "Home the empty gripper: `tactile-insertion home --live --config FILE`."),
    (r"force_limit|grasp_", "Set the value of that name in [gripper] to one that the gripper allows."),
    (r"temperature warning", "Let the gripper cool, or lower force_limit_n: if it gets warmer, it stops with a fault."),
    (r"FAST_STOP|fault", "Find the cause, then `tactile-insertion home --live --config FILE --acknowledge`."),
    (
        r"gripper: .*no reply",
        "Check host and port; its web page must have the text based interface off: the binary protocol is needed.",
    ),
    (
        r"gripper: .*(closed the connection|connection lost)",
        "It takes one client at a time: end the other one; check host and port.",
    ),
    (r"gripper: cannot connect", "Check [gripper] host and port, its power, and the cable."),
    (
        r"cameras are swapped",
        "Give each finger its own camera: exchange plugs, or correct the service's settings.",
    ),
    (r"not the gel that", "Open the fingers and shade the gels; if it stays, calibrate and commission again."),
    (r"gel is not the one", "Put the old gel back, or calibrate and commission with the new one."),
    (r"camera (left|right)", "Check cable and power of that finger; covering the lens shows which it is."),
    (r"no token|token_file", "Give the file that the service names at its start: service.token_file."),
    (r"(Name or service|resolve|not known|getaddrinfo)", "That name is unknown here: give the address."),
    (
        r"(GET|POST) /|ConnectError|ConnectTimeout|robot\.rws\.url",
        "Check robot.rws.url, the controller's network and the firewall.",
    ),
    (r"forbidden", "The token is another service's: give service.token_file of this one."),
    (r"protocol", "Client and service are of different versions: update the older one."),
    (r"service|ws://|no answer", "Start the service (`tactile-insertion serve`), or correct service.url."),
)


def remedy_of(text: str) -> str:
    """The remedy for a finding with this text."""
    return next((remedy for pattern, remedy in REMEDIES if re.search(pattern, text, re.IGNORECASE)), GENERAL)
